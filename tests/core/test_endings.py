"""What is said of a figure that was wanted and of a time that was given."""

from dataclasses import replace

import pytest

from insideout.core.capture.kept_back import photos_kept_back, projections_kept_back
from insideout.core.capture.model import Photos
from insideout.core.capture.read import read_capture
from insideout.core.endings import endings
from insideout.core.train.schedule import Until


def history(ended="", *photos):
    points = [{"iteration": place, "photos": value} for place, value in enumerate(photos)]
    return {"iterations": 50, "losses": [], "heldout": points, **({"ended": ended} if ended else {})}


REACHED, GIVEN_UP = "32 dB of photos: reached", "32 dB of photos: out of reach"


def test_a_figure_that_was_reached_is_no_warning_and_nor_is_what_was_given_up_before():
    stages = {"surface": {"rgb": history(GIVEN_UP, 20.0, 21.0)}, "internal": {"joint": history(REACHED, 32.5)}}
    kept, broken = endings(stages, Until("photos", 32.0), 100.0, None)
    assert kept == [
        f"surface rgb: ended after 50 steps, {GIVEN_UP}",
        f"internal joint: ended after 50 steps, {REACHED}",
    ]
    assert broken == []


def test_steps_that_were_left_out_for_the_time_are_counted():
    fewer = {**history(), "left_out": 30, "planned": 80}
    kept, broken = endings({"surface": {"rgb": fewer}}, None, 100.0, 110.0)
    assert kept == ["surface rgb: 50 of 80 steps were made, to the end of the schedule, for the time that was given"]
    assert broken == []


@pytest.mark.parametrize("ended", ["its time was up", ""])
def test_what_did_not_come_to_the_end_of_its_schedule_is_not_said_to(ended):
    """At its deadline, or where its curve was flat, of which nothing is told."""
    fewer = {**history(ended), "left_out": 30, "planned": 100}
    kept, broken = endings({"surface": {"rgb": fewer}}, None, 100.0, 110.0)
    assert kept == []
    assert broken == (["surface rgb: ended after 50 steps, its time was up"] if ended else [])


def test_a_figure_that_was_not_reached_is_told_with_what_was():
    stages = {"surface": {"rgb": history(GIVEN_UP, 20.0, None, 29.04)}}
    kept, broken = endings(stages, Until("photos", 32.0), 100.0, None)
    assert kept == []
    assert broken == [
        "--until 32dB: not reached; the best of held-out photos on the way was 29.0 dB",
        f"surface rgb: ended after 50 steps, {GIVEN_UP}",
    ]


def test_where_nothing_is_held_out_nothing_can_tell():
    _, broken = endings({"surface": {"rgb": history()}}, Until("photos", 32.0), 100.0, None)
    assert broken == ["--until 32dB: no photos are held out that could tell whether it is reached; all steps are made"]


def test_it_is_known_beforehand_where_nothing_can_tell(tiny_capture):
    capture = read_capture(tiny_capture)
    shown = [replace(photo, held_out=False) for photo in capture.photos.photos]
    unknown = [replace(photo, camera=None) for photo in shown]

    assert photos_kept_back(capture.photos)
    assert not photos_kept_back(Photos(shown))
    assert photos_kept_back(Photos(unknown))
    assert not photos_kept_back(Photos(unknown[:7]))
    assert not photos_kept_back(None)
    assert projections_kept_back(capture.projections)
    assert not projections_kept_back(None)


def test_what_had_no_time_is_named_also_inside_of_another_part():
    stages = {"internal": {"xray": {**history(), "display": history("its time was up")}}}
    assert endings(stages, None, 100.0, 100.0) == (
        [],
        ["internal xray display: ended after 50 steps, its time was up"],
    )


@pytest.mark.parametrize(("seconds", "count"), [(300.0, 0), (325.0, 0), (400.0, 1)])
def test_a_time_that_was_not_kept_is_told(seconds, count):
    _, broken = endings({}, None, seconds, 300.0)
    assert len(broken) == count
    assert all(line == "--time-budget 300s: the run took 400 s; give it more time" for line in broken)
