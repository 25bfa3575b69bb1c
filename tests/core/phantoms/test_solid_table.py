"""Tabulated solids and bent bars: true distances to surfaces that have no formula for them."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.phantoms.solid_table import SolidTable, Wire, curve, inside_only, loft


@pytest.fixture(scope="module")
def points():
    return np.random.default_rng(0).uniform(-10, 10, (20_000, 3)).astype(np.float32)


@pytest.fixture(scope="module")
def ball():
    """A ball of 8 mm given by a function whose slope is far from one."""
    return SolidTable.of(lambda p: np.linalg.norm(p, axis=1) ** 2 / 8 - 8, (-11, -11, -11), (11, 11, 11))


def test_distances_are_true_whatever_the_implicit_functions_slope(ball, points):
    true = np.linalg.norm(points, axis=1) - 8
    away_from_the_middle = np.linalg.norm(points, axis=1) > 2
    np.testing.assert_allclose(ball.distance(points)[away_from_the_middle], true[away_from_the_middle], atol=0.06)
    near = np.abs(true) < 1
    np.testing.assert_allclose(ball.distance(points)[near], true[near], atol=0.03)


def test_beyond_the_table_distances_are_too_small_never_too_large(ball):
    far = np.array([[30, 0, 0], [0, -25, 14], [12, 12, 12]], np.float32)
    true = np.linalg.norm(far, axis=1) - 8
    found = ball.distance(far)
    assert np.all(found > 1)
    assert np.all(found < true)


def test_a_wall_of_constant_thickness_can_be_cut_from_a_loft():
    sections = np.array([[-9, 4, 3, 3], [0, 7, 4, 6], [9, 5, 5, 5]], float)
    table = SolidTable.of(loft(sections, 2.5), (-10, -10, -12), (10, 10, 12), 0.5)
    angle = np.linspace(0, 2 * np.pi, 50)
    start = np.stack([0.2 * np.cos(angle), 0.2 * np.sin(angle), np.full(50, 2.0)], axis=1)
    steps = np.arange(0, 10, 0.01)
    line = start[:, None] + steps[:, None] * (start * [5, 5, 0])[:, None]
    value = table.distance(line.reshape(-1, 3).astype(np.float32)).reshape(50, -1)
    surface = line[np.arange(50), np.argmax(value > 0, axis=1)]
    inner = line[np.arange(50), np.argmax(value > -1.5, axis=1)]
    gaps = np.linalg.norm(surface[:, None] - inner[None], axis=-1).min(axis=0)
    np.testing.assert_allclose(gaps, 1.5, atol=0.12)


def test_a_loft_is_cut_flat_and_has_its_sections_widths():
    implicit = loft(np.array([[-5, 3, 2, 4], [5, 3, 2, 4]], float), 2.0, center_y=1.0)
    edges = np.array([[3, 1, 0], [-3, 1, 2], [0, -1, 0], [0, 5, -3], [0, 1, 5], [0, 1, -5]], np.float32)
    np.testing.assert_allclose(implicit(edges), 0, atol=1e-3)


def test_a_wire_has_its_radius_and_ends_at_its_reach(points):
    wire = Wire([np.array([[0, 0, -20.0], [0, 0, 20.0]])], 0.5, reach=6.0)
    true = np.minimum(np.hypot(points[:, 0], points[:, 1]), 6.0) - 0.5
    np.testing.assert_allclose(wire.distance(points), true, atol=0.02)


def test_a_curve_passes_its_points():
    knots = [[0, 0, 0], [1, 2, 0], [3, 2, 1], [4, 0, 0]]
    path = curve(knots, 400)
    for knot in knots:
        assert np.linalg.norm(path - knot, axis=1).min() < 0.02


def test_detail_is_asked_for_inside_its_guard_only(ball, points):
    asked = []

    def detail(inner):
        asked.append(inner)
        return np.linalg.norm(inner, axis=1) - 2

    found = inside_only(ball.distance, detail, 6.0)(points)
    true = np.linalg.norm(points, axis=1) - 2
    assert np.linalg.norm(asked[0], axis=1).max() < 8.1
    assert np.all(found < true + 0.1)
    assert np.array_equal(found < 0, true < 0)
