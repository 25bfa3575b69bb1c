"""Axes put values where they belong, ticks are round numbers within the limits."""

import pytest
from PIL import Image, ImageDraw

from insideout.core.plotting import Axes, even_ticks, limits, log_ticks


def test_values_lie_between_the_corners_of_the_frame():
    axes = Axes(ImageDraw.Draw(Image.new("RGB", (10, 10))), (100, 20, 300, 220), (0.0, 50.0), (10.0, 20.0))
    assert axes.place(0, 10) == (100, 220)
    assert axes.place(50, 20) == (300, 20)
    assert axes.place(25, 12.5) == (200, 170)


@pytest.mark.parametrize(
    ("low", "high", "labels"),
    [
        (0, 76, ["0", "20", "40", "60"]),
        (20, 45, ["20", "25", "30", "35", "40", "45"]),
        (0, 0.9, ["0", "0.2", "0.4", "0.6", "0.8"]),
        (-1, 1, ["-1", "-0.5", "0", "0.5", "1"]),
        (3, 3, ["3"]),
    ],
    ids=str,
)
def test_even_ticks_are_few_and_round(low, high, labels):
    ticks = even_ticks(low, high)
    assert [label for _, label in ticks] == labels
    assert [value for value, _ in ticks] == pytest.approx([float(label) for label in labels])


def test_logarithmic_ticks_are_ones_and_threes_and_more_over_a_short_way():
    assert [label for _, label in log_ticks(0.9, 3.1)] == ["10", "30", "100", "300", "1000"]
    assert [label for _, label in log_ticks(1.5, 2.75)] == ["50", "100", "200", "500"]


@pytest.mark.parametrize(("values", "found"), [([31.2, 44.9], (30, 45)), ([30.0], (30, 35)), ([-2.0, 3.0], (-5, 5))])
def test_limits_leave_room_and_are_never_the_same(values, found):
    assert limits(values, 5.0) == found
