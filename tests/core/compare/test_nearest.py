"""Distances to a mesh are exact, whatever the sizes of its triangles."""

import numpy as np
import pytest
import trimesh

from insideout.core.compare.nearest import distances_to


def by_looking_at_all(triangles, points):
    """trimesh's closest points, on every triangle for every point."""
    found = []
    for point in points:
        nearest = trimesh.triangles.closest_point(triangles, np.tile(point, (len(triangles), 1)))
        found.append(np.linalg.norm(nearest - point, axis=1).min())
    return np.array(found)


@pytest.fixture(scope="module")
def mixed():
    """A fine ball beside one large sliver, over a floor of two triangles, and a triangle without an area."""
    ball = trimesh.creation.icosphere(3, 5.0)
    floor = np.array(
        [[[-90, -90, -20], [90, -90, -20], [90, 90, -20]], [[-90, -90, -20], [90, 90, -20], [-90, 90, -20]]]
    )
    sliver = np.array([[[-60, 6, 0], [60, 6, 0], [60, 6.2, 0]]])
    line = np.array([[[0, 0, 30], [4, 0, 30], [8, 0, 30]]])
    return np.concatenate([ball.triangles, floor, sliver, line]).astype(np.float64)


def test_they_are_those_of_looking_at_every_triangle(mixed):
    rng = np.random.default_rng(5)
    points = np.concatenate([rng.uniform(-30, 40, (150, 3)), rng.normal(size=(50, 3)) * 3, [[0, 0, 0], [4, 1, 31]]])
    np.testing.assert_allclose(distances_to(mixed, points), by_looking_at_all(mixed, points), rtol=0, atol=1e-9)


def test_a_large_triangle_is_found_behind_many_small_ones_whose_middles_are_nearer(mixed):
    # The middle of the sliver is 20 mm away, some five hundred of the ball's middles are nearer.
    near_the_sliver = np.array([[-2.0, 6.05, 0.5]])
    assert distances_to(mixed, near_the_sliver) < 0.6
    assert distances_to(mixed[:-2], near_the_sliver) > 1.2


@pytest.mark.parametrize("count", [1, 2, 7, 8, 9, 17])
def test_any_number_of_triangles_will_do(mixed, count):
    points = np.random.default_rng(count).uniform(-20, 20, (20, 3))
    some = mixed[:count]
    np.testing.assert_allclose(distances_to(some, points), by_looking_at_all(some, points), rtol=0, atol=1e-9)
