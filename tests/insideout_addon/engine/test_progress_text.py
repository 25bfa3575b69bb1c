"""The words and curves of a running job."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest

from insideout.insideout_addon.engine.progress_text import Curve, duration, headline, rows, sparkline, stage_lines


def _state(**changes):
    state = {
        "title": "Reconstructing",
        "stage": "surface",
        "part": "rgb",
        "fraction": 0.456,
        "seconds_left": -1.0,
        "iteration": 0,
        "iterations": 0,
        "splats": 0,
        "loss": 0.0,
        "loss_curve": "",
        "heldout_psnr": 0.0,
        "message": "",
        "stages": {},
    }
    return SimpleNamespace(**{**state, **changes})


def test_the_headline_says_where_in_the_run_it_is():
    assert headline(_state()) == "Surface photos (2 of 5)  46 %"
    assert headline(_state(stage="capture", part="")) == "Capture  46 %"
    assert headline(_state(stage="", part="", fraction=0)) == "Reconstructing  0 %"


def test_the_rows_stay_the_same_whatever_is_known():
    full = _state(
        iteration=1500,
        iterations=3000,
        splats=25722,
        loss=0.03214,
        loss_curve="█▁",
        heldout_psnr=26.54,
    )
    assert rows(full) == [
        ("Iteration", "1,500 of 3,000"),
        ("Splats", "25,722"),
        ("Loss", "0.0321  █▁"),
        ("Kept Back", "26.5 dB"),
    ]
    assert rows(_state()) == [(name, "–") for name, _ in rows(full)]


def test_each_stage_has_its_line_from_the_start():
    assert [text for _, _, text in stage_lines(_state(), running=False)] == [
        "Initialize", "Surface", "Align", "Internal", "Fuse", "Report",
    ]  # fmt: skip
    stages = {
        "initialize": SimpleNamespace(state="done", seconds=75.0),
        "surface": SimpleNamespace(state="started", seconds=0.0),
    }
    state = _state(stages=stages, seconds_left=61, heldout_psnr=26.54)
    assert stage_lines(state, running=True)[:3] == [
        ("initialize", "done", "Initialize  1 min 15 s"),
        ("surface", "started", "Surface  1 min 1 s left, 26.5 dB"),
        ("align", "", "Align"),
    ]
    assert stage_lines(state, running=False)[1] == ("surface", "started", "Surface")


def test_a_sparkline_goes_from_the_lowest_block_to_the_highest():
    assert sparkline([0, 1, 2, 3, 4, 5, 6, 7]) == "▁▂▃▄▅▆▇█"
    assert sparkline([5.0, 5.0, 5.0]) == "▁▁▁"
    assert sparkline([3.0]) == sparkline([]) == sparkline([math.nan, 1.0]) == ""


def test_a_long_sparkline_is_averaged_in_even_groups():
    line = sparkline([0.0] * 50 + [1.0] * 50, columns=10)
    assert line == "▁" * 5 + "█" * 5


def test_a_curve_keeps_its_shape_however_long_the_run():
    """A straight fall over 100,000 values draws as one over 16 does."""
    long, short = Curve(), Curve()
    for index in range(100_000):
        long.add(100_000.0 - index)
    for index in range(16):
        short.add(16.0 - index)
    assert len(long._values) < 400
    heights = ["▁▂▃▄▅▆▇█".index(block) for block in long.line()]
    assert heights == sorted(heights, reverse=True)
    assert (heights[0], heights[-1]) == (7, 0)
    assert long.newest == 1.0
    assert short.line() == "█▇▆▅▄▃▂▁"


def test_a_curve_passes_over_what_is_no_number():
    curve = Curve(logarithmic=True)
    for value in (None, math.nan, math.inf, 0.1, 0.01, 0.001):
        curve.add(value)
    assert curve.newest == 0.001
    assert curve.line() == "█▅▁"


@pytest.mark.parametrize(("seconds", "text"), [(0.4, "0 s"), (45, "45 s"), (200, "3 min 20 s"), (7500, "2 h 5 min")])
def test_durations(seconds, text):
    assert duration(seconds) == text
