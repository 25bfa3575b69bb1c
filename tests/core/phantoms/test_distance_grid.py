"""Rays through a tabulated distance: hits as geometry has them."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.phantoms.distance_grid import DistanceGrid

CENTER, RADIUS = np.array([2.0, -1.0, 3.0]), 12.0


def ball(points):
    return np.linalg.norm(points - CENTER.astype(np.float32), axis=1) - np.float32(RADIUS)


@pytest.fixture(scope="module")
def rays():
    rng = np.random.default_rng(2)
    origins = rng.uniform([70, -10, -10], [90, 10, 10], (3000, 3))
    directions = rng.uniform(-12, 12, (3000, 3)) - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def exact_half_chord(origins, directions, radius):
    toward = CENTER - origins
    along = (toward * directions).sum(axis=1)
    squared = radius**2 - ((toward**2).sum(axis=1) - along**2)
    return np.sqrt(np.maximum(squared, 0)), along


def test_first_hits_lie_on_the_near_side(rays):
    grid = DistanceGrid.bake(ball, np.array([30.0, 30.0, 32.0]), 0.5)
    half, along = exact_half_chord(*rays, RADIUS)

    hits = grid.first_hits(*rays)

    sure = half > 6
    np.testing.assert_allclose(hits[sure], (along - half)[sure], atol=0.015)
    assert np.all(np.isinf(hits[half == 0]))


def test_normals_of_a_ball(rays):
    grid = DistanceGrid.bake(ball, np.array([30.0, 30.0, 32.0]), 0.5)
    unit = rays[1]

    np.testing.assert_allclose(grid.normals(CENTER + RADIUS * unit), unit, atol=0.01)


def test_nothing_in_the_box_is_nothing_to_hit(rays):
    grid = DistanceGrid.bake(lambda points: np.full(len(points), 50.0, np.float32), np.array([30.0] * 3), 0.5)

    assert np.all(np.isinf(grid.first_hits(*rays)))


def test_light_is_blocked_behind_and_open_in_front():
    grid = DistanceGrid.bake(ball, np.array([30.0, 30.0, 32.0]), 0.5)
    toward = np.array([0.0, 0.0, 1.0])
    normals = np.stack([toward, -toward])
    points = CENTER + RADIUS * normals

    lit = grid.light(points, normals, toward, 0.1)

    assert lit[0] == pytest.approx(1.0)
    assert lit[1] == pytest.approx(0.0)
    np.testing.assert_allclose(grid.openness(points, normals, 5.0), 1.0, atol=0.02)


def test_a_table_finer_than_its_coarse_search_is_as_true():
    def wire(points):
        return np.hypot(points[:, 0] - 3.3, points[:, 1] + 1.1) - np.float32(0.3)

    grid = DistanceGrid.bake(wire, np.array([10.0, 10.0, 4.0]), 0.08)

    nz, ny, nx = grid.values.shape
    axes = [grid.origin[k] + 0.08 * np.arange(n) for k, n in enumerate((nx, ny, nz))]
    near = np.stack(np.meshgrid(axes[0], axes[1], [0.0]), axis=-1).reshape(-1, 3)
    exact = wire(near).reshape(ny, nx)
    layer = grid.values[nz // 2]
    close = np.abs(exact) < 0.4
    np.testing.assert_allclose(layer[close], exact[close], atol=1e-4)
    assert np.array_equal(layer < 0, exact < 0)


def test_a_large_box_is_tabulated_no_finer_than_memory_allows():
    grid = DistanceGrid.bake(ball, np.array([60.0, 60.0, 60.0]), 0.05)

    assert grid.spacing > 0.05
    assert grid.values.size < 30_000_000
