"""Progress goes out at a bearable rate, cancel comes in at once."""

import pytest

from insideout.core.errors import Cancelled
from insideout.core.progress import Progress, Reporter


def test_a_flood_is_thinned_but_news_gets_through():
    heard = []
    reporter = Reporter(heard.append)
    for iteration in range(1000):
        reporter.update(Progress("surface", "rgb", iteration / 1000, iteration))
    reporter.update(Progress("surface", "rgb", 0.5, heldout_psnr=30.0))
    reporter.update(Progress("surface", "rgb", 0.6, heldout=[{"seconds": 3.0, "projections": 31.0}]))
    reporter.update(Progress("surface", "xray", 0.1))
    reporter.update(Progress("surface", "xray", 1.0))
    assert len(heard) < 20
    assert [p.heldout_psnr for p in heard].count(30.0) == 1
    assert [p.to_json()["heldout"] for p in heard if p.heldout] == [[{"seconds": 3.0, "projections": 31.0}]]
    assert (heard[-2].part, heard[-1].fraction) == ("xray", 1.0)


def test_cancel_is_noticed_at_the_next_update():
    stop = []
    reporter = Reporter(is_cancelled=lambda: bool(stop))
    reporter.update(Progress("align"))
    stop.append(True)
    with pytest.raises(Cancelled):
        reporter.update(Progress("align"))


def test_a_part_of_the_work_tells_its_share_of_the_whole_and_hears_the_cancel():
    heard, stop = [], []
    part = Reporter(heard.append, lambda: bool(stop)).within(0.5, 0.7)
    for fraction, message in ((0.0, "begins"), (0.5, "goes on"), (1.0, "")):
        part.update(Progress("initialize", "fdk", fraction, message=message))
    assert [progress.fraction for progress in heard] == pytest.approx([0.5, 0.6])
    stop.append(True)
    with pytest.raises(Cancelled):
        part.check()


def test_messages_leave_out_what_is_not_known():
    assert Progress("align", loss=0.5).to_json() == {
        "stage": "align",
        "fraction": 0.0,
        "iteration": 0,
        "iterations": 0,
        "loss": 0.5,
    }
