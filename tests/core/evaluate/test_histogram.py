"""Normal orientation histograms on a Fibonacci sphere."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.evaluate.histogram import (
    fibonacci_sphere,
    normal_histogram,
    spherical_occupancy,
    total_variation,
)


@pytest.mark.parametrize("count", [42, 242])
def test_directions_are_unit_and_evenly_spread(count):
    directions = fibonacci_sphere(count)
    assert np.allclose(np.linalg.norm(directions, axis=1), 1.0)
    cosines = directions @ directions.T - 2 * np.eye(count)
    nearest = np.degrees(np.arccos(np.clip(cosines.max(axis=1), -1, 1)))
    assert nearest.min() > 0.6 * nearest.max()


@pytest.mark.parametrize("count", [42, 242])
def test_normals_of_a_ball_fill_all_directions_about_evenly(count):
    normals = np.random.default_rng(0).normal(size=(60_000, 3))
    histogram = normal_histogram(normals, count)
    assert histogram.sum() == pytest.approx(1.0)
    assert spherical_occupancy(histogram) == 1.0
    assert histogram.min() > 0.5 / count


def test_a_box_takes_six_directions_weighted_by_area():
    normals = np.concatenate([np.eye(3), -np.eye(3)])
    histogram = normal_histogram(normals, 242, weights=np.array([3.0, 1, 1, 1, 1, 1]))
    assert (histogram > 0).sum() == 6
    assert histogram.max() == pytest.approx(3 / 8)


def test_normals_without_a_direction_are_left_out():
    normals = np.array([[0.0, 0, 1], [0, 0, 0], [np.nan, 0, 0]])
    assert normal_histogram(normals, 42).max() == 1.0
    with pytest.raises(ValueError, match="direction"):
        normal_histogram(normals[1:], 42)


def test_distances_go_from_equal_to_disjoint():
    first, second = np.array([0.5, 0.5, 0, 0]), np.array([0, 0, 0.5, 0.5])
    assert (total_variation(first, first), total_variation(first, second)) == (0.0, 1.0)
