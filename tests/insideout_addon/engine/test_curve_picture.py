"""The picture of a run's curve: what is drawn where, in which colour."""

from __future__ import annotations

import math

import numpy as np
import pytest

from insideout.insideout_addon.engine.curve_picture import (
    BETWEEN_STAGES,
    COLORS,
    GRID,
    GROUND,
    MARK_SIDE,
    SIDE,
    CurvePoint,
    curve_points,
    draw_mark,
    draw_picture,
    levels,
    newest,
    shown_kinds,
)


def _row(values, kind="photos", stage="surface", part="rgb", first=10.0):
    """Points 10 s apart as `report.json` has them."""
    place = {"stage": stage, "part": part}
    return [{**place, "seconds": first + 10 * number, kind: value} for number, value in enumerate(values)]


def _pixels(content, color):
    """Where the picture has a colour: x from the left and y from below, as shares of its side."""
    picture = draw_picture(curve_points(content))
    y, x = np.nonzero(np.abs(picture[..., :3] - np.float32(color)).max(axis=-1) < 0.01)
    return (x + 0.5) / SIDE, (y + 0.5) / SIDE


def _height(content, kind, share):
    """How high a kind's line is at a share of the width."""
    x, y = _pixels(content, COLORS[kind])
    return float(y[np.abs(x - share) < 0.01].mean())


def test_the_line_of_what_gets_better_goes_up():
    rising = _row([20.0, 25.0, 30.0, 35.0])
    heights = [_height(rising, "photos", share) for share in (0.3, 0.5, 0.7, 0.95)]
    assert heights == sorted(heights)
    assert heights[-1] - heights[0] > 0.4
    falling = _row([35.0, 30.0, 25.0, 20.0])
    assert _height(falling, "photos", 0.3) > _height(falling, "photos", 0.95) + 0.4


def test_the_line_begins_where_its_seconds_are_and_ends_at_the_right():
    """The run began at 0 s: half of the width is before the first of points at 30 s and 60 s."""
    x, _ = _pixels(
        [{"stage": "surface", "part": "rgb", "seconds": s, "photos": 30.0} for s in (30, 60)], COLORS["photos"]
    )
    assert x.min() == pytest.approx(0.5, abs=0.03)
    assert x.max() > 0.95


def test_a_value_lies_in_the_strip_that_the_panel_writes_its_level_into():
    """Of n strips one above another the lowest is that of the lowest level."""
    content = _row([20.0, 20.0, 30.0, 30.0, 40.0, 40.0])
    assert levels(curve_points(content)) == [20.0, 25.0, 30.0, 35.0, 40.0]
    for value, share, middle in ((20.0, 0.25, 0.1), (30.0, 0.58, 0.5), (40.0, 0.92, 0.9)):
        assert _height(content, "photos", share) == pytest.approx(middle, abs=0.02), value
    x, y = _pixels(content, GRID)
    assert np.abs(y[:, None] - [0.1, 0.3, 0.5, 0.7, 0.9]).min(axis=1).max() < 0.01
    assert {round(height, 1) for height in y[x < 0.1].tolist()} == {0.1, 0.3, 0.5, 0.7, 0.9}


def test_photos_and_projections_have_a_line_each():
    content = _row([20.0, 22.0]) + _row([40.0, 42.0], "projections", part="xray", first=10.0)
    assert _height(content, "projections", 0.7) > _height(content, "photos", 0.7) + 0.5


def test_sections_have_the_line_of_projections_where_there_are_none():
    sections = _row([20.0, 22.0], "sections", "internal", "xray")
    assert shown_kinds(curve_points(sections)) == ("photos", "sections")
    assert len(_pixels(sections, COLORS["sections"])[0]) > 100
    both = sections + _row([40.0, 42.0], "projections")
    assert shown_kinds(curve_points(both)) == ("photos", "projections")
    assert len(_pixels(both, COLORS["sections"])[0]) == 0


