"""What the skull and the clay figure share: they fit their box, rays find them, and colours and landmarks are sound."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import rotate
from scipy.spatial import cKDTree

from insideout.core.phantoms.distance_grid import DistanceGrid
from insideout.core.phantoms.skull import skull
from insideout.core.phantoms.terracotta import terracotta


@pytest.fixture(scope="module", params=[skull, terracotta], ids=["skull", "terracotta"])
def phantom(request):
    return request.param()


@pytest.fixture(scope="module")
def grid(phantom):
    return DistanceGrid.bake(phantom.surface, np.array(phantom.size_mm), 0.6)


@pytest.fixture(scope="module")
def rays(phantom):
    """Origins and unit directions of rays from around the object through points in its box."""
    rng = np.random.default_rng(4)
    half = 0.5 * np.array(phantom.size_mm)
    origins = rng.standard_normal((300, 3))
    origins *= 110 / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = rng.uniform(-0.8 * half, 0.8 * half, (300, 3)) - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.fixture(scope="module")
def marched(phantom, rays):
    """(rays, steps) distances along the rays every 0.2 mm, and the steps."""
    origins, directions = rays
    steps = np.arange(40, 180, 0.2)
    points = origins[:, None] + steps[None, :, None] * directions[:, None]
    return phantom.surface(points.reshape(-1, 3).astype(np.float32)).reshape(points.shape[:2]), steps


@pytest.fixture(scope="module")
def skin(phantom, grid):
    """Points all over the surface, and their normals."""
    rng = np.random.default_rng(6)
    away = rng.standard_normal((6000, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    half = 0.5 * np.array(phantom.size_mm)
    aims = rng.uniform(-0.7 * half, 0.7 * half, (6000, 3))
    reach = grid.first_hits(aims + 150 * away, -away)
    hit = np.isfinite(reach)
    points = (aims + (150 - np.where(hit, reach, 0))[:, None] * away)[hit]
    return points.astype(np.float32), grid.normals(points)


def test_nothing_leaves_the_box(phantom):
    half = 0.5 * np.array(phantom.size_mm)
    rng = np.random.default_rng(1)
    for axis in range(3):
        for side in (-1, 1):
            face = rng.uniform(-half, half, (3000, 3))
            face[:, axis] = side * half[axis]
            assert min(part.distance(face.astype(np.float32)).min() for part in phantom.parts) > 0


def test_the_box_is_not_much_larger_than_the_object(phantom, skin):
    points, _ = skin
    assert np.all(np.ptp(points, axis=0) > 0.85 * np.array(phantom.size_mm))


def test_rays_tunnel_through_no_wall(phantom, grid, rays, marched):
    """Steps of 0.8 of the distance never jump over a solid that a march in steps of 0.2 mm finds 0.4 mm deep."""
    found = grid.first_hits(*rays)
    distances, steps = marched
    deep = distances < -0.4
    struck = deep.any(axis=1)

    assert struck.sum() > 150
    assert np.all(found[struck] <= steps[deep.argmax(axis=1)][struck] + 1e-3)


def test_rays_stop_at_the_surface_and_nowhere_else(phantom, grid, rays):
    origins, directions = rays
    found = grid.first_hits(origins, directions)
    hit = np.isfinite(found)
    points = origins[hit] + found[hit, None] * directions[hit]
    assert np.quantile(np.abs(phantom.surface(points.astype(np.float32))), 0.98) < 0.12


def test_distances_never_say_much_more_than_the_way_to_the_surface(phantom, grid):
    """The nearest of many points at most 0.2 mm off the surface is no nearer than the surface itself less 0.2 mm."""
    nodes = np.argwhere(np.abs(grid.values) < 0.2)[:, ::-1] * grid.spacing + grid.origin
    rng = np.random.default_rng(2)
    half = 0.5 * np.array(phantom.size_mm)
    points = rng.uniform(-half, half, (40_000, 3)).astype(np.float32)
    nearest, _ = cKDTree(nodes).query(points)

    excess = np.abs(phantom.surface(points)) / (nearest + 0.2)
    assert np.quantile(excess, 0.99) < 1.02
    assert excess.max() < 1.25


def test_surface_is_where_material_meets_the_air_outside(phantom, skin):
    points, normals = skin
    assert np.mean(phantom.attenuation(points - 0.35 * normals) > 0) > 0.985
    assert np.mean(phantom.attenuation(points + 0.35 * normals) == 0) > 0.97


def test_landmarks_are_distinct_points_on_the_surface(phantom):
    marks = phantom.landmarks
    assert 5 <= len(marks) <= 8
    assert np.abs(phantom.surface(marks.astype(np.float32))).max() < 0.05
    apart = np.linalg.norm(marks[:, None] - marks[None], axis=-1) + 100 * np.eye(len(marks))
    assert apart.min() > 8
    assert np.linalg.svd(marks - marks.mean(0), compute_uv=False)[2] > 5


def test_colors_are_in_range_and_vary(phantom, skin):
    points, normals = skin
    colors = phantom.color(points, normals)

    assert colors.shape == points.shape
    assert colors.min() >= 0
    assert colors.max() <= 1
    assert np.all(colors.std(axis=0) > 0.08)


def test_same_colors_whatever_else_is_painted(phantom, skin):
    points, normals = skin
    np.testing.assert_array_equal(phantom.color(points, normals)[:50], phantom.color(points[:50], normals[:50]))


def test_shape_and_color_decide_how_it_is_turned(phantom, skin):
    """Half a turn about z, and mirroring, both change it."""
    points, normals = skin
    for flip in ([-1, -1, 1], [-1, 1, 1]):
        other = points * np.array(flip, np.float32)
        shape = np.abs(phantom.surface(other)) > 0.3
        same = ~shape
        paint = np.abs(phantom.color(points[same], normals[same]) - phantom.color(other[same], normals[same])).mean()
        assert shape.mean() > 0.02 or paint > 0.02
    assert np.mean(np.abs(phantom.surface(points * np.array([-1, -1, 1], np.float32))) > 0.6) > 0.3


def test_energy_lets_enough_light_through_all_but_metal(phantom):
    """The largest line integral of what is not metal, over directions across z, is between 2 and 3."""
    spacing = 1.5
    axes = [np.arange(-0.5 * size, 0.5 * size, spacing, dtype=np.float32) for size in phantom.size_mm]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    values = phantom.attenuation(points)
    for part in phantom.parts:
        if part.material is not None and part.material.density_g_cm3 > 4:
            values[part.distance(points) < 0] = 0
    volume = values.reshape([len(axis) for axis in axes])
    turned = [rotate(volume, degrees, axes=(0, 1), order=1) for degrees in range(0, 180, 15)]
    largest = max(float(one.sum(axis=0).max()) * spacing for one in turned)
    assert 2.0 < largest < 3.1
