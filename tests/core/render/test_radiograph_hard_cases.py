"""Extreme splats: values and gradients stay finite and are what the limit says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from insideout.core.gaussians import GaussianSet
from insideout.core.render.radiograph import radiograph
from insideout.core.views import Detector

PARAMETERS = ("means", "quats", "scales", "density")
CONE = Detector(33, 25, np.array([100.0, 0, 0]), np.array([-80.0, 0, 0]), np.array([0, 1.0, 0]), np.array([0, 0, -1.0]))
PARALLEL = replace(CONE, source=np.array([-1.0, 0, 0]), parallel=True)
SLANTED = np.array([[0.9, 0.1, 0.3, -0.2]])


def one(
    mean: tuple = (0.0, 0.0, 0.0), scale: tuple = (1.0, 1.0, 1.0), quat: np.ndarray = SLANTED, density: float = 0.5
) -> GaussianSet:
    gaussians = GaussianSet.create(np.array([mean]), np.array([scale]), density=density)
    return replace(gaussians, quats=quat.astype(np.float32))


def image_and_gradients(
    gaussians: GaussianSet, detector: Detector, kernel: str, mode: str = "exact"
) -> tuple[torch.Tensor, list[torch.Tensor]]:
    dtype = torch.float64 if kernel == "reference" else torch.float32
    splats = gaussians.to_torch(dtype)
    leaves = [getattr(splats, name).requires_grad_() for name in PARAMETERS]
    image = radiograph(splats, detector, kernel, mode)
    weights = torch.linspace(0.5, 1.5, image.numel(), dtype=dtype).reshape(image.shape)
    (image * weights).sum().backward()
    return image.detach(), [torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for leaf in leaves]


def assert_finite_and_right(gaussians: GaussianSet, detector: Detector = CONE, tolerance: float = 1e-4) -> torch.Tensor:
    """Both kernels give finite values and gradients, and the same image. Returns it."""
    truth, truth_grads = image_and_gradients(gaussians, detector, "reference")
    image, grads = image_and_gradients(gaussians, detector, "cpu")
    for values in (truth, image, *truth_grads, *grads):
        assert values.isfinite().all()
    assert (image.double() - truth).abs().max() <= tolerance * max(float(truth.max()), 1e-30)
    return truth


@pytest.mark.parametrize("detector", [CONE, PARALLEL], ids=["cone", "parallel"])
@pytest.mark.parametrize("ratio", [1e2, 1e4, 1e6])
@pytest.mark.parametrize("shape", ["needle", "disc", "point"])
def test_needle_disc_and_point(shape: str, ratio: float, detector: Detector) -> None:
    long, thin = 30.0, 30.0 / ratio
    scale = {"needle": (long, thin, thin), "disc": (long, long, thin), "point": (thin, thin, thin)}[shape]
    assert_finite_and_right(one(scale=scale), detector)


def test_needle_along_the_central_ray_has_the_integral_of_its_axis() -> None:
    along_x = np.array([[1.0, 0, 0, 0]])
    image = assert_finite_and_right(one(scale=(1000.0, 0.1, 0.1), quat=along_x))
    assert image[12, 16] == pytest.approx(0.5 * np.sqrt(2 * np.pi) * 1000.0, rel=1e-6)


def test_tiny_scale_is_seen_only_by_the_ray_through_it() -> None:
    image = assert_finite_and_right(one(scale=(1e-8, 1e-8, 1e-8)))
    assert image[12, 16] == pytest.approx(0.5 * np.sqrt(2 * np.pi) * 1e-8, rel=1e-6)
    image[12, 16] = 0
    assert image.abs().max() == 0


def test_huge_scale_is_the_same_everywhere() -> None:
    image = assert_finite_and_right(one(scale=(1e8, 1e8, 1e8)))
    torch.testing.assert_close(image, torch.full_like(image, 0.5 * np.sqrt(2 * np.pi) * 1e8), rtol=1e-6, atol=0)


@pytest.mark.parametrize("kernel", ["reference", "cpu"])
def test_infinite_scale_does_not_crash(kernel: str) -> None:
    image, grads = image_and_gradients(one(scale=(np.inf, 1.0, 1.0)), CONE, kernel)
    assert image.isfinite().all()
    assert all(grad.isfinite().all() for grad in grads)


def test_splat_on_the_source_is_the_line_through_its_centre() -> None:
    scale = np.array([3.0, 1.0, 0.5])
    image = assert_finite_and_right(one(mean=(100.0, 0, 0), scale=tuple(scale), quat=np.array([[1.0, 0, 0, 0]])))
    _, directions = CONE.rays()
    expected = 0.5 * np.sqrt(2 * np.pi) / np.linalg.norm(directions / scale, axis=-1)
    np.testing.assert_allclose(image.numpy(), expected, rtol=1e-6)


def test_splat_around_the_source_is_seen_everywhere() -> None:
    image = assert_finite_and_right(one(mean=(99.0, 1.0, 0.5), scale=(4.0, 2.0, 3.0)))
    assert image.min() > 0


def test_splat_beside_the_source() -> None:
    """Its centre is in the plane through the source parallel to the detector: it projects to infinity."""
    assert_finite_and_right(one(mean=(100.0, 6.0, 2.0), scale=(2.0, 1.0, 3.0)))


def test_splat_behind_the_source_counts_because_lines_are_infinite() -> None:
    image = assert_finite_and_right(one(mean=(130.0, 0.0, 0.0), scale=(2.0, 2.0, 2.0)))
    assert image[12, 16] == pytest.approx(0.5 * np.sqrt(2 * np.pi) * 2.0, rel=1e-6)


@pytest.mark.parametrize("kernel", ["reference", "cpu"])
@pytest.mark.parametrize("x", [100.0, 130.0])
def test_affine_leaves_out_splats_at_and_behind_the_source(kernel: str, x: float) -> None:
    image, grads = image_and_gradients(one(mean=(x, 0.0, 0.0)), CONE, kernel, "affine")
    assert image.abs().max() == 0
    assert all(grad.isfinite().all() for grad in grads)


def test_zero_quaternion_means_no_rotation() -> None:
    scale = (3.0, 1.0, 2.0)
    image = assert_finite_and_right(one(scale=scale, quat=np.zeros((1, 4))))
    same = assert_finite_and_right(one(scale=scale, quat=np.array([[1.0, 0, 0, 0]])))
    torch.testing.assert_close(image, same)


@pytest.mark.parametrize("kernel", ["reference", "cpu"])
def test_zero_density_shows_nothing(kernel: str) -> None:
    image, grads = image_and_gradients(one(density=0.0), CONE, kernel)
    assert image.abs().max() == 0
    assert all(grad.isfinite().all() for grad in grads)


def test_zero_density_can_still_grow() -> None:
    _, expected = image_and_gradients(one(density=0.0), CONE, "reference")
    _, grads = image_and_gradients(one(density=0.0), CONE, "cpu")
    torch.testing.assert_close(grads[3].double(), expected[3], rtol=1e-4, atol=0)
    assert grads[3].item() > 0


@pytest.mark.parametrize("kernel", ["reference", "cpu"])
def test_empty_set_is_a_black_image(kernel: str) -> None:
    image, grads = image_and_gradients(GaussianSet.empty(), CONE, kernel)
    assert image.shape == (25, 33)
    assert image.abs().max() == 0
    assert all(len(grad) == 0 for grad in grads)


@pytest.mark.parametrize("kernel", ["reference", "cpu"])
def test_splats_that_are_not_numbers_are_left_out(kernel: str) -> None:
    gaussians = GaussianSet.create(np.zeros((4, 3)), 1.0, density=0.5)
    gaussians.means[1, 0], gaussians.quats[2, 1], gaussians.density[3] = np.nan, np.inf, np.nan
    image, grads = image_and_gradients(gaussians, CONE, kernel)
    alone, _ = image_and_gradients(gaussians.select(slice(0, 1)), CONE, kernel)
    torch.testing.assert_close(image, alone)
    assert all(grad.isfinite().all() for grad in grads)


def test_coordinates_of_a_kilometre() -> None:
    far = np.array([1e6, -1e6, 1e6])
    detector = replace(CONE, source=CONE.source + far, center=CONE.center + far)
    near, _ = image_and_gradients(one(scale=(3.0, 2.0, 1.0)), CONE, "reference")
    image = assert_finite_and_right(one(mean=tuple(far), scale=(3.0, 2.0, 1.0)), detector)
    torch.testing.assert_close(image, near, rtol=1e-6, atol=1e-9)
