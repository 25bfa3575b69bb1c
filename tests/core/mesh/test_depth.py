"""Depth under the outermost surface, against shapes whose distance has a formula."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import erf

from insideout.core.errors import SettingError
from insideout.core.mesh.depth import depth_under_surface
from insideout.core.volume import Volume

DENSE = 0.02


def _sampled(distance, voxel_mm, half_mm=12.0, blur_mm=None):
    """A volume of what lies where a distance (points (..., 3) -> (...,), mm, above 0 inside) is positive."""
    count = int(np.ceil(2 * half_mm / np.min(voxel_mm)))
    grid = Volume.centered(np.zeros((count,) * 3), np.broadcast_to(voxel_mm, 3))
    places = [grid.origin_mm[axis] + grid.spacing_mm[axis] * np.arange(count) for axis in range(3)]
    points = np.stack(np.meshgrid(*places, indexing="ij"), axis=-1).swapaxes(0, 2)
    blur = np.mean(voxel_mm) if blur_mm is None else blur_mm
    return Volume.centered(DENSE * 0.5 * (1 + erf(distance(points) / (np.sqrt(2) * blur))), grid.spacing_mm)


def _points(count=4000, half_mm=12.0):
    return np.random.default_rng(3).uniform(-half_mm, half_mm, (count, 3))


def _ball(points, radius=10.0, center=(0.31, -0.17, 0.23)):
    return radius - np.linalg.norm(points - np.array(center), axis=-1)


@pytest.mark.parametrize("voxel_mm", [1.0, 0.5, 0.3])
def test_in_a_ball_it_is_the_radius_less_the_way_to_the_middle(voxel_mm):
    points = _points()
    error = depth_under_surface(_sampled(_ball, voxel_mm), DENSE / 2, points) - np.maximum(_ball(points), 0)
    assert np.abs(error).max() < 0.5 * voxel_mm
    assert np.sqrt(np.mean(error**2)) < 0.1 * voxel_mm


def test_an_edge_as_sharp_as_a_voxel_costs_no_more_than_half_of_one():
    points = _points()
    found = depth_under_surface(_sampled(_ball, 0.5, blur_mm=0.1), DENSE / 2, points)
    assert np.abs(found - np.maximum(_ball(points), 0)).max() < 0.25


def test_inner_shells_count_from_the_outermost_surface():
    def shells(points):
        return np.max([np.minimum(_ball(points, r), -_ball(points, r - 1.5)) for r in (10, 7, 4)], axis=0)

    points = _points()
    found = depth_under_surface(_sampled(shells, 0.3), DENSE / 2, points)
    assert np.abs(found - np.maximum(_ball(points), 0)).max() < 0.15


def test_voxels_may_be_oblong():
    points = _points()
    spacing = np.array([0.4, 0.5, 0.7])
    found = depth_under_surface(_sampled(_ball, spacing, blur_mm=0.5, half_mm=14.0), DENSE / 2, points)
    assert np.abs(found - np.maximum(_ball(points), 0)).max() < 0.35


def test_a_slanted_slab_has_the_distance_to_its_nearer_face():
    normal = np.array([1.0, 2.0, -0.7]) / np.linalg.norm([1.0, 2.0, -0.7])

    def slab(points):
        return np.minimum(4 - np.abs(points @ normal), 9 - np.abs(points).max(axis=-1))

    points = _points(half_mm=4.0)
    found = depth_under_surface(_sampled(slab, 0.4), DENSE / 2, points)
    assert np.abs(found - np.maximum(4 - np.abs(points @ normal), 0)).max() < 0.2


def _hollow_with_a_bore(width_mm):
    def shape(points):
        wall = np.minimum(_ball(points, 10, (0, 0, 0)), -_ball(points, 7, (0, 0, 0)))
        bore = width_mm / 2 - np.abs(points[..., :2]).max(axis=-1)
        return np.where(points[..., 2] > 0, np.minimum(wall, -bore), wall)

    return shape


def test_through_a_narrow_bore_nothing_gets_in():
    """What is a voxel and a half wide and blurred may be a seam, or nothing."""
    volume = _sampled(_hollow_with_a_bore(0.75), 0.5, blur_mm=0.05)
    assert depth_under_surface(volume, DENSE / 2, np.zeros((1, 3)))[0] == pytest.approx(10, abs=0.5)


def test_what_is_joined_with_outside_by_a_wide_bore_is_outside():
    volume = _sampled(_hollow_with_a_bore(3.0), 0.5, blur_mm=0.05)
    inside_the_hollow, in_the_wall = depth_under_surface(volume, DENSE / 2, [[0, 0, 0], [0, 0, -8.0]])
    assert inside_the_hollow == 0
    assert in_the_wall == pytest.approx(1, abs=0.25), "its nearest surface is that of the hollow"


def test_material_at_the_border_of_the_volume_ends_there():
    block = Volume.centered(np.full((9, 9, 9), DENSE), np.ones(3))
    found = depth_under_surface(block, DENSE / 2, [[0, 0, 0], [3.0, 0, 0], [6.0, 0, 0]])
    np.testing.assert_allclose(found, [4.5, 1.5, 0], atol=0.2)


def test_no_points_have_no_depth():
    assert depth_under_surface(_sampled(_ball, 1.0), DENSE / 2, np.zeros((0, 3))).shape == (0,)


def test_a_level_that_nothing_reaches_is_refused():
    with pytest.raises(SettingError, match="lower the level"):
        depth_under_surface(_sampled(_ball, 1.0), 0.05, np.zeros((1, 3)))
