"""What of a run folder still counts, and that nothing is given up before a refusal."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from insideout.core import resume
from insideout.core.capture.model import Landmarks
from insideout.core.errors import DiskFullError, RunFolderError, SettingError
from insideout.core.files import exclusive, plain, write_json
from insideout.core.resume import (
    Clock,
    RunClock,
    check_order,
    check_space,
    claim_settings,
    forget,
    forget_changed,
    once,
    refuse_nesting,
    start_over_if_changed,
    staying,
)
from insideout.core.run_folder import STAGES, RunFolder
from insideout.core.settings import Settings


@dataclass(frozen=True)
class Knobs:
    iterations: int = 10
    rate: float = 0.1
    planes: tuple[str, ...] = ("axial",)


@pytest.fixture
def settings():
    return Settings("draft", 0, "cpu", {stage: Knobs() for stage in STAGES})


@pytest.fixture
def done(tmp_path, settings):
    """A run folder whose five stages and report are finished."""
    run = RunFolder(tmp_path / "run")
    claim_settings(run, settings, (), False)
    for stage in STAGES:
        write_json(run.stage(stage) / "report.json", {"settings": settings.stages[stage]})
    write_json(run.path / "report.json", {})
    return run


def changed(settings, stage, **values):
    return replace(settings, stages={**settings.stages, stage: replace(settings.stages[stage], **values)})


class TestSettings:
    def test_the_same_settings_go_on(self, done, settings):
        claim_settings(done, settings, (), False)
        assert all(done.is_done(stage) for stage in STAGES)

    def test_another_setting_of_a_done_stage_is_named(self, done, settings):
        with pytest.raises(RunFolderError, match=r"surface\.iterations 10, not 20.*--fresh"):
            claim_settings(done, changed(settings, "surface", iterations=20), (), False)
        assert json.loads((done.path / "settings.json").read_text())["stages"]["surface"]["iterations"] == 10

    def test_a_nested_setting_is_named_alone(self, done, settings):
        write_json(done.path / "surface" / "report.json", {"settings": {"rgb": {"iterations": 7, "rate": 0.1}}})
        nested = replace(settings, stages={**settings.stages, "surface": {"rgb": {"iterations": 8, "rate": 0.1}}})
        with pytest.raises(RunFolderError, match=r"with surface\.rgb\.iterations 7, not 8;"):
            claim_settings(done, nested, (), False)

    def test_the_way_of_refining_is_named_as_on_the_command_line(self, done, settings):
        write_json(done.path / "internal" / "report.json", {"settings": {"joint": {"iterations": 9}}})
        apart = replace(settings, stages={**settings.stages, "internal": {"joint": None}})
        with pytest.raises(RunFolderError, match=r"made with --refine joint, not apart; give --refine joint, or"):
            claim_settings(done, apart, (), False)

    def test_a_setting_that_an_older_version_did_not_know_is_no_difference(self, done, settings):
        write_json(done.path / "surface" / "report.json", {"settings": {"iterations": 10, "gone": 3}})
        claim_settings(done, settings, (), False)
        assert done.is_done("surface")

    @pytest.mark.parametrize("stage", ["surface", "align"])
    def test_a_stage_that_is_made_again_may_change_and_so_may_later_ones(self, done, settings, stage):
        claim_settings(done, changed(settings, stage, rate=0.3), ["surface"], False)
        assert json.loads((done.path / "settings.json").read_text())["stages"][stage]["rate"] == 0.3

    def test_a_stage_before_the_one_made_again_may_not(self, done, settings):
        with pytest.raises(RunFolderError, match=r"initialize\.rate"):
            claim_settings(done, changed(settings, "initialize", rate=0.3), ["surface"], False)

    def test_a_skipped_stage_has_no_settings_to_keep(self, done, settings):
        write_json(done.path / "align" / "report.json", {"skipped": "no photos"})
        claim_settings(done, changed(settings, "align", rate=0.3), (), False)
        assert json.loads((done.path / "settings.json").read_text())["stages"]["align"]["rate"] == 0.3

    def test_fresh_forgets_stages_clocks_and_the_report_but_no_results(self, done, settings):
        (done.path / "surface" / "rgb.ply").write_bytes(b"splats")
        (done.path / "surface" / "rgb.checkpoint.pt").write_bytes(b"half")
        write_json(done.path / "surface" / "seconds.json", 500.0)
        (done.path / "curve.png").write_bytes(b"which says nothing of whose it is")
        claim_settings(done, changed(settings, "surface", rate=0.3), (), True)
        assert not any(done.is_done(stage) for stage in STAGES)
        assert not (done.path / "report.json").exists()
        assert not (done.path / "curve.png").exists()
        assert sorted(p.name for p in (done.path / "surface").iterdir()) == ["rgb.ply"]

    def test_the_program_s_own_folder_forgets_what_was_made_otherwise_and_all_after_it(self, done, settings):
        forget_changed(done, settings)
        assert all(done.is_done(stage) for stage in STAGES)
        forget_changed(done, changed(settings, "align", rate=0.3))
        assert [stage for stage in STAGES if done.is_done(stage)] == ["initialize", "surface"]

    def test_so_do_stages_that_were_copied_there_without_the_folder_s_settings(self, done, settings):
        (done.path / "settings.json").unlink(missing_ok=True)
        forget_changed(done, settings)
        assert all(done.is_done(stage) for stage in STAGES)
        forget_changed(done, changed(settings, "surface", rate=0.3))
        assert [stage for stage in STAGES if done.is_done(stage)] == ["initialize"]

    def test_stages_of_another_kernel_are_forgotten_too(self, done, settings):
        report = {"settings": settings.stages["surface"], "kernel": "reference"}
        write_json(done.path / "surface" / "report.json", report)
        forget_changed(done, settings)
        assert [stage for stage in STAGES if done.is_done(stage)] == ["initialize"]

    def test_a_checkpoint_of_other_settings_is_dropped(self, done):
        start_over_if_changed(done, "surface", Knobs(), "cpu")
        checkpoint = done.path / "surface" / "rgb.checkpoint.pt"
        checkpoint.write_bytes(b"half")
        start_over_if_changed(done, "surface", Knobs(), "cpu")
        assert checkpoint.exists()
        start_over_if_changed(done, "surface", Knobs(rate=0.2), "cpu")
        assert not checkpoint.exists()

    def test_a_checkpoint_of_another_kernel_or_version_is_dropped(self, done, monkeypatch):
        start_over_if_changed(done, "align", Knobs(), "cpu")
        checkpoint = done.path / "align" / "global.checkpoint.npz"
        for change in (lambda: "reference", lambda: monkeypatch.setattr(resume, "__version__", "0.0.9") or "reference"):
            checkpoint.write_bytes(b"half")
            start_over_if_changed(done, "align", Knobs(), change())
            assert not checkpoint.exists()


class TestOnce:
    """A finished step of a stage is not made twice."""

    @pytest.fixture
    def step(self):
        """Counts how often it is made."""

        def make():
            make.times += 1
            return {"shift": np.array([[0.1, np.nan, 1e300]]), "kept": True, "gain": np.float32(0.1), "none": None}

        make.times = 0
        return make

    def test_what_was_made_comes_back_bit_for_bit(self, step, tmp_path):
        first, second = (once(tmp_path / "step.checkpoint.npz", step) for _ in range(2))
        assert step.times == 1
        assert first["shift"].tobytes() == second["shift"].tobytes()
        assert {**first, "shift": 0} == {**second, "shift": 0} == {**plain(step()), "shift": 0}

    @pytest.mark.parametrize("damage", [b"", b"PK\x03\x04 cut short", b"no archive", b"an array", b"a list"])
    def test_a_damaged_one_is_made_anew(self, step, damage, tmp_path):
        path = tmp_path / "step.checkpoint.npz"
        once(path, step)
        with open(path, "wb") as stream:
            if damage == b"an array":
                np.save(stream, np.arange(3))
            elif damage == b"a list":
                np.savez(stream, plain=json.dumps([1, 2]))
            else:
                stream.write(damage)
        assert once(path, step)["kept"] is True
        assert step.times == 2

    def test_a_step_whose_file_was_deleted_is_made_anew(self, step, tmp_path):
        path, left = tmp_path / "step.checkpoint.npz", tmp_path / "volume.npz"
        left.touch()
        once(path, step, [left])
        once(path, step, [left])
        assert step.times == 1
        left.unlink()
        once(path, step, [left])
        assert step.times == 2

    def test_a_step_that_fails_leaves_nothing(self, tmp_path):
        with pytest.raises(ZeroDivisionError):
            once(tmp_path / "step.checkpoint.npz", lambda: {"ratio": 1 / 0})
        assert not list(tmp_path.iterdir())

    def test_it_goes_with_the_stage_s_other_checkpoints(self, done, step):
        once(done.path / "align" / "global.checkpoint.npz", step)
        forget(done, "align")
        assert not list((done.path / "align").iterdir())


class TestOrder:
    def test_a_missing_earlier_stage_is_named_and_nothing_is_given_up(self, done):
        with pytest.raises(SettingError, match="needs the stage 'initialize' first"):
            check_order(done, ["internal"], fresh=True)
        assert all(done.is_done(stage) for stage in STAGES)

    def test_done_stages_and_those_asked_for_count(self, done):
        check_order(done, ["internal"], fresh=False)
        check_order(done, ["initialize", "surface"], fresh=True)
        forget(done, "align")
        check_order(done, ["align", "internal"], fresh=False)
        with pytest.raises(SettingError, match="'align' first"):
            check_order(done, ["internal"], fresh=False)


class TestStaying:
    """What a run that starts now does not make again, and what that took."""

    def test_all_that_is_done_stays_and_counts_with_what_is_half_done(self, done):
        for stage in STAGES:
            write_json(done.path / stage / "report.json", {"seconds": 10.0})
        (done.path / "internal" / "report.json").unlink()
        write_json(done.path / "internal" / "seconds.json", 4.0)
        stays = staying(done, (), (), False, None)
        assert stays == ["initialize", "surface", "align"]
        assert RunClock(done, stays, False, time.monotonic())() == pytest.approx(34.0, abs=1)

    def test_nothing_stays_of_a_run_that_is_begun_anew(self, done):
        assert staying(done, (), (), True, None) == []

    def test_what_came_before_the_first_stage_counts_in_the_next_process_too(self, done):
        """A minute of compiling, killed, gone on with: the minute is still part of the time."""
        begun = time.monotonic()
        RunClock(done, STAGES, False, begun - 60).start_stages()
        assert RunClock(done, STAGES, False, begun)() == pytest.approx(60, abs=1)
        RunClock(done, STAGES, False, begun - 5).start_stages()
        assert RunClock(done, STAGES, False, begun)() == pytest.approx(65, abs=1)
        assert RunClock(done, (), True, begun)() == pytest.approx(0, abs=1)

    def test_what_is_made_again_and_all_after_it_does_not(self, done):
        assert staying(done, ["align"], (), False, None) == ["initialize", "surface"]
        assert staying(done, (), ["surface"], False, None) == ["initialize"]

    def test_new_landmarks_make_the_alignment_again(self, done):
        points = np.zeros((3, 3))
        assert staying(done, (), (), False, Landmarks(points, points)) == ["initialize", "surface"]


class TestPlaces:
    @pytest.mark.parametrize("inside", ["", "run", "photos/run", "xray/../images/run"])
    def test_a_run_inside_the_capture_is_refused(self, tmp_path, inside):
        with pytest.raises(RunFolderError, match="inside the capture"):
            refuse_nesting(tmp_path, tmp_path / inside)

    def test_a_run_beside_the_capture_is_fine(self, tmp_path):
        assert refuse_nesting(tmp_path / "cap", tmp_path / "capture") is None

    def test_a_file_in_the_way_is_named(self, tmp_path):
        (tmp_path / "notes.txt").write_text("mine")
        with pytest.raises(RunFolderError, match=r"notes\.txt: is a file"):
            check_space(tmp_path / "notes.txt" / "run")

    def test_a_drive_that_is_not_there_is_named(self, monkeypatch, tmp_path):
        monkeypatch.setattr(Path, "exists", lambda self: False)
        with pytest.raises(RunFolderError, match="there is no drive"):
            check_space(tmp_path / "run")

    def test_too_little_room_is_told_before_anything_is_written(self, monkeypatch, tmp_path):
        monkeypatch.setattr("shutil.disk_usage", lambda _: type("Usage", (), {"free": 5 * 2**20})())
        with pytest.raises(DiskFullError, match="only 5 MB are free"):
            check_space(tmp_path / "run")


class TestLock:
    def test_two_runs_do_not_write_to_one_folder(self, done):
        code = (
            "import sys, time; from pathlib import Path; from insideout.core.run_folder import RunFolder\n"
            "with RunFolder(Path(sys.argv[1])).locked():\n    print('mine', flush=True); time.sleep(60)"
        )
        other = subprocess.Popen([sys.executable, "-c", code, str(done.path)], stdout=subprocess.PIPE, text=True)
        try:
            assert other.stdout.readline() == "mine\n"
            with pytest.raises(RunFolderError, match="another run is writing here"), done.locked():
                pass
        finally:
            other.kill()
            other.communicate()
        with done.locked():
            pass

    def test_a_lock_is_free_again_after_the_block(self, tmp_path):
        for _ in range(2):
            with exclusive(tmp_path / "lock") as ours:
                assert ours


class TestClock:
    def test_seconds_before_a_kill_count(self, tmp_path):
        write_json(tmp_path / "seconds.json", 100.0)
        clock = Clock(tmp_path / "seconds.json")
        assert 100.0 <= clock.total < 105.0
        clock.save()
        assert Clock(tmp_path / "seconds.json").total >= 100.0

    def test_it_is_saved_now_and_then_so_that_a_kill_loses_little(self, tmp_path, monkeypatch):
        clock = Clock(tmp_path / "seconds.json")
        clock.save_now_and_then()
        assert not clock.path.exists()
        later = time.monotonic() + 11
        monkeypatch.setattr(time, "monotonic", lambda: later)
        clock.save_now_and_then()
        assert json.loads(clock.path.read_text()) >= 10

    def test_a_damaged_one_starts_at_nothing(self, tmp_path):
        (tmp_path / "seconds.json").write_text('{"a"')
        assert Clock(tmp_path / "seconds.json").total < 5


@pytest.mark.skipif(os.name == "nt", reason="Windows sends no SIGINT to one process")
def test_ctrl_c_stops_with_a_checkpoint_and_says_how_to_go_on(tiny_capture, tmp_path):
    command = [sys.executable, "-m", "insideout.core.cli", "run", tiny_capture, "--out", tmp_path / "run"]
    process = subprocess.Popen([*map(str, command), "--preset", "draft"], stderr=subprocess.PIPE, encoding="utf-8")
    deadline = time.monotonic() + 120
    log = tmp_path / "run" / "log.jsonl"
    while time.monotonic() < deadline and process.poll() is None:
        if log.exists() and '"part": "rgb", "fraction": 0.0' in log.read_text() and '"iteration": 2' in log.read_text():
            break
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "stopped; run the same command again to go on" in said
    assert "Traceback" not in said
    assert list((tmp_path / "run" / "surface").glob("*.checkpoint.pt"))
