"""Cuts and slabs against direct evaluation and integration, and the CPU kernel against the reference."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest
import torch
from scipy.integrate import quad

from insideout.core.errors import SettingError
from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.render.section import dc_colors, section
from insideout.core.views import Plane

FIELDS = ("means", "quats", "scales", "density", "opacities", "sh")
QUANTITIES = ("density", "occupancy", "color")
PLANE = Plane(np.array([-10.0, -8, 1]), np.array([0.5, 0.05, 0.1]), np.array([-0.06, 0.6, 0.0]), 37, 29)
EXACT = Plane(np.array([-9.25, -7.25, 1]), np.array([0.5, 0, 0.25]), np.array([0, 0.5, 0]), 37, 29)
"""A plane whose pixel centres are exact in float32, so that the tiniest splat is on one of them."""


def slab(thickness: float, plane: Plane = PLANE) -> Plane:
    return replace(plane, thickness_mm=thickness)


def scene(count: int, seed: int = 0) -> GaussianSet:
    rng = np.random.default_rng(seed)
    return GaussianSet.create(
        rng.normal(size=(count, 3)) * 5,
        10 ** rng.uniform(-0.6, 0.5, (count, 3)),
        quats=rng.normal(size=(count, 4)),
        density=rng.uniform(0.05, 1, count),
        opacities=rng.uniform(0.1, 1, count),
        sh=rng.normal(size=(count, 4, 3)),
    )


def weights_at(splats: GaussianSet, point: np.ndarray) -> np.ndarray:
    apart = point - splats.means.numpy()
    inverse = np.linalg.inv(splats.covariances().numpy())
    return np.exp(-0.5 * np.einsum("ni,nij,nj->n", apart, inverse, apart))


def exact_scene(count: int) -> GaussianSet:
    splats = scene(count).to_torch(torch.float64)
    return replace(splats, quats=splats.quats / splats.quats.norm(dim=1, keepdim=True))


def render_with_gradients(
    gaussians: GaussianSet, plane: Plane, quantity: str, kernel: str, dtype: torch.dtype
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    splats = gaussians.to_torch(dtype)
    leaves = {name: getattr(splats, name).requires_grad_() for name in FIELDS}
    image = section(splats, plane, quantity, kernel)
    weights = np.random.default_rng(1).normal(size=image.shape)
    (image * torch.as_tensor(weights).to(image)).sum().backward()
    return image.detach().double(), {
        name: torch.zeros_like(leaf).double() if leaf.grad is None else leaf.grad.double()
        for name, leaf in leaves.items()
    }


def test_reference_cut_is_the_model_at_the_plane() -> None:
    splats = exact_scene(8)
    points = PLANE.points()
    density, occupancy, color = (section(splats, PLANE, q, "reference").numpy() for q in QUANTITIES)
    colors = dc_colors(splats.sh).numpy()
    for row, column in [(0, 0), (14, 18), (20, 11), (28, 36)]:
        w = weights_at(splats, points[row, column])
        alpha = splats.opacities.numpy() * w
        assert density[row, column] == pytest.approx(splats.density.numpy() @ w, rel=1e-6)
        assert occupancy[row, column] == pytest.approx(1 - np.prod(1 - alpha), rel=1e-6)
        if alpha.sum() > 0.01:
            np.testing.assert_allclose(color[row, column], alpha @ colors / alpha.sum(), rtol=1e-6)


@pytest.mark.parametrize("thickness", [0.01, 1.5, 12.0])
def test_reference_slab_is_the_mean_through_it(thickness: float) -> None:
    splats = exact_scene(4)
    image = section(splats, slab(thickness), "density", "reference").numpy()
    normal = PLANE.normal
    for row, column in [(14, 18), (9, 25)]:
        point = PLANE.points()[row, column]

        def along(t: float, point: np.ndarray = point) -> float:
            return float(splats.density.numpy() @ weights_at(splats, point + t * normal))

        expected = quad(along, -thickness / 2, thickness / 2, epsabs=1e-12, limit=200)[0] / thickness
        assert image[row, column] == pytest.approx(expected, rel=1e-6, abs=1e-12)


@pytest.mark.parametrize("thickness", [0.0, 0.01, 2.0])
@pytest.mark.parametrize("quantity", QUANTITIES)
def test_reference_gradients_are_the_derivatives(quantity: str, thickness: float) -> None:
    splats = scene(2, seed=1).with_sh_coefficients(1).to_torch(torch.float64)
    plane = Plane(np.array([-6.0, -5, 1]), np.array([3.5, 0.1, 0.2]), np.array([0.1, 3.6, 0]), 4, 3, thickness)
    leaves = [getattr(splats, name).requires_grad_() for name in FIELDS]

    def image(*values: torch.Tensor) -> torch.Tensor:
        return section(replace(splats, **dict(zip(FIELDS, values, strict=True))), plane, quantity, "reference")

    assert torch.autograd.gradcheck(image, leaves, eps=1e-5, atol=1e-6)


@pytest.mark.parametrize("thickness", [0.0, 0.2, 2.0, 20.0])
@pytest.mark.parametrize("quantity", QUANTITIES)
def test_cpu_kernel_equals_the_reference(quantity: str, thickness: float) -> None:
    gaussians = scene(150, seed=2)
    truth, truth_grads = render_with_gradients(gaussians, slab(thickness), quantity, "reference", torch.float64)
    image, grads = render_with_gradients(gaussians, slab(thickness), quantity, "cpu", torch.float32)
    assert (image - truth).abs().max() < 1e-4 * truth.max()
    for name, expected in truth_grads.items():
        assert (grads[name] - expected).norm() <= 1e-3 * expected.norm(), name


@pytest.mark.parametrize("thickness", [0.0, 2.0])
def test_opacities_alone_have_the_gradient_that_they_have_among_others(thickness: float) -> None:
    """Without one for the shape, which is left out then, there is less to do, and the bits are the same."""
    gaussians, plane = scene(150, seed=2), slab(thickness)
    _, together = render_with_gradients(gaussians, plane, "occupancy", "cpu", torch.float32)
    splats = gaussians.to_torch()
    splats.opacities.requires_grad_()
    image = section(splats, plane, "occupancy")
    weights = np.random.default_rng(1).normal(size=image.shape)
    (image * torch.as_tensor(weights).to(image)).sum().backward()
    assert torch.equal(splats.opacities.grad.double(), together["opacities"])
    assert together["opacities"].norm() > 0


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 33), (17, 5), (65, 31)])
def test_any_image_size(width: int, height: int) -> None:
    plane = replace(PLANE, width=width, height=height)
    splats = scene(60, seed=5).to_torch()
    truth = section(splats.to_torch(torch.float64), plane, "density", "reference")
    image = section(splats, plane)
    assert image.shape == (height, width)
    torch.testing.assert_close(image.double(), truth, rtol=1e-5, atol=2e-6)


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_bits_do_not_depend_on_the_number_of_threads(quantity: str) -> None:
    gaussians = scene(700, seed=6)
    threads = numba.get_num_threads()
    results = []
    try:
        for count in {1, threads}:
            numba.set_num_threads(count)
            results += [render_with_gradients(gaussians, slab(1.0), quantity, "cpu", torch.float32) for _ in range(2)]
    finally:
        numba.set_num_threads(threads)
    first, first_grads = results[0]
    for image, grads in results[1:]:
        assert torch.equal(image, first)
        assert all(torch.equal(grads[name], first_grads[name]) for name in grads)


def test_occupancy_does_not_depend_on_the_order() -> None:
    splats = scene(100, seed=3).to_torch()
    order = torch.randperm(100, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(
        section(splats, PLANE, "occupancy"), section(splats.select(order), PLANE, "occupancy"), rtol=1e-5, atol=1e-6
    )


def test_opaque_splats_on_top_of_each_other_keep_finite_gradients() -> None:
    middle = PLANE.points()[14, 18]
    gaussians = GaussianSet.create(np.repeat(middle[None], 50, axis=0), 2.0, opacities=1.0)
    for kernel, dtype in [("reference", torch.float64), ("cpu", torch.float32)]:
        image, grads = render_with_gradients(gaussians, PLANE, "occupancy", kernel, dtype)
        assert image.max() == pytest.approx(1, abs=1e-6)
        assert all(grad.isfinite().all() for grad in grads.values())


def test_color_is_black_where_nothing_is() -> None:
    gaussians = GaussianSet.create(PLANE.points()[14, 18][None], 0.3, sh=np.full((1, 1, 3), 1.0))
    image = section(gaussians.to_torch(), PLANE, "color")
    torch.testing.assert_close(image[14, 18], dc_colors(torch.ones(1, 1, 3))[0])
    assert image[0, 0].abs().max() == 0


def test_density_leaves_clones_out_and_occupancy_does_not() -> None:
    gaussians = scene(6)
    splats = replace(gaussians, modality=np.full(6, Modality.CLONE, np.uint8)).to_torch()
    assert section(splats, PLANE).max() == 0
    assert section(splats, PLANE, "occupancy").max() > 0


@pytest.mark.parametrize("quantity", QUANTITIES)
@pytest.mark.parametrize("thickness", [0.0, 3.0])
@pytest.mark.parametrize(
    "scale",
    [(30, 30e-6, 30e-6), (30, 30, 30e-6), (1e-8, 1e-8, 1e-8), (1e8, 1e8, 1e8), (1e8, 1e-8, 1.0)],
    ids=["needle", "disc", "tiny", "huge", "both"],
)
def test_extreme_shapes_stay_finite_and_right(scale: tuple, thickness: float, quantity: str) -> None:
    middle = EXACT.points()[14, 18]
    gaussians = GaussianSet.create(
        middle[None], np.array([scale]), quats=np.array([[0.9, 0.1, 0.3, -0.2]]), opacities=0.8, density=0.5
    )
    truth, truth_grads = render_with_gradients(gaussians, slab(thickness, EXACT), quantity, "reference", torch.float64)
    image, grads = render_with_gradients(gaussians, slab(thickness, EXACT), quantity, "cpu", torch.float32)
    for values in (truth, image, *truth_grads.values(), *grads.values()):
        assert values.isfinite().all()
    assert (image - truth).abs().max() <= max(1e-3 * float(truth.max()), 1e-6)


@pytest.mark.parametrize("kernel", ["reference", "cpu"])
@pytest.mark.parametrize("quantity", QUANTITIES)
def test_no_splats_and_splats_that_are_not_numbers(quantity: str, kernel: str) -> None:
    image, _ = render_with_gradients(GaussianSet.empty(), PLANE, quantity, kernel, torch.float32)
    assert image.abs().max() == 0
    broken = scene(3)
    broken.means[0, 1], broken.scales[1, 2], broken.quats[2] = np.nan, np.nan, np.inf
    image, grads = render_with_gradients(broken, PLANE, quantity, kernel, torch.float32)
    assert image.abs().max() == 0
    assert all(grad.isfinite().all() for grad in grads.values())


def test_zero_quaternion_means_no_rotation_and_gets_no_gradient() -> None:
    gaussians = scene(5)
    turned = replace(gaussians, quats=np.zeros((5, 4), np.float32))
    upright = replace(gaussians, quats=np.tile(np.float32([1, 0, 0, 0]), (5, 1)))
    image, grads = render_with_gradients(turned, PLANE, "density", "cpu", torch.float32)
    assert torch.equal(image, render_with_gradients(upright, PLANE, "density", "cpu", torch.float32)[0])
    assert grads["quats"].abs().max() == 0


@pytest.mark.parametrize("wrong", [{"kernel": "gpu"}, {"quantity": "mass"}, {"cutoff_sigmas": -1.0}])
def test_a_wrong_setting_says_what_to_choose(wrong: dict) -> None:
    with pytest.raises(SettingError):
        section(scene(1).to_torch(), PLANE, **wrong)
