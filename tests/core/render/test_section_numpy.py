"""The section of Blender's process: the same image as the renderer's, from numpy alone."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.render import section_numpy
from insideout.core.render.section import section
from insideout.core.render.section_numpy import SectionSplats, section_density
from insideout.core.steps import run_through
from insideout.core.views import Plane

PLANE = Plane(np.array([-10.0, -8, 1]), np.array([0.5, 0.05, 0.1]), np.array([-0.06, 0.6, 0.0]), 39, 29)
EXACT = Plane(np.array([-9.25, -7.25, 1]), np.array([0.5, 0, 0.25]), np.array([0, 0.5, 0]), 39, 29)
"""A plane whose pixel centres are exact in float32, so that the tiniest splat is on one of them."""


def scene(count: int) -> GaussianSet:
    rng = np.random.default_rng(0)
    return GaussianSet.create(
        rng.normal(size=(count, 3)) * 5,
        10 ** rng.uniform(-1.2, 0.6, (count, 3)),
        quats=rng.normal(size=(count, 4)),
        density=rng.uniform(0.05, 1, count),
    )


@pytest.mark.parametrize("size", [(39, 29), (1, 1), (64, 3), (5, 80)])
@pytest.mark.parametrize("thickness", [0.0, 0.2, 2.0, 20.0])
def test_equals_the_renderer(thickness: float, size: tuple[int, int]) -> None:
    gaussians = scene(150)
    plane = replace(PLANE, thickness_mm=thickness, width=size[0], height=size[1])
    truth = section(gaussians.to_torch(torch.float64), plane, kernel="reference").numpy()
    image = section_density(gaussians, plane)
    assert image.shape == truth.shape
    assert image.dtype == np.float32
    np.testing.assert_allclose(image, truth, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("batch", "kept", "large"), [(500, 500, 400), (1 << 17, 1 << 17, 1), (1 << 17, 1 << 17, 10**9)]
)
def test_how_patches_are_added_changes_nothing(batch: int, kept: int, large: int, monkeypatch) -> None:
    """A few small ones at a time, each by itself, all together."""
    gaussians = scene(150)
    usual = section_density(gaussians, PLANE)
    for name, value in (("_BATCH_ELEMENTS", batch), ("_KEPT_ELEMENTS", kept), ("_LARGE_PATCH", large)):
        monkeypatch.setattr(section_numpy, name, value)
    np.testing.assert_allclose(section_density(gaussians, PLANE), usual, rtol=1e-6)


def test_planes_that_are_moved_and_turned_show_what_each_shows_by_itself() -> None:
    """What one needs is kept for the next."""
    gaussians, turned = scene(150), replace(PLANE, u=PLANE.v, v=PLANE.u + np.array([0.0, 0.1, 0.3]))
    kept = SectionSplats(gaussians)
    for plane in (PLANE, replace(PLANE, origin=PLANE.origin + np.array([0.0, 0.5, 2.0])), turned, PLANE):
        np.testing.assert_array_equal(section_density(kept, plane), section_density(gaussians, plane))


def test_a_section_of_more_pixels_than_are_kept_at_a_time(monkeypatch) -> None:
    monkeypatch.setattr(section_numpy, "_KEPT_ELEMENTS", 10_000)
    plane = replace(PLANE, u=PLANE.u / 4, v=PLANE.v / 4, width=156, height=116)
    assert plane.width * plane.height > section_numpy._KEPT_ELEMENTS
    gaussians = scene(20)
    # Wide ones, and many that touch a few pixels each, all over the image.
    small = replace(scene(400), scales=np.full((400, 3), 0.02, np.float32))
    gaussians = GaussianSet.concatenate([gaussians, small])
    truth = section(gaussians.to_torch(torch.float64), plane, kernel="reference").numpy()
    np.testing.assert_allclose(section_density(gaussians, plane), truth, rtol=1e-5, atol=1e-5)


def test_nothing_on_the_plane_is_a_black_image() -> None:
    far = replace(scene(20), means=scene(20).means + np.float32(1000))
    for gaussians in (far, GaussianSet.empty()):
        assert np.abs(section_density(gaussians, PLANE)).max() == 0


def test_clones_and_splats_that_are_not_numbers_are_left_out() -> None:
    gaussians = scene(12)
    broken = gaussians.select(slice(None))
    broken = replace(broken, means=broken.means.copy(), modality=broken.modality.copy())
    broken.means[4:8] = np.nan
    broken.modality[8:] = Modality.CLONE
    np.testing.assert_array_equal(section_density(broken, PLANE), section_density(gaussians.select(slice(0, 4)), PLANE))


@pytest.mark.parametrize("thickness", [0.0, 1.0])
@pytest.mark.parametrize("scale", [(30, 3e-5, 3e-5), (30, 30, 3e-5), (1e-8, 1e-8, 1e-8), (1e8, 1e8, 1e8)])
def test_extreme_shapes(scale: tuple, thickness: float) -> None:
    plane = replace(EXACT, thickness_mm=thickness)
    gaussians = GaussianSet.create(
        EXACT.points()[14, 18][None], np.array([scale]), quats=np.array([[0.9, 0.1, 0.3, -0.2]]), density=0.5
    )
    truth = section(gaussians.to_torch(torch.float64), plane, kernel="reference").numpy()
    with np.errstate(all="raise", under="ignore"):
        image = section_density(gaussians, plane)
    np.testing.assert_allclose(image, truth, atol=max(1e-3 * truth.max(), 1e-6))


def test_needs_neither_torch_nor_numba_nor_scipy() -> None:
    code = (
        "import sys\n"
        "for name in ('torch', 'numba', 'scipy'): sys.modules[name] = None\n"
        "import insideout.core.render.section_numpy\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("thickness", [0.0, 2.0])
@pytest.mark.parametrize("count", [0, 1, 64, 301])
def test_in_steps_it_is_the_same(count: int, thickness: float, monkeypatch: pytest.MonkeyPatch) -> None:
    plane = replace(PLANE, thickness_mm=thickness)
    splats = scene(count)
    splats.density[::7] = 0
    whole, image = SectionSplats(splats), section_density(splats, plane)
    monkeypatch.setattr(section_numpy, "_ROWS", 16)
    in_steps = run_through(SectionSplats.in_steps(splats))
    for name in ("means", "quats", "scales", "density", "covariances"):
        one, other = getattr(whole, name), getattr(in_steps, name)
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(section_density(in_steps, plane), image)
    shares = list(section_numpy.section_in_steps(splats, plane))
    assert shares == sorted(shares)
    assert len(shares) > count / 16