def test_a_thin_line_stands_between_stages_and_none_between_parts_of_one():
    one = _row([20.0, 30.0]) + _row([25.0, 35.0], "projections", part="xray", first=30.0)
    assert len(_pixels(one, BETWEEN_STAGES)[0]) == 0
    two = one + _row([31.0, 32.0], stage="internal", part="joint", first=60.0)
    x, y = _pixels(two, BETWEEN_STAGES)
    assert x.max() - x.min() < 0.02
    assert x.mean() == pytest.approx(60 / 70, abs=0.03)
    assert y.min() < 0.01
    assert y.max() > 0.99


def test_the_finished_model_has_a_larger_mark_and_no_line_before_it():
    content = [*_row([30.0, 30.0]), {"stage": "report", "part": "", "seconds": 40.0, "photos": 30.0}]
    assert len(_pixels(content, BETWEEN_STAGES)[0]) == 0
    x, y = _pixels(content, COLORS["photos"])
    last, before = y[x > 0.93], y[np.abs(x - 0.5) < 0.012]
    assert np.ptp(last) > 1.3 * np.ptp(before)


def test_no_points_are_an_empty_grid():
    picture = draw_picture(())
    assert picture.shape == (SIDE, SIDE, 4)
    assert (picture[..., 3] == 1.0).all()
    colors = np.unique(picture[..., :3].reshape(-1, 3).round(2), axis=0)
    assert {tuple(color) for color in colors.tolist()} <= {
        tuple(np.float32(GROUND).round(2).tolist()),
        tuple(np.float32(GRID).round(2).tolist()),
    }


def test_one_point_is_a_mark():
    x, y = _pixels(_row([28.4]), COLORS["photos"])
    assert 20 < len(x) < 300
    assert 0.0 < y.min() < y.max() < 1.0


def test_equal_values_are_a_level_line_in_the_middle():
    x, y = _pixels(_row([30.0, 30.0, 30.0]), COLORS["photos"])
    assert levels(curve_points(_row([30.0, 30.0, 30.0]))) == [29.0, 30.0, 31.0]
    assert y.mean() == pytest.approx(0.5, abs=0.01)
    assert np.ptp(x) > 0.5


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, None, "30", True, [30.0]])
def test_what_is_no_finite_number_is_passed_over(bad):
    whole = _row([20.0, 25.0, 30.0])
    figure, time = dict(whole[1]), dict(whole[1])
    figure["photos"], time["seconds"] = bad, bad
    for broken in (figure, time):
        kept = curve_points([whole[0], broken, whole[2]])
        assert [point.photos for point in kept] == [20.0, 30.0]
        assert np.isfinite(draw_picture(kept)).all()


@pytest.mark.parametrize("content", [None, 3, "curve", {}, [None, 3, "x", {}, [1]], [{"seconds": 3.0}]])
def test_what_is_no_curve_has_no_points(content):
    assert curve_points(content) == ()


def test_points_are_in_the_order_of_their_seconds():
    """Parts tell theirs one after another, and a stage that was kept all at once."""
    content = _row([20.0, 30.0]) + _row([40.0], "projections", part="xray", first=15.0)
    assert [point.seconds for point in curve_points(content)] == [10.0, 15.0, 20.0]
    assert newest(curve_points(content), "photos") == 30.0
    assert newest(curve_points(content), "projections") == 40.0
    assert newest(curve_points(content), "sections") is None


@pytest.mark.parametrize("values", [(22.7, 42.2), (28.1, 28.4), (-3.0, 7.0), (30.0, 30.0), (0.0, 120.0), (5e3, 1e6)])
def test_levels_are_round_and_enclose_all_values(values):
    found = levels([CurvePoint("surface", "rgb", float(s), photos=v) for s, v in enumerate(values)])
    assert 3 <= len(found) <= 6
    assert found[0] <= min(values) <= max(values) <= found[-1]
    step = found[1] - found[0]
    assert np.allclose(np.diff(found), step)
    assert f"{step:.0e}"[0] in "125"


def test_marks_are_told_apart_without_colours():
    shapes = [draw_mark(kind)[..., 3] > 0.5 for kind in ("photos", "projections")]
    assert all(shape.shape == (MARK_SIDE, MARK_SIDE) for shape in shapes)
    assert np.logical_xor(*shapes).sum() > 0.1 * shapes[0].sum()
    assert (draw_mark("photos")[0, 0] == 0).all()
