"""Plain solids have exact distances: checked against dense samples of their surfaces."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from insideout.core.phantoms import solids


@pytest.fixture(scope="module")
def points():
    return np.random.default_rng(0).uniform(-6, 6, (3000, 3)).astype(np.float32)


HOUSE = [(-3, -2), (3, -2), (3, 1), (0, 3), (-3, 1)]


def by_samples(points, distance):
    """|distance| found from where a fine grid changes sign, good to the grid's spacing."""
    axis = np.arange(-6.45, 6.5, 0.1)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    inside = distance(grid.reshape(-1, 3).astype(np.float32)).reshape(grid.shape[:3]) < 0
    changes = [
        grid[:-1][inside[1:] != inside[:-1]] + [0.05, 0, 0],
        grid[:, :-1][inside[:, 1:] != inside[:, :-1]] + [0, 0.05, 0],
        grid[:, :, :-1][inside[:, :, 1:] != inside[:, :, :-1]] + [0, 0, 0.05],
    ]
    return cKDTree(np.concatenate(changes)).query(points)[0]


@pytest.mark.parametrize(
    "distance",
    [
        lambda p: solids.box(p, (1, 0, -1), (2, 3, 1)),
        lambda p: solids.box(p, (1, 0, -1), (2, 3, 1), 0.8),
        lambda p: solids.disc(p, (0, 1, 0), 0, 3, 1),
        lambda p: solids.disc(p, (0, 1, 0), 1, 3, 1, 0.5),
        lambda p: solids.disc(p, (0, 0, 1), 2, 2, 2.5),
        lambda p: solids.rod(p, (-2, 0, 0), (3, 1, 1), 1, 1),
        lambda p: solids.plate(solids.polygon(p[:, 0], p[:, 2], HOUSE), p[:, 1], 1.0),
    ],
    ids=["box", "rounded box", "disc x", "rounded disc y", "disc z", "rod", "plate"],
)
def test_distance_is_that_to_the_surface(points, distance):
    np.testing.assert_allclose(np.abs(distance(points)), by_samples(points, distance), atol=0.09)


def test_a_tapered_rod_is_never_farther_than_told(points):
    def cone(p):
        return solids.rod(p, (-3, 0, 0), (3, 0, 0), 0.6, 2.4)

    outside = cone(points) > 0
    assert np.all(cone(points)[outside] < by_samples(points, cone)[outside] + 0.09)
    np.testing.assert_allclose(cone(np.array([[-3, 0.6, 0], [3, 0, 2.4]], np.float32)), 0, atol=1e-5)


def test_an_ellipsoid_has_its_surface_and_is_nowhere_much_deeper_or_farther_than_told(points):
    semi = np.array([5.0, 1.0, 2.5])

    def flat(p):
        return solids.ellipsoid(p, np.zeros(3), np.eye(3), semi)

    unit = points / np.linalg.norm(points, axis=1, keepdims=True)
    np.testing.assert_allclose(flat((unit * semi).astype(np.float32)), 0, atol=1e-4)
    assert np.all(np.abs(flat(points)) < 1.2 * by_samples(points, flat) + 0.12)
    assert flat(np.zeros((1, 3), np.float32))[0] == pytest.approx(-1.0)


def test_a_polygon_is_signed_by_its_inside():
    square = [(0, 0), (4, 0), (4, 4), (0, 4)]
    u, v = np.array([2.0, 5.0, -3.0, 4.0]), np.array([1.0, 2.0, -4.0, 2.0])
    np.testing.assert_allclose(solids.polygon(u, v, square), [-1, 1, 5, 0], atol=1e-6)


def test_a_concave_polygon_knows_its_inside():
    arrow = [(0, 0), (4, 4), (4, -4), (2, 0)]
    u, v = np.array([3.0, 1.5, 1.0, 3.0]), np.array([2.0, 0.5, 3.0, -3.0])
    assert (solids.polygon(u, v, arrow) < 0).tolist() == [True, True, False, False]


def test_boxed_detail_is_exact_near_its_box_and_a_lower_bound_elsewhere(points):
    def ball(p):
        return {"ball": np.linalg.norm(p - np.float32([1, 1, 1]), axis=1) - 1}

    found, true = solids.boxed(points, (0, 0, 0), (2, 2, 2), ball)["ball"], ball(points)["ball"]
    close = true < 1
    np.testing.assert_allclose(found[close], true[close])
    assert np.all(found <= true + 1e-5)


def test_folding_and_joining():
    folded = solids.mirrored(np.array([[-2.0, -3.0, 1.0]]))
    np.testing.assert_array_equal(folded, [[2.0, -3.0, 1.0]])
    joined = solids.joined([np.array([0.0, 5.0]), np.array([0.0, 1.0]), np.array([9.0, 9.0])], 1.0)
    np.testing.assert_allclose(joined, [-0.25, 1.0])
