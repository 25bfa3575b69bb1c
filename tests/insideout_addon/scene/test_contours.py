"""Contours: where a section's values cross a level."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.insideout_addon.scene.contours import automatic_level, contour_lines, line_length, polygon_area


def _bump(radius=10.0, size=64, center=(30.5, 33.5)):
    y, x = np.mgrid[:size, :size] + 0.5
    return radius - np.hypot(x - center[0], y - center[1])


def test_a_disc_has_its_circle():
    lines = contour_lines(_bump(), 0.0)
    assert len(lines) == 1
    distance = np.hypot(*(lines[0] - [30.5, 33.5]).T)
    np.testing.assert_allclose(distance, 10.0, atol=0.02)
    assert polygon_area(lines[0]) == pytest.approx(np.pi * 100, rel=5e-3)
    assert line_length(lines[0]) == pytest.approx(2 * np.pi * 10, rel=5e-3)


def test_a_ring_has_two_contours_the_longest_first():
    y, x = np.mgrid[:64, :64] + 0.5
    r = np.hypot(x - 32, y - 32)
    lines = contour_lines(4 - np.abs(r - 16), 0.0)
    assert [round(np.hypot(*(line - 32).T).mean()) for line in lines] == [20, 12]


def test_a_line_that_leaves_the_image_is_open():
    (line,) = contour_lines(np.tile(np.arange(8.0), (6, 1)), 3.25)
    np.testing.assert_allclose(line[:, 0], 3.75)
    assert polygon_area(line) == 0.0
    assert line_length(line) == pytest.approx(5.0)


def test_flat_tiny_and_broken_images_have_no_contours():
    assert contour_lines(np.ones((5, 5)), 0.5) == []
    assert contour_lines(np.ones((1, 5)), 0.5) == []
    assert contour_lines(np.full((5, 5), np.nan), 0.5) == []


def test_saddles_are_joined_through_the_higher_middle():
    field = np.array([[1.0, -1.0], [-1.0, 1.0]])
    assert len(contour_lines(field + 0.1, 0.0)) == 2
    assert len(contour_lines(field - 0.1, 0.0)) == 2


def test_automatic_level_is_half_of_the_material():
    values = np.zeros((20, 20))
    values[5:15, 5:15] = 0.06
    assert automatic_level(values) == pytest.approx(0.03)
    assert automatic_level(np.zeros((4, 4))) == 0.0
