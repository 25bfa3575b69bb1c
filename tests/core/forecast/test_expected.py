"""What a preset can be expected to reach."""

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from insideout.core.capture.read import read_capture
from insideout.core.cli import app
from insideout.core.errors import SettingError
from insideout.core.files import plain
from insideout.core.forecast.expected import (
    FinishedRun,
    expected,
    finished_run,
    qualities_of,
    range_text,
    reached,
    source_text,
)
from insideout.core.forecast.forecast import Forecast
from insideout.core.forecast.text import forecast_lines
from insideout.core.settings import PRESETS, Settings

ROWS = (
    {"capture": "doll", "preset": "draft", "photos": 28.0, "projections": 42.0},
    {"capture": "doll", "preset": "standard", "photos": 34.0, "projections": 46.0},
    {"capture": "toy", "preset": "draft", "photos": 31.0},
    {"capture": "toy", "preset": "standard", "photos": 38.5},
)


def run_of(preset="draft", photos=25.0):
    return FinishedRun("my_run", "vase", "digest", preset, {"photos": photos})


def test_without_a_run_it_is_what_known_objects_reached():
    assert expected("draft", ["photos"], rows=ROWS) == {"photos": (28.0, 31.0)}
    assert expected("standard", ["photos", "projections"], rows=ROWS) == {
        "photos": (34.0, 38.5),
        "projections": (46.0, 46.0),
    }


def test_from_a_run_of_the_capture_it_is_that_and_what_presets_differ_by():
    known = run_of()
    assert expected("standard", ["photos"], known, ROWS) == {"photos": (31.0, 32.5)}
    assert expected("draft", ["photos"], known, ROWS) == {"photos": (25.0, 25.0)}, "it is known"


def test_a_longer_preset_tells_of_a_shorter_one_too():
    assert expected("draft", ["photos"], run_of("standard", 36.0), ROWS) == {"photos": (28.5, 30.0)}


def test_what_a_run_kept_nothing_back_of_is_not_told_from_others(finished):
    assert expected("standard", ["photos", "projections"], run_of(), ROWS) == {"photos": (31.0, 32.5)}


def test_nothing_is_said_of_what_was_never_measured():
    assert expected("paper", ["photos", "projections"], rows=ROWS) == {}
    assert expected("paper", ["photos"], run_of(), ROWS) == {}
    assert expected("standard", ["photos"], run_of("paper"), ROWS) == {}
    assert expected("standard", [], rows=ROWS) == {}


def test_what_ships_was_measured_with_every_preset_on_each_object_and_longer_ones_are_better():
    by_capture = {}
    for row in reached():
        by_capture.setdefault(row["capture"], {})[row["preset"]] = row
    assert len(by_capture) >= 3
    gained = []
    for presets in by_capture.values():
        assert set(presets) == set(PRESETS)
        assert presets["draft"]["photos"] > 20.0
        assert presets["standard"]["projections"] > presets["draft"]["projections"] > 30.0
        assert presets["paper"]["projections"] > presets["standard"]["projections"]
        gained.append(presets["standard"]["photos"] - presets["draft"]["photos"])
    # Of the skull's, 256 pixels small, a draft knows as much.
    assert min(gained) > -0.1
    assert np.mean(gained) > 0.3


def test_a_line_says_what_may_be_reached_and_where_that_is_from():
    one = Forecast(Settings.of("draft"), {"surface rgb": 60.0}, False)
    line, source = forecast_lines([one], ["photos"])
    assert line.startswith("draft: about 60 s (surface rgb 60 s); photos ")
    assert line.endswith(" dB")
    assert source == source_text()
    told = forecast_lines([one], ["photos"], run_of())
    assert told == ["draft: about 60 s (surface rgb 60 s); photos about 25 dB", source_text(run_of())]
    assert "my_run" in told[1]


def test_ranges_are_told_to_a_decibel():
    assert range_text((27.6, 33.4)) == "28 to 33 dB"
    assert range_text((27.6, 28.4)) == "about 28 dB"


