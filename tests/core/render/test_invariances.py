"""What must not matter: where the scene is, its unit of length, the order of splats, and one splat for two halves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from insideout.core.gaussians import GaussianSet
from insideout.core.render import radiograph, section, splat
from insideout.core.render.agreement import (
    DETECTORS,
    decided_pixels,
    random_camera,
    random_detector,
    random_plane,
    random_rotation,
    random_set,
)
from insideout.core.similarity import Similarity
from insideout.core.views import Camera, Detector, Plane

KERNELS = pytest.mark.parametrize("kernel", ["cpu", "reference"])
SEEDS = st.integers(0, 2**32 - 1)
SCALES = st.floats(-3, 3).map(lambda exponent: float(10**exponent))
examples = settings(max_examples=8, deadline=None, derandomize=True)

# Moved splats are rounded to float32 again, 6e-8 of their coordinates each.
TOLERANCE = 3e-5


def numbers(rng: np.random.Generator) -> tuple[int, int, int]:
    """Splats, width and height."""
    return int(rng.integers(1, 60)), int(rng.integers(1, 40)), int(rng.integers(1, 40))


def photograph(gaussians: GaussianSet, camera: Camera, kernel: str) -> torch.Tensor:
    seen = splat(_tensors(gaussians, kernel), camera, [0.1, 0.5, 0.9], kernel)
    return torch.cat([seen.color, seen.alpha[..., None], seen.depth[..., None]], dim=-1).double()


def expose(gaussians: GaussianSet, detector: Detector, kernel: str) -> torch.Tensor:
    return radiograph(_tensors(gaussians, kernel), detector, kernel).double()


def cut(gaussians: GaussianSet, plane: Plane, quantity: str, kernel: str) -> torch.Tensor:
    return section(_tensors(gaussians, kernel), plane, quantity, kernel).double()


def _tensors(gaussians: GaussianSet, kernel: str) -> GaussianSet:
    return gaussians.to_torch(torch.float64 if kernel == "reference" else torch.float32)


def assert_same(found: torch.Tensor, truth: torch.Tensor, tolerance: float = TOLERANCE) -> None:
    assert (found - truth).norm() <= tolerance * truth.norm() + 1e-7 * truth.numel() ** 0.5


def moved_detector(detector: Detector, move: Similarity) -> Detector:
    turn = move.scale * move.rotation
    source = move.rotation @ detector.source if detector.parallel else move.apply(detector.source[None])[0]
    center = move.apply(detector.center[None])[0]
    return replace(detector, source=source, center=center, u=turn @ detector.u, v=turn @ detector.v)


def moved_plane(plane: Plane, move: Similarity) -> Plane:
    turn = move.scale * move.rotation
    origin = move.apply(plane.origin[None])[0]
    thickness = move.scale * plane.thickness_mm
    return replace(plane, origin=origin, u=turn @ plane.u, v=turn @ plane.v, thickness_mm=thickness)


def rigid(rng: np.random.Generator, reach: float) -> Similarity:
    return Similarity(1.0, random_rotation(rng), rng.normal(size=3) * reach)


@KERNELS
@examples
@given(seed=SEEDS)
def test_a_photo_does_not_depend_on_where_scene_and_camera_are(kernel: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    count, width, height = numbers(rng)
    gaussians = random_set(rng, count, 0.5, 0.12, degree=seed % 4)
    camera = random_camera(rng, width, height, orthographic=seed % 2 == 1)
    move = rigid(rng, 3.0)
    keep = decided_pixels(gaussians, camera)[..., None]
    moved = photograph(gaussians.transformed(move), camera.transformed(move), kernel)
    assert_same(moved * keep, photograph(gaussians, camera, kernel) * keep)


@KERNELS
@examples
@given(seed=SEEDS)
def test_a_radiograph_does_not_depend_on_where_scene_and_detector_are(kernel: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    count, width, height = numbers(rng)
    gaussians = random_set(rng, count, 5.0, 2.0)
    detector = random_detector(rng, width, height, DETECTORS[seed % 6])
    move = rigid(rng, 30.0)
    moved = expose(gaussians.transformed(move), moved_detector(detector, move), kernel)
    assert_same(moved, expose(gaussians, detector, kernel))


@KERNELS
@examples
@given(seed=SEEDS)
def test_a_section_does_not_depend_on_where_scene_and_plane_are(kernel: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    count, width, height = numbers(rng)
    gaussians = random_set(rng, count, 4.0, 2.0)
    plane = random_plane(rng, width, height, (0.0, 1.0)[seed % 2])
    move = rigid(rng, 30.0)
    for quantity in ("density", "occupancy"):
        moved = cut(gaussians.transformed(move), moved_plane(plane, move), quantity, kernel)
        assert_same(moved, cut(gaussians, plane, quantity, kernel))


@KERNELS
@examples
@given(seed=SEEDS, scale=SCALES)
def test_a_photo_does_not_depend_on_the_unit_of_length(kernel: str, seed: int, scale: float) -> None:
    """But its depth does."""
    rng = np.random.default_rng(seed)
    count, width, height = numbers(rng)
    gaussians = random_set(rng, count, 0.5, 0.12, degree=seed % 4)
    camera = random_camera(rng, width, height, orthographic=seed % 2 == 1)
    move = Similarity(scale, np.eye(3), np.zeros(3))
    keep = decided_pixels(gaussians, camera)[..., None]
    moved = photograph(gaussians.transformed(move), camera.transformed(move), kernel)
    moved[..., 4] /= scale
    assert_same(moved * keep, photograph(gaussians, camera, kernel) * keep)


@KERNELS
@examples
@given(seed=SEEDS, scale=SCALES)
def test_a_radiograph_does_not_depend_on_the_unit_of_length_when_density_is_per_length(
    kernel: str, seed: int, scale: float
) -> None:
    rng = np.random.default_rng(seed)
    count, width, height = numbers(rng)
    gaussians = random_set(rng, count, 5.0, 2.0)
    detector = random_detector(rng, width, height, DETECTORS[seed % 6])
    move = Similarity(scale, np.eye(3), np.zeros(3))
    grown = gaussians.transformed(move)
    np.testing.assert_allclose(grown.density, gaussians.density / scale, rtol=1e-6)
    assert_same(expose(grown, moved_detector(detector, move), kernel), expose(gaussians, detector, kernel))


@KERNELS
@examples
@given(seed=SEEDS, scale=SCALES)
def test_a_section_in_another_unit_of_length_has_its_density_in_that_unit(kernel: str, seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    count, width, height = numbers(rng)
    gaussians = random_set(rng, count, 4.0, 2.0)
    plane = random_plane(rng, width, height, (0.0, 1.0)[seed % 2])
    move = Similarity(scale, np.eye(3), np.zeros(3))
    grown, there = gaussians.transformed(move), moved_plane(plane, move)
    assert_same(scale * cut(grown, there, "density", kernel), cut(gaussians, plane, "density", kernel))
    assert_same(cut(grown, there, "occupancy", kernel), cut(gaussians, plane, "occupancy", kernel))


@KERNELS
@examples
@given(seed=SEEDS)
def test_the_order_of_the_splats_does_not_matter(kernel: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    count, width, height = numbers(rng)
    order = rng.permutation(count)
    small, large = random_set(rng, count, 0.5, 0.12, degree=1), random_set(rng, count, 5.0, 2.0)
    camera = random_camera(rng, width, height, orthographic=seed % 2 == 1)
    detector = random_detector(rng, width, height, DETECTORS[seed % 6])
    plane = random_plane(rng, width, height, (0.0, 1.0)[seed % 2])
    # Photos blend by depth, so nothing is added in another order.
    assert torch.equal(photograph(small.select(order), camera, kernel), photograph(small, camera, kernel))
    assert_same(expose(large.select(order), detector, kernel), expose(large, detector, kernel), 1e-6)
    for quantity in ("density", "occupancy", "color"):
        assert_same(cut(large.select(order), plane, quantity, kernel), cut(large, plane, quantity, kernel), 1e-6)


@KERNELS
@examples
@given(seed=SEEDS, share=st.floats(0.0, 1.0))
def test_a_splat_is_as_dense_as_its_two_parts(kernel: str, seed: int, share: float) -> None:
    """Halves or any other shares, at any place in the set."""
    rng = np.random.default_rng(seed)
    count, width, height = numbers(rng)
    gaussians = random_set(rng, count, 5.0, 2.0)
    parts = [replace(gaussians, density=(f * gaussians.density).astype(np.float32)) for f in (share, 1 - share)]
    both = GaussianSet.concatenate(parts).select(rng.permutation(2 * count))
    detector = random_detector(rng, width, height, DETECTORS[seed % 6])
    plane = random_plane(rng, width, height, (0.0, 1.0)[seed % 2])
    assert_same(expose(both, detector, kernel), expose(gaussians, detector, kernel), 1e-6)
    assert_same(cut(both, plane, "density", kernel), cut(gaussians, plane, "density", kernel), 1e-6)
