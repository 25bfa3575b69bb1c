"""The course of a run: what was kept back, by seconds of the run."""

import numpy as np
import pytest
from PIL import Image

from insideout.core.evaluate.curve import KINDS, draw_curve, run_curve
from insideout.core.plotting import COLORS


def point(iteration, seconds, **decibels):
    return {"iteration": iteration, "seconds": seconds, "splats": 10 * iteration, **decibels}


@pytest.fixture
def stages():
    return {
        "initialize": {"seconds": 5.0},
        "surface": {
            "seconds": 40.0,
            "rgb": {"heldout": [point(10, 9.0, photos=20.0), point(20, 15.0, photos=25.0)]},
            "xray": {"heldout": [point(10, 25.0, projections=30.0), point(20, 44.0, projections=41.0)]},
            "splats": {"rgb": 3, "xray": 5},
        },
        "align": {"skipped": "no reason", "seconds": 0.0},
        "internal": {"seconds": 15.0, "joint": {"heldout": [point(9, 59.0, photos=26.0, projections=42.0)]}},
    }


HELDOUT = {"photos": {"psnr": 27.0, "ssim": 0.9}, "projections": {"psnr": 42.5}, "sections": {"psnr": None}}


def test_points_are_in_the_order_of_their_seconds_and_the_finished_model_is_the_last(stages):
    curve = run_curve(stages, HELDOUT, 66.0)
    assert [(point["stage"], point["part"], point["seconds"]) for point in curve] == [
        ("surface", "rgb", 9.0),
        ("surface", "rgb", 15.0),
        ("surface", "xray", 25.0),
        ("surface", "xray", 44.0),
        ("internal", "joint", 59.0),
        ("report", "", 66.0),
    ]
    assert curve[-1] == {"stage": "report", "part": "", "seconds": 66.0, "photos": 27.0, "projections": 42.5}


def test_what_an_earlier_version_left_has_no_seconds_and_is_passed_over(stages):
    stages["surface"]["rgb"]["heldout"] = [[10, 20.0], [20, 25.0]]
    assert [point["part"] for point in run_curve(stages, {}, 66.0)] == ["xray", "xray", "joint"]


def test_a_figure_of_a_view_that_was_not_finite_is_left_out(stages, tmp_path):
    stages["surface"]["rgb"]["heldout"][0]["photos"] = None
    curve = run_curve(stages, HELDOUT, 66.0)
    assert "photos" not in curve[0]
    draw_curve(curve, tmp_path / "curve.png")
    assert (tmp_path / "curve.png").exists()


def test_the_plot_shows_every_point_in_the_colour_of_its_kind(stages, tmp_path):
    draw_curve(run_curve(stages, HELDOUT, 66.0), tmp_path / "curve.png")
    drawn = np.asarray(Image.open(tmp_path / "curve.png").convert("RGB")).reshape(-1, 3)
    for kind, color, points in zip(KINDS, COLORS, (4, 4, 0), strict=False):
        wanted = [int(color[place : place + 2], 16) for place in (1, 3, 5)]
        assert (drawn == wanted).all(axis=1).sum() >= 40 * points, kind
        assert points or not (drawn == wanted).all(axis=1).any(), kind


def test_a_run_that_could_measure_nothing_has_an_empty_plot(tmp_path):
    assert run_curve({"initialize": {"seconds": 1.0}}, {}, 1.0) == []
    draw_curve([], tmp_path / "curve.png")
    assert Image.open(tmp_path / "curve.png").size == (1000, 560)
