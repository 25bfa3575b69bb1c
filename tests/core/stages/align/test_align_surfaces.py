"""What is compared: the outside of the volume, and the splats that lie on the object."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.errors import CaptureError
from insideout.core.gaussians import GaussianSet
from insideout.core.stages.align import surfaces
from insideout.core.stages.align.surfaces import _averaged, outer_surface, shell_points
from insideout.core.views import Camera
from insideout.core.volume import Volume


def _ball(size=48, outer=18.0, hollow=0.0, core=None, extent=60.0):
    axis = (np.arange(size) + 0.5) / size * extent - extent / 2
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    radius = np.sqrt(x * x + y * y + z * z)
    values = 0.03 * np.clip(0.5 + (outer - radius), 0, 1) * np.clip(0.5 + (radius - hollow), 0, 1)
    if core is not None:
        values = np.where(radius < core, 0.3, values)
    return Volume.centered(values.astype(np.float32), np.full(3, extent / size))


def test_points_lie_on_the_outer_surface_with_outward_normals():
    surface = outer_surface(_ball(), 3000, seed=0)
    radius = np.linalg.norm(surface.points, axis=1)
    assert np.abs(radius - 18.0).max() < 0.5
    assert ((surface.points / radius[:, None]) * surface.normals).sum(axis=1).min() > 0.95


def test_a_cavity_inside_is_not_part_of_the_outer_surface():
    surface = outer_surface(_ball(hollow=12.0), 3000, seed=0)
    assert np.linalg.norm(surface.points, axis=1).min() > 17.0
    assert np.linalg.norm(surface.vertices, axis=1).min() > 17.0


def test_a_heavy_core_does_not_hide_the_light_outside():
    volume = _ball(core=6.0)
    radius = np.linalg.norm(outer_surface(volume, 2000, seed=0).points, axis=1)
    assert radius.mean() == pytest.approx(18.0, abs=0.5)


def test_a_large_volume_is_averaged_down_in_place():
    fine = outer_surface(_ball(size=60), 2000, seed=0)
    coarse = outer_surface(_ball(size=60), 2000, seed=0, max_voxels=30)
    assert np.allclose(coarse.points.mean(axis=0), fine.points.mean(axis=0), atol=0.5)
    assert np.linalg.norm(coarse.points, axis=1).mean() == pytest.approx(18.0, abs=0.4)


def test_thick_slices_are_not_averaged_because_their_pixels_are_small():
    """512 x 512 pixels of 0.5 mm in 40 slices of 5 mm, smaller: the slices are what there is of the height."""
    fine = _ball(size=60)
    slices = fine.blocks((6, 1, 1))
    thick = outer_surface(slices, 2000, seed=0, max_voxels=30)
    assert thick.voxel == pytest.approx(6.0)
    for axis in range(3):
        assert np.ptp(thick.points[:, axis]) == pytest.approx(36.0, abs=4.0), axis
    # Voxels that are cubes stay cubes, however long the object is.
    long = Volume.centered(np.pad(fine.values, ((60, 60), (0, 0), (0, 0))), fine.spacing_mm)
    assert outer_surface(long, 2000, seed=0, max_voxels=90).voxel == pytest.approx(2.0)


@pytest.mark.parametrize("slices", [32, 30, 25])
def test_slices_that_blocks_leave_over_are_of_the_surface(slices):
    """80 x 60 pixels, averaged over 8 x 8 x 8: of 30 slices 6 were left over and cut off."""
    values = np.zeros((slices, 60, 80), np.float32)
    values[:, 10:50, 10:70] = 0.03
    volume = Volume(values, np.ones(3), np.full(3, 0.5))
    found, spacing, origin = _averaged(volume, 10)
    assert spacing.tolist() == [8.0] * 3
    assert found.sum() * 8**3 == pytest.approx(values.sum(), rel=1e-5)
    heights = origin[2] + 8 * np.arange(len(found))
    assert (found.sum(axis=(1, 2)) * heights).sum() / found.sum() == pytest.approx(slices / 2, abs=1.0)
    surface = outer_surface(volume, 2000, seed=0, max_voxels=10)
    # At so few voxels it is inflated, to both sides.
    assert surface.points[:, 2].min() + surface.points[:, 2].max() == pytest.approx(slices, abs=3.0)


def test_blocks_that_divide_the_voxels_are_averaged_as_they_are():
    volume = _ball(size=60)
    found, spacing, origin = _averaged(volume, 30)
    blocks = volume.blocks((2, 2, 2))
    np.testing.assert_array_equal(found, blocks.values)
    np.testing.assert_array_equal((spacing, origin), (blocks.spacing_mm, blocks.origin_mm))


@pytest.mark.parametrize("value", [0.0, 0.02])
def test_a_uniform_volume_is_a_capture_error(value):
    volume = Volume.centered(np.full((20, 20, 20), value, np.float32), np.ones(3))
    if value == 0.0:
        with pytest.raises(CaptureError, match="uniform"):
            outer_surface(volume, 1000, seed=0)
    else:
        # A block that fills the volume: its faces are the surface.
        assert len(outer_surface(volume, 1000, seed=0).points) == 1000


def test_faint_and_invisible_splats_are_left_out_and_too_few_are_an_error():
    random = np.random.default_rng(0)
    ball = random.normal(size=(2000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    opacities = np.where(np.arange(2000) < 1500, 0.8, 0.05)
    assert not shell_points(GaussianSet.create(ball, 0.02, opacities=opacities)).members[1500:].any()
    with pytest.raises(CaptureError, match="splats"):
        shell_points(GaussianSet.create(ball, 0.02, opacities=0.05))


def test_splats_inside_the_body_do_not_count_as_shell():
    random = np.random.default_rng(0)
    ball = random.normal(size=(6000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    ball[5500:] *= random.uniform(0.1, 0.6, (500, 1))
    members = shell_points(GaussianSet.create(ball, 0.02, opacities=0.8)).members
    assert members[:5500].mean() > 0.95
    assert members[5500:].mean() < 0.05


def test_splats_of_the_background_are_told_by_the_masks():
    random = np.random.default_rng(0)
    ball = random.normal(size=(2000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    wall = np.c_[random.uniform(-2, 2, (800, 2)), np.full(800, 1.6)]
    views = []
    for turn in range(6):
        angle = turn * np.pi / 3
        back = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        pose = np.eye(4)
        pose[:3, :3], pose[2, 3] = back, 5.0
        rows, columns = np.mgrid[:100, :100] + 0.5
        mask = np.hypot(rows - 50, columns - 50) < 100 / np.sqrt(24) + 0.5
        views.append((Camera(100, 100, 100, 100, 50, 50, pose), mask))
    rgb = GaussianSet.create(np.concatenate([ball, wall]), 0.02, opacities=0.8)
    members = shell_points(rgb, views).members
    assert members[:2000].mean() > 0.95
    assert not members[2000:].any()


def test_what_is_drawn_to_tell_the_object_from_its_room_follows_the_seed(monkeypatch):
    seeds = []

    def noted(points, cameras, seed=0):
        seeds.append(seed)
        return np.ones(len(points), bool)

    monkeypatch.setattr(surfaces, "on_the_object", noted)
    ball = np.random.default_rng(0).normal(size=(2000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    pose = np.eye(4)
    pose[2, 3] = 5.0
    shell_points(
        GaussianSet.create(ball, 0.02, opacities=0.8), [(Camera(100, 100, 100, 100, 50, 50, pose), None)], seed=3
    )
    assert seeds == [3]
