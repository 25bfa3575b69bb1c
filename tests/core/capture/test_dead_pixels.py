"""Pixels that do not see the X-rays are told from metal that lets nothing through, in line integrals, too."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.capture.dead_pixels import stuck_pixels

NOTHING = np.float32(-np.log(1e-6))


@pytest.fixture
def lines():
    """Line integrals of twelve views, up to 3."""
    return np.random.default_rng(0).uniform(0, 3, (12, 20, 24)).astype(np.float32)


def test_pixels_at_the_largest_value_of_all_views_are_stuck(lines):
    """One, and a column two pixels wide."""
    stuck = np.zeros((20, 24), bool)
    stuck[5, 7] = stuck[:, 15:17] = True
    lines[:, stuck] = NOTHING
    np.testing.assert_array_equal(stuck_pixels(lines), stuck)
    np.testing.assert_array_equal(stuck_pixels(iter(lines)), stuck)


def metal_on_the_axis(lines):
    lines[:, 5:8, 7:10] = NOTHING


def metal_that_starves_a_ray_now_and_then(lines):
    lines[:, 5, 7] = lines[4, 12, 3] = NOTHING


def metal_that_is_nearly_as_deep_elsewhere(lines):
    lines[:, 5, 7], lines[4, 12, 3] = NOTHING, 0.7 * NOTHING


def a_wire_on_the_axis_without_noise(lines):
    lines[:, 5:15, 11] = 6.0


def a_pixel_that_sees_once(lines):
    lines[:, 5, 7], lines[3, 5, 7] = NOTHING, 1.0


def another_value_in_each_view(lines):
    lines[:, 5, 7] = NOTHING + 0.01 * np.arange(12)


@pytest.mark.parametrize(
    "measured",
    [
        metal_on_the_axis,
        metal_that_starves_a_ray_now_and_then,
        metal_that_is_nearly_as_deep_elsewhere,
        a_wire_on_the_axis_without_noise,
        a_pixel_that_sees_once,
        another_value_in_each_view,
    ],
)
def test_what_may_be_measured_is_not_stuck(measured, lines):
    measured(lines)
    assert not stuck_pixels(lines).any()


def test_a_ball_on_the_axis_is_not_stuck_where_it_is_thickest():
    """All of its views are the same."""
    rows, columns = np.mgrid[:21, :21] - 10
    ball = 12 * np.sqrt(np.maximum(1 - (rows**2 + columns**2) / 64, 0))
    assert not stuck_pixels(np.broadcast_to(ball.astype(np.float32), (12, 21, 21))).any()


def test_fewer_than_eight_views_do_not_tell(lines):
    lines[:, 5, 7] = NOTHING
    assert not stuck_pixels(lines[:7]).any()
    assert stuck_pixels(lines[:8]).sum() == 1
