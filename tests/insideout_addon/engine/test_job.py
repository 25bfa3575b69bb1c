"""The running job as the user interface sees it."""

from __future__ import annotations

import json
import sys
import time

import bpy
import pytest

from insideout.insideout_addon.engine import job
from insideout.insideout_addon.engine.curve_picture import curve_points

_SEND = (
    "import json, sys, time\ndef send(type, /, **content): print(json.dumps({'type': type, **content}), flush=True)\n"
)


@pytest.fixture
def windowed(blender, monkeypatch):
    """Jobs are polled as in a window: the test calls `tick` in the timer's place."""

    class App:
        background = False
        timers = bpy.app.timers

    class Bpy:
        app = App
        context = bpy.context
        types = bpy.types

    monkeypatch.setattr(job, "bpy", Bpy)
    yield bpy.context.window_manager.insideout
    job.abandon_job()


def _start(tmp_path, body, on_end=lambda last: None):
    script = tmp_path / "program.py"
    script.write_text(_SEND + body, "utf-8")
    heard = []
    last = job.start_job([sys.executable, str(script)], "Working", heard.append, on_end)
    return last, heard


def _tick_until(condition):
    deadline = time.monotonic() + 10
    while not condition():
        assert time.monotonic() < deadline
        job.tick()
        time.sleep(0.01)


def test_in_background_it_blocks_until_done(blender, tmp_path):
    ended = []
    last, heard = _start(tmp_path, "send('stage', stage='fuse', state='done', seconds=2); send('done')", ended.append)
    assert last == {"type": "done"}
    assert ended == [{"type": "done"}]
    assert [m["type"] for m in heard] == ["stage", "done"]
    assert not job.job_running()
    assert not bpy.context.window_manager.insideout.running


def test_in_a_window_it_returns_at_once_and_shows_progress(windowed, tmp_path):
    began = time.monotonic()
    _start(
        tmp_path,
        "send('stage', stage='surface', state='started')\n"
        "send('progress', stage='surface', part='rgb', fraction=0.25, iteration=50, iterations=200, splats=1234,"
        " heldout_psnr=23.5)\n"
        "sys.stdin.readline(); send('cancelled')",
    )
    assert time.monotonic() - began < 0.5
    _tick_until(lambda: windowed.iteration == 50)
    assert windowed.running
    assert (windowed.stage, windowed.part, windowed.splats) == ("surface", "rgb", 1234)
    assert windowed.fraction == pytest.approx(0.25)
    assert windowed.heldout_psnr == pytest.approx(23.5)
    assert windowed.stages["surface"].state == "started"
    began = time.monotonic()
    job.cancel_job()
    _tick_until(lambda: not job.job_running())
    assert time.monotonic() - began < 1.0
    assert windowed.message == "Canceled"
    assert windowed.error == ""


def test_time_left_is_told(windowed, tmp_path):
    _start(
        tmp_path,
        "send('progress', stage='surface', fraction=0.0)\ntime.sleep(1.2)\n"
        "send('progress', stage='surface', fraction=0.5)\nsys.stdin.readline()",
    )
    _tick_until(lambda: windowed.fraction == 0.5)
    assert windowed.seconds_left == pytest.approx(1.2, abs=0.6)


def test_one_job_at_a_time(windowed, tmp_path):
    _start(tmp_path, "sys.stdin.readline()")
    with pytest.raises(RuntimeError, match="cancel that first"):
        _start(tmp_path, "send('done')")


def test_a_crash_is_shown(blender, tmp_path):
    _start(tmp_path, "print('out of memory', file=sys.stderr); sys.exit(1)")
    state = bpy.context.window_manager.insideout
    assert "out of memory" in state.error
    assert not state.running


def test_unregistering_ends_the_job(windowed, tmp_path):
    _start(tmp_path, "time.sleep(60)")
    job.abandon_job()
    assert not job.job_running()
    assert not bpy.app.timers.is_registered(job.tick)


def test_a_file_that_is_opened_meanwhile_knows_of_the_job(windowed, tmp_path):
    _start(
        tmp_path,
        "send('stage', stage='initialize', state='done', seconds=3)\n"
        "send('progress', stage='surface', fraction=0.25); sys.stdin.readline()\n"
        "send('progress', stage='surface', fraction=0.5); sys.stdin.readline()\n",
    )
    _tick_until(lambda: windowed.fraction == 0.25)
    # What opening a file does to a window manager's properties.
    windowed.property_unset("running")
    for name in ("title", "panel", "stage", "fraction", "stages"):
        windowed.property_unset(name)
    windowed.panel = "engine"
    running = job._current[0]
    running.process._process.stdin.write(b"\n")
    running.process._process.stdin.flush()
    _tick_until(lambda: windowed.fraction == 0.5)
    assert (windowed.running, windowed.title, windowed.panel) == (True, "Working", "reconstruct")
    assert (windowed.stages["initialize"].state, windowed.stages["initialize"].seconds) == ("done", 3.0)


def test_cancelling_is_said_until_it_has_ended(windowed, tmp_path):
    _start(
        tmp_path,
        "send('progress', stage='surface', fraction=0.1, message='fitting'); sys.stdin.readline()\n"
        "send('progress', stage='surface', fraction=0.2, message='still fitting'); time.sleep(0.3)\n"
        "send('cancelled')\n",
    )
    _tick_until(lambda: windowed.message == "fitting")
    job.cancel_job()
    assert windowed.message == "Canceling"
    _tick_until(lambda: windowed.fraction == pytest.approx(0.2))
    assert windowed.message == "Canceling"
    _tick_until(lambda: not windowed.running)
    assert windowed.message == "Canceled"


