"""Radiographs against numerical integration, the closed form's gradients, and the CPU kernel against the reference."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest
import torch

from insideout.core.errors import SettingError
from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.render.radiograph import radiograph
from insideout.core.views import Detector

PARAMETERS = ("means", "quats", "scales", "density")
VECTORS = ("source", "center", "u", "v")

DETECTORS = {
    "cone": Detector(
        19, 14, np.array([100.0, 0, 0]), np.array([-80.0, 0, 0]), np.array([0, 2.6, 0]), np.array([0, 0, -2.8])
    ),
    "parallel": Detector(
        19,
        14,
        np.array([-1.0, 0, 0]),
        np.array([-80.0, 0, 0]),
        np.array([0, 1.5, 0]),
        np.array([0, 0, -1.6]),
        True,
    ),
    "offset": Detector(
        19, 14, np.array([100.0, 3, -2]), np.array([-80.0, 9, 6]), np.array([0, 2.6, 0]), np.array([0, 0, -2.8])
    ),
    "tilted": Detector(
        19,
        14,
        np.array([60.0, 70, 5]),
        np.array([-50.0, -60, 3]),
        np.array([1.9, -1.8, 0.4]),
        np.array([0.5, 0.3, -2.7]),
    ),
    "tilted parallel": Detector(
        19,
        14,
        np.array([-3.0, -2, 0.5]),
        np.array([-40.0, -30, 3]),
        np.array([0.8, -1.2, 0.4]),
        np.array([0.5, 0.3, -1.7]),
        True,
    ),
    "a pose of its own": Detector(
        19,
        14,
        np.array([-30.0, 55, 80]),
        np.array([35.0, -38, -70]),
        np.array([2.1, 1.7, 0.1]),
        np.array([0.8, -1.4, 2.2]),
    ),
    "source inside": Detector(
        19, 14, np.array([3.0, 1, 0.2]), np.array([-80.0, 4, 1]), np.array([0.1, 8.5, 0.3]), np.array([0.2, 0.1, -8.4])
    ),
}


def scene(count: int, seed: int = 0, spread: float = 5.0) -> GaussianSet:
    rng = np.random.default_rng(seed)
    return GaussianSet.create(
        rng.normal(size=(count, 3)) * spread,
        10 ** rng.uniform(-0.6, 0.5, (count, 3)),
        quats=rng.normal(size=(count, 4)),
        density=rng.uniform(0.05, 1, count),
    )


def render_with_gradients(
    gaussians: GaussianSet, detector: Detector, kernel: str, mode: str, dtype: torch.dtype, weights: np.ndarray
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """The image and the gradient of its weighted sum for every parameter of splats and detector."""
    splats = gaussians.to_torch(dtype)
    leaves = {name: getattr(splats, name).requires_grad_() for name in PARAMETERS}
    leaves |= {name: torch.tensor(getattr(detector, name), dtype=torch.float64, requires_grad=True) for name in VECTORS}
    view = replace(detector, **{name: leaves[name] for name in VECTORS})
    image = radiograph(splats, view, kernel, mode)
    (image * torch.as_tensor(weights).to(image)).sum().backward()
    return image.detach().double(), {name: leaf.grad.double() for name, leaf in leaves.items()}


@pytest.mark.parametrize("name", DETECTORS)
def test_reference_is_the_integral_along_the_ray(name: str) -> None:
    gaussians, detector = scene(6), DETECTORS[name]
    splats = gaussians.to_torch(torch.float64)
    splats = replace(splats, quats=splats.quats / splats.quats.norm(dim=1, keepdim=True))
    image = radiograph(splats, detector, "reference").numpy()
    inverse = np.linalg.inv(splats.covariances().numpy())
    origins, directions = detector.rays()
    for row, column in [(0, 0), (6, 9), (7, 3), (13, 18)]:
        middle = ((splats.means.numpy() - origins[row, column]) @ directions[row, column]).mean()
        lengths = middle + np.linspace(-90, 90, 20001)
        points = origins[row, column] + lengths[:, None] * directions[row, column]
        apart = points[:, None] - splats.means.numpy()
        values = np.exp(-0.5 * np.einsum("tni,nij,tnj->tn", apart, inverse, apart)) @ splats.density.numpy()
        # The trapezoid rule is exact to rounding for Gaussians sampled this finely.
        expected = values.sum() * (lengths[1] - lengths[0])
        assert image[row, column] == pytest.approx(expected, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("mode", ["exact", "affine"])
@pytest.mark.parametrize("name", ["tilted", "tilted parallel"])
def test_reference_gradients_are_the_derivatives(name: str, mode: str) -> None:
    splats = scene(3, seed=1).to_torch(torch.float64)
    detector = replace(DETECTORS[name], width=5, height=4)
    leaves = [getattr(splats, field).requires_grad_() for field in PARAMETERS]
    leaves += [torch.tensor(getattr(detector, field), dtype=torch.float64, requires_grad=True) for field in VECTORS]

    def image(*values: torch.Tensor) -> torch.Tensor:
        moved = replace(splats, **dict(zip(PARAMETERS, values[:4], strict=True)))
        return radiograph(moved, replace(detector, **dict(zip(VECTORS, values[4:], strict=True))), "reference", mode)

    assert torch.autograd.gradcheck(image, leaves, eps=1e-5, atol=1e-6)


def test_affine_reference_is_the_formula_of_r2_gaussian() -> None:
    splats, detector = scene(1, seed=4).to_torch(torch.float64), DETECTORS["cone"]
    image = radiograph(splats, detector, "reference", "affine").numpy()
    mean, covariance = splats.means.numpy()[0], splats.covariances().numpy()[0]
    rotation = np.stack([[0, 1, 0], [0, 0, -1], [-1, 0, 0]]).astype(float)
    t = rotation @ (mean - detector.source)
    f_u, f_v = 180 / 2.6, 180 / 2.8
    jacobian = np.array(
        [[f_u / t[2], 0, -f_u * t[0] / t[2] ** 2], [0, f_v / t[2], -f_v * t[1] / t[2] ** 2], t / np.linalg.norm(t)]
    )
    ray_space = jacobian @ rotation @ covariance @ rotation.T @ jacobian.T
    flat = ray_space[:2, :2]
    peak = splats.density.numpy()[0] * np.sqrt(2 * np.pi * np.linalg.det(ray_space) / np.linalg.det(flat))
    j, i = np.meshgrid(np.arange(19) + 0.5, np.arange(14) + 0.5)
    delta = np.stack([j - (9.5 + f_u * t[0] / t[2]), i - (7 + f_v * t[1] / t[2])], axis=-1)
    expected = peak * np.exp(-0.5 * np.einsum("ija,ab,ijb->ij", delta, np.linalg.inv(flat), delta))
    np.testing.assert_allclose(image, expected, rtol=1e-5, atol=1e-8)


def test_affine_and_exact_agree_for_small_splats_and_for_parallel_beams() -> None:
    small = scene(20)
    small = replace(small, scales=small.scales * 0.02).to_torch(torch.float64)
    detector = replace(DETECTORS["cone"], width=200, height=150, u=np.array([0, 0.3, 0]), v=np.array([0, 0, -0.3]))
    exact, affine = (radiograph(small, detector, "reference", mode) for mode in ("exact", "affine"))
    assert (exact - affine).abs().max() < 1e-3 * exact.max()
    wide = scene(20).to_torch(torch.float64)
    exact, affine = (radiograph(wide, DETECTORS["parallel"], "reference", mode) for mode in ("exact", "affine"))
    torch.testing.assert_close(exact, affine, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("mode", ["exact", "affine"])
@pytest.mark.parametrize("name", DETECTORS)
def test_cpu_kernel_equals_the_reference(name: str, mode: str) -> None:
    gaussians = scene(120, seed=2)
    detector = replace(DETECTORS[name], width=37, height=29)
    detector = replace(detector, u=np.asarray(detector.u) / 2, v=np.asarray(detector.v) / 2)
    weights = np.random.default_rng(3).normal(size=(29, 37))
    truth, truth_grads = render_with_gradients(gaussians, detector, "reference", mode, torch.float64, weights)
    image, grads = render_with_gradients(gaussians, detector, "cpu", mode, torch.float32, weights)
    assert (image - truth).abs().max() < 1e-5 * truth.max()
    for parameter, expected in truth_grads.items():
        assert (grads[parameter] - expected).norm() < 1e-4 * expected.norm(), parameter


@pytest.mark.parametrize(("width", "height"), [(1, 1), (3, 1), (1, 33), (17, 5), (65, 31)])
def test_any_image_size(width: int, height: int) -> None:
    splats = scene(40, seed=5).to_torch()
    detector = replace(DETECTORS["offset"], width=width, height=height)
    truth = radiograph(splats.to_torch(torch.float64), detector, "reference")
    image = radiograph(splats, detector)
    assert image.shape == (height, width)
    torch.testing.assert_close(image.double(), truth, rtol=1e-5, atol=1e-5 * float(truth.max()))


def test_bits_do_not_depend_on_the_number_of_threads() -> None:
    gaussians, detector = scene(700, seed=6), replace(DETECTORS["tilted"], width=61, height=47)
    weights = np.random.default_rng(0).normal(size=(47, 61))
    threads = numba.get_num_threads()
    results = []
    try:
        for count in {1, threads}:
            numba.set_num_threads(count)
            results += [
                render_with_gradients(gaussians, detector, "cpu", "exact", torch.float32, weights) for _ in range(2)
            ]
    finally:
        numba.set_num_threads(threads)
    first, first_grads = results[0]
    for image, grads in results[1:]:
        assert torch.equal(image, first)
        assert all(torch.equal(grads[name], first_grads[name]) for name in grads)


def test_a_cutoff_costs_no_more_than_it_says() -> None:
    splats, detector = scene(1, seed=7).to_torch(), replace(DETECTORS["cone"], width=60, height=45)
    full = radiograph(splats.to_torch(torch.float64), detector, "reference")
    for cutoff in (3.0, 4.0, 5.3):
        error = (radiograph(splats, detector, cutoff_sigmas=cutoff).double() - full).abs().max() / full.max()
        assert error <= np.exp(-0.5 * cutoff**2) + 1e-6


def test_clones_are_left_out() -> None:
    gaussians = scene(10)
    modality = np.full(10, Modality.XRAY, np.uint8)
    modality[5:] = Modality.CLONE
    splats = replace(gaussians, modality=modality).to_torch()
    torch.testing.assert_close(
        radiograph(splats, DETECTORS["cone"]), radiograph(splats.select(slice(0, 5)), DETECTORS["cone"])
    )


@pytest.mark.parametrize("wrong", [{"kernel": "gpu"}, {"mode": "fast"}, {"cutoff_sigmas": 0.0}])
def test_a_wrong_setting_says_what_to_choose(wrong: dict) -> None:
    with pytest.raises(SettingError):
        radiograph(scene(1).to_torch(), DETECTORS["cone"], **wrong)
