"""Distance, angle and area of points."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.errors import SettingError
from insideout.insideout_addon.measure.points import measure_points


def test_two_points_have_a_distance():
    measure = measure_points([[1, 2, 3], [4, 6, 15]])
    assert measure.length == pytest.approx(13.0)
    assert measure.angle_deg is None
    assert measure.area is None
    assert measure.text() == "13.00 mm"
    assert measure.text("") == "13.00"


def test_small_things_have_as_many_digits():
    assert measure_points([[0, 0, 0], [0, 0.034, 0]]).text() == "0.0340 mm"
    assert measure_points([[0.02, 0, 0], [0, 0, 0], [0, 0.03, 0]]).text() == "90.0°, 0.000300 mm²"
    assert measure_points([[1, 0, 0], [0, 0, 0], [3, 1e-12, 0]]).text() == "0.0°, 0.00 mm²"


@pytest.mark.parametrize("angle", [1e-6, 30.0, 90.0, 179.999999])
def test_three_points_have_the_angle_at_the_second_one(angle):
    turn = np.radians(angle)
    measure = measure_points([[7, 1, 2], [5, 1, 2], [5 + 3 * np.cos(turn), 1, 2 + 3 * np.sin(turn)]])
    assert measure.angle_deg == pytest.approx(angle, rel=1e-9)
    assert measure.area == pytest.approx(0.5 * 2 * 3 * np.sin(turn), rel=1e-9)
    assert measure.length == pytest.approx(5.0)


def test_three_points_are_told_with_both():
    points = np.array([[2.0, 0, 0], [0, 0, 0], [0, 3, 0]])
    measure = measure_points(points)
    assert measure.text() == "90.0°, 3.00 mm²"
    (corner, angle), (middle, area) = measure.labels(points)
    assert (angle, area) == ("90.0°", "3.00 mm²")
    assert corner.tolist() == [0, 0, 0]
    assert middle == pytest.approx([2 / 3, 1, 0])


def test_a_polygon_has_its_area_in_any_plane():
    shape = np.array([[0, 0], [4, 0], [4, 3], [2, 1], [0, 3]], float)
    right, up = np.array([2, 1, 2]) / 3, np.array([1, 2, -2]) / 3
    measure = measure_points(shape @ np.stack([right, up]) + [100, -50, 20])
    assert measure.area == pytest.approx(8.0)
    assert measure.angle_deg is None
    assert measure.text() == "8.00 mm²"


def test_an_angle_between_points_that_are_the_same_is_none():
    measure = measure_points([[1, 1, 1], [1, 1, 1], [2, 2, 2]])
    assert measure.angle_deg is None
    assert measure.text() == "0.00 mm²"


def test_one_point_measures_nothing():
    with pytest.raises(SettingError, match="select two"):
        measure_points([[1, 2, 3]])
    with pytest.raises(SettingError, match="no place"):
        measure_points([[1, 2, 3], [np.nan, 0, 0]])
