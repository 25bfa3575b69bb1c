"""Forecasts as people read them."""

import pytest

from insideout.core.forecast.forecast import Forecast
from insideout.core.forecast.text import duration, forecast_lines
from insideout.core.settings import Settings


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (1, "5 s"),
        (42, "40 s"),
        (89, "90 s"),
        (100, "1.5 min"),
        (250, "4 min"),
        (700, "12 min"),
        (3500, "58 min"),
        (3600, "1 h"),
        (7900, "2 h 10 min"),
        (86_400, "24 h"),
    ],
)
def test_times_are_rounded_to_what_can_be_known(seconds, text):
    assert duration(seconds) == text


def test_a_line_says_what_takes_most_and_that_cameras_are_to_be_found():
    parts = {"surface rgb": 60.0, "surface xray": 120.0, "align": 10.0, "internal joint": 90.0}
    known, unknown = (Forecast(Settings.of("standard"), parts, cameras) for cameras in (False, True))
    expected = "standard: about 4.5 min (surface xray 2 min, internal joint 1.5 min, surface rgb 60 s)"
    assert forecast_lines([known]) == [expected]
    assert len(forecast_lines([unknown])) == 2