def _shown(state):
    """The curve as the panel reads it: stage, part, seconds, photos and projections of each point."""
    points = curve_points(json.loads(state.curve)) if state.curve else ()
    return [(point.stage, point.part, point.seconds, point.photos, point.projections) for point in points]


MEASURED = """
def measured(stage, part, *points):
    heldout = [{'iteration': i, 'seconds': s, 'splats': 9, **figures} for i, s, figures in points]
    send('progress', stage=stage, part=part, fraction=0.5, heldout=heldout)
"""


def test_one_curve_grows_over_all_parts_of_a_run(windowed, tmp_path):
    _start(
        tmp_path,
        MEASURED + "measured('surface', 'rgb', (10, 5.0, {'photos': 20.0})); sys.stdin.readline()\n"
        "measured('surface', 'xray', (10, 9.0, {'projections': 30.0}))\n"
        "measured('internal', 'joint', (10, 15.0, {'photos': 21.0, 'projections': 31.0})); sys.stdin.readline()",
    )
    _tick_until(lambda: windowed.curve)
    assert _shown(windowed) == [("surface", "rgb", 5.0, 20.0, None)]
    running = job._current[0].process._process
    running.stdin.write(b"\n")
    running.stdin.flush()
    _tick_until(lambda: len(_shown(windowed)) == 3)
    assert _shown(windowed)[1:] == [("surface", "xray", 9.0, None, 30.0), ("internal", "joint", 15.0, 21.0, 31.0)]


def test_no_point_is_lost_where_blender_was_busy(windowed, tmp_path):
    """Of the progress that came meanwhile only the newest is shown."""
    _start(
        tmp_path,
        MEASURED + "for i in range(1, 30):\n"
        "    measured('surface', 'rgb', (i, float(i), {'photos': 20.0 + i}))\n"
        "    send('progress', stage='surface', part='rgb', fraction=i / 30, iteration=i)\n"
        "sys.stdin.readline()",
    )
    time.sleep(0.5)
    _tick_until(lambda: windowed.iteration == 29)
    assert [seconds for _, _, seconds, _, _ in _shown(windowed)] == [float(i) for i in range(1, 30)]


def test_a_run_that_goes_on_begins_with_its_earlier_points(windowed, tmp_path):
    """Stages that are kept tell theirs, and a part that was broken off; what is told twice is there once."""
    _start(
        tmp_path,
        MEASURED + "kept = [{'stage': 'surface', 'part': 'rgb', 'iteration': 10, 'seconds': 5.0, 'photos': 20.0}]\n"
        "send('stage', stage='surface', state='kept', heldout=kept)\n"
        "send('stage', stage='align', state='kept')\n"
        "first = (10, 15.0, {'photos': 21.0})\n"
        "measured('internal', 'joint', first)\n"
        "measured('internal', 'joint', first, (20, 25.0, {'photos': 22.0}))\n"
        "sys.stdin.readline()",
    )
    _tick_until(lambda: len(_shown(windowed)) == 3)
    assert [seconds for _, _, seconds, _, _ in _shown(windowed)] == [5.0, 15.0, 25.0]


def test_a_finished_run_has_the_curve_of_its_report(windowed, tmp_path):
    _start(
        tmp_path,
        MEASURED + "measured('surface', 'rgb', (10, 5.0, {'photos': 20.0}))\n"
        "last = {'stage': 'report', 'part': '', 'seconds': 9.0, 'photos': 20.5}\n"
        "send('done', report={'curve': [{'stage': 'surface', 'part': 'rgb', 'seconds': 5.0, 'photos': 20.0}, last]})",
    )
    _tick_until(lambda: not job.job_running())
    assert _shown(windowed) == [("surface", "rgb", 5.0, 20.0, None), ("report", "", 9.0, 20.5, None)]


def test_a_run_that_was_cancelled_keeps_what_it_has_reached(windowed, tmp_path):
    _start(tmp_path, MEASURED + "measured('surface', 'rgb', (10, 5.0, {'photos': 20.0})); sys.stdin.readline()")
    _tick_until(lambda: windowed.curve)
    job.cancel_job()
    _tick_until(lambda: not job.job_running())
    assert len(_shown(windowed)) == 1


def test_the_next_run_begins_a_new_curve(windowed, tmp_path):
    _start(tmp_path, MEASURED + "measured('surface', 'rgb', (10, 5.0, {'photos': 20.0})); send('done')")
    _tick_until(lambda: not job.job_running())
    assert windowed.curve
    _start(tmp_path, "sys.stdin.readline()")
    assert windowed.curve == ""


def test_a_file_that_is_opened_meanwhile_shows_the_whole_curve(windowed, tmp_path):
    _start(
        tmp_path,
        MEASURED + "measured('surface', 'rgb', (10, 5.0, {'photos': 20.0})); sys.stdin.readline()\n"
        "send('progress', stage='surface', fraction=0.9); sys.stdin.readline()\n",
    )
    _tick_until(lambda: windowed.curve)
    windowed.property_unset("running")
    windowed.property_unset("curve")
    running = job._current[0].process._process
    running.stdin.write(b"\n")
    running.stdin.flush()
    _tick_until(lambda: windowed.running)
    assert len(_shown(windowed)) == 1