@pytest.fixture
def finished(tmp_path):
    """A run folder with what is read of one, and a way to change its report."""
    folder = tmp_path / "my_run"
    folder.mkdir()
    report = {
        "preset": "draft",
        "time_budget_s": None,
        "endings": [],
        "heldout": {"photos": {"psnr": 27.5}, "projections": None, "sections": {"psnr": 27.0}},
        "stages": {name: {"settings": one} for name, one in plain(Settings.of("draft").stages).items()},
        "effects": [{"name": "noise", "used": False}],
    }
    (folder / "capture.json").write_text(json.dumps({"digest": "abc", "path": "/scans/vase"}))

    def write(**changes):
        (folder / "report.json").write_text(json.dumps(report | changes))
        return folder

    return write


def test_a_finished_run_is_read(finished):
    run = FinishedRun.read(finished())
    assert run == FinishedRun("my_run", "vase", "abc", "draft", {"photos": 27.5})
    assert run.row() == {"capture": "vase", "preset": "draft", "photos": 27.5}


def other_joint():
    stages = {name: {"settings": one} for name, one in plain(Settings.of("draft").stages).items()}
    stages["internal"]["settings"]["joint"]["iterations"] += 1
    return stages


@pytest.mark.parametrize(
    "changes",
    [
        {"time_budget_s": 300.0},
        {"endings": ["surface rgb ended at 32 dB"]},
        {"stages": {"internal": {"settings": {"joint": None}}}},
        {"stages": other_joint()},
        {"stages": {"align": {"skipped": "", "left_out": True}}},
        {"effects": [{"name": "exposure", "used": True}]},
    ],
    ids=["in a time", "ended early", "apart", "other steps", "stages left out", "effects"],
)
def test_a_run_of_other_steps_than_its_preset_s_tells_nothing(finished, changes):
    with pytest.raises(SettingError, match="name another run"):
        FinishedRun.read(finished(**changes))


def test_a_preset_that_is_none_of_this_version_is_refused(finished):
    with pytest.raises(SettingError, match="name another run"):
        FinishedRun.read(finished(preset="swift"))


def test_a_stage_that_was_skipped_is_no_other_route(finished):
    assert FinishedRun.read(finished(stages={"internal": {"skipped": "no X-rays"}})).preset == "draft"


def test_what_is_no_finished_run_is_named(tmp_path, finished):
    with pytest.raises(SettingError, match="holds no finished run"):
        FinishedRun.read(tmp_path / "nothing")
    with pytest.raises(SettingError, match="holds no finished run"):
        FinishedRun.read(finished(heldout=None))


def test_bench_collects_rows_of_finished_runs(finished, tmp_path):
    saved = tmp_path / "reached.json"
    result = CliRunner().invoke(app, ["bench", "reached", str(finished()), "--markdown", "--json", str(saved)])
    assert result.exit_code == 0
    assert "| vase | draft | 27.5 |  |" in result.output
    assert json.loads(saved.read_text())["rows"] == [{"capture": "vase", "preset": "draft", "photos": 27.5}]


def test_a_run_of_another_capture_is_refused(finished, tiny_capture):
    with pytest.raises(SettingError, match="is the run of another capture, vase"):
        finished_run(finished(), read_capture(tiny_capture))


def test_a_capture_keeps_back_what_it_has(tiny_capture):
    capture = read_capture(tiny_capture)
    assert qualities_of(capture) == ["photos", "projections"]
    assert qualities_of(capture.xrays_only()) == ["projections"]
    assert qualities_of(capture, "apart") == [], "measured with the default route alone"
    few = replace(capture, photos=replace(capture.photos, photos=[p for p in capture.photos.photos if not p.held_out]))
    assert qualities_of(few) == ["projections"]


def test_a_run_that_nothing_would_be_told_from_is_refused(tiny_capture, tmp_path):
    told = CliRunner().invoke(app, ["forecast", str(tiny_capture), "--refine", "apart", "--run", str(tmp_path)])
    assert isinstance(told.exception, SettingError)
    assert "leave one of the two out" in str(told.exception)
