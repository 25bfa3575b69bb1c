"""The run folder knows whose it is and what is done."""

import json

import numpy as np
import pytest

from insideout.core.errors import RunFolderError
from insideout.core.files import write_json
from insideout.core.gaussians import GaussianSet
from insideout.core.run_folder import RunFolder


def test_a_run_folder_of_another_capture_is_refused_untouched(tmp_path):
    run = RunFolder(tmp_path / "run")
    run.claim("first digest", tmp_path / "one")
    before = (run.path / "capture.json").read_bytes()
    with pytest.raises(RunFolderError, match=r"another capture .*one"):
        run.claim("second digest", tmp_path / "two")
    assert (run.path / "capture.json").read_bytes() == before


def test_the_same_capture_may_come_back(tmp_path):
    run = RunFolder(tmp_path / "run")
    run.claim("digest", tmp_path)
    run.claim("digest", tmp_path)
    assert json.loads((run.path / "capture.json").read_text())["digest"] == "digest"


def test_a_folder_of_the_user_s_own_files_is_refused_untouched(tmp_path):
    (tmp_path / "holiday.jpg").write_text("dear")
    with pytest.raises(RunFolderError, match="not a run folder"):
        RunFolder(tmp_path).claim("digest", tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["holiday.jpg"]


def test_sets_and_reports_are_found_again(tmp_path):
    run = RunFolder(tmp_path)
    assert not run.is_done("surface")
    run.write_set("surface", "rgb", GaussianSet.empty())
    assert run.has_set("surface", "rgb")
    assert not run.has_set("surface", "xray")
    assert len(run.read_set("surface", "rgb")) == 0


def test_sets_of_a_stage_that_was_skipped_since_are_those_of_an_earlier_run(tmp_path):
    run = RunFolder(tmp_path)
    run.write_set("surface", "rgb", GaussianSet.empty())
    write_json(run.stage("surface") / "report.json", {"skipped": "left out"})
    assert not run.has_set("surface", "rgb")


def test_splats_are_counted_of_stages_that_are_done(tmp_path):
    run = RunFolder(tmp_path)
    assert run.splats() == {}
    write_json(run.stage("initialize") / "report.json", {})
    for stage, half, count in (("initialize", "rgb", 3), ("initialize", "xray", 4), ("surface", "rgb", 5)):
        run.write_set(stage, half, GaussianSet.create(np.zeros((count, 3)), 1.0))
    (tmp_path / "surface" / "xray.ply").write_text("nothing")
    assert run.splats() == {"initialize rgb": 3, "initialize xray": 4}, "the others are of an earlier run"
    write_json(run.stage("surface") / "report.json", {})
    assert run.splats() == {"initialize rgb": 3, "initialize xray": 4, "surface rgb": 5}


def test_a_damaged_report_is_named(tmp_path):
    run = RunFolder(tmp_path)
    (run.stage("align") / "report.json").write_text("{")
    with pytest.raises(RunFolderError, match=r"align.report\.json.*delete it"):
        run.report("align")


def test_what_a_killed_run_was_writing_is_cleared_away_and_nothing_else(tmp_path):
    run = RunFolder(tmp_path / "run")
    halves = [run.stage("fuse") / ".fused.ply.123.tmp", run.path / ".volume.npz.77.tmp"]
    others = [run.path / "notes.tmp", run.stage("fuse") / "fused.ply"]
    for path in halves + others:
        path.write_bytes(b"x")
    with run.locked():
        assert not any(path.exists() for path in halves)
    assert all(path.exists() for path in others)
