"""The engine's process: JSON lines out, cancel in, an exit code that says how it ended."""

import io
import json
import subprocess
import sys
import threading

import pytest

from insideout.core import worker
from insideout.core.capture.read import read_capture
from insideout.core.progress import Progress
from insideout.core.told import Told


def start(*arguments):
    return subprocess.Popen(
        [sys.executable, "-m", "insideout.core.worker", *map(str, arguments)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        encoding="utf-8",
    )


def messages(process):
    """All messages and standard error. Standard input stays open meanwhile: its end would cancel."""
    with process:
        out, err = process.stdout.read(), process.stderr.read()
    return [json.loads(line) for line in out.splitlines()], err


def test_version_tells_what_runs():
    process = start("version")
    (message,), _ = messages(process)
    assert message["type"] == "version"
    assert message["torch"].startswith("2.")
    assert process.returncode == 0


def test_a_user_s_mistake_is_one_message_and_exit_code_2(tmp_path):
    process = start("run", tmp_path / "nowhere", "--out", tmp_path / "run", "--preset", "draft")
    found, err = messages(process)
    assert process.returncode == 2
    assert found[-1]["type"] == "error"
    assert found[-1]["kind"] == "CaptureError"
    assert "nowhere" in found[-1]["message"]
    # Of which Blender makes the sentence in its own language.
    assert found[-1]["told"]["template"] == "{subject}: {message}; {advice}."
    assert found[-1]["told"]["values"]["message"]["template"] == "does not exist"
    assert "Traceback" not in err


def test_a_fault_of_the_program_is_told_with_the_way_to_report_it(monkeypatch):
    def fail(*_):
        raise ZeroDivisionError("by {zero}")

    monkeypatch.setattr(worker, "_version", fail)
    monkeypatch.setattr(sys, "stdout", out := io.StringIO())
    assert worker.main(["version"]) == 1
    told = json.loads(out.getvalue())
    assert told["kind"] == "ZeroDivisionError"
    assert told["message"] == "The engine failed (ZeroDivisionError: by {zero}); report this with the log, please."
    assert told["told"]["template"].format(**told["told"]["values"]) == told["message"]


def test_check_sends_findings(tmp_path):
    process = start("check", tmp_path)
    found, _ = messages(process)
    assert process.returncode == 2
    assert any(m["type"] == "finding" and m["level"] == "error" for m in found)
    (empty,) = (m for m in found if m["type"] == "finding")
    assert Told.from_json(empty["told"]["message"]) == empty["message"]
    assert Told.from_json(empty["told"]["advice"]) == empty["advice"]
    assert found[-1]["type"] == "done"


def test_the_end_of_standard_input_cancels(tiny_capture, tmp_path):
    """The program that started the engine is gone: nobody is there to see the result."""
    process = start("run", tiny_capture, "--out", tmp_path / "run", "--preset", "draft")
    out, _ = process.communicate(timeout=120)
    assert process.returncode == 130
    assert json.loads(out.splitlines()[-1])["type"] == "cancelled"


@pytest.mark.parametrize("command", ["run", "forecast"])
def test_effects_are_passed_on(command, tiny_capture, tmp_path):
    out = ["--out", tmp_path / "run"] if command == "run" else []
    process = start(command, tiny_capture, *out, "--effects", "sepia")
    found, _ = messages(process)
    assert process.returncode == 2
    assert "there is no effect 'sepia'" in found[-1]["message"]


def test_the_way_of_refining_is_passed_on(tmp_path):
    process = start("run", tmp_path, "--out", tmp_path / "run", "--refine", "alone")
    found, _ = messages(process)
    assert process.returncode == 2
    assert "--refine alone" in found[-1]["message"]


@pytest.mark.parametrize("same", [True, False])
def test_a_forecast_is_told_from_the_run_that_the_environment_names(same, tiny_capture, tmp_path, monkeypatch):
    stages = {"internal": {"settings": {"joint": {}}}}
    report = {"preset": "draft", "time_budget_s": None, "endings": [], "heldout": {}, "stages": stages}
    digest = read_capture(tiny_capture).digest if same else "another"
    (tmp_path / "report.json").write_text(json.dumps(report))
    (tmp_path / "capture.json").write_text(json.dumps({"digest": digest, "path": str(tiny_capture)}))
    monkeypatch.setenv("INSIDEOUT_RUN", str(tmp_path))
    monkeypatch.setattr("insideout.core.forecast.budget.preset_forecasts", lambda *_: [])
    monkeypatch.setattr(worker, "_watch_input", threading.Event)
    monkeypatch.setattr(sys, "stdout", out := io.StringIO())
    assert worker.main(["forecast", str(tiny_capture)]) == 0
    assert json.loads(out.getvalue().splitlines()[-1]) == {"type": "done", "known": same}


def test_a_stage_that_is_kept_tells_its_part_of_the_curve(tmp_path, monkeypatch):
    point = {"iteration": 10, "seconds": 5.0, "splats": 3, "photos": 20.0}

    def reconstruct(*_, on_stage, **__):
        on_stage("initialize", "kept", {"seconds": 1.0})
        on_stage("surface", "kept", {"seconds": 7.0, "rgb": {"heldout": [point]}})
        on_stage("align", "done", {"seconds": 3.0, "rgb": {"heldout": [point]}})
        on_stage("internal", "kept", json.loads('{"skipped": "there are no photos", "seconds": 0.0}'))
        return {}

    monkeypatch.setattr("insideout.core.pipeline.reconstruct", reconstruct)
    monkeypatch.setattr(worker, "_watch_input", threading.Event)
    monkeypatch.setattr(sys, "stdout", out := io.StringIO())
    assert worker.main(["run", str(tmp_path), "--out", str(tmp_path / "run")]) == 0
    told = [json.loads(line) for line in out.getvalue().splitlines()]
    assert [one.get("heldout") for one in told[:3]] == [None, [{"stage": "surface", "part": "rgb", **point}], None]
    assert told[3]["told"] == {"template": "there are no photos", "values": {}}


def test_what_stages_say_goes_with_what_it_is_translated_by(tmp_path, monkeypatch):
    skipped = Told("there are {count} photos", count=0)

    def reconstruct(*_, on_stage, reporter, **__):
        on_stage("align", "skipped", {"skipped": skipped, "seconds": 0.0})
        reporter.update(Progress("surface", "fdk", message=Told("FDK from {count} projections", count=3)))
        reporter.update(Progress("surface", "rgb", message="compiling kernels, once"))
        reporter.update(Progress("surface", "rgb", 1.0))
        return {}

    monkeypatch.setattr("insideout.core.pipeline.reconstruct", reconstruct)
    monkeypatch.setattr(worker, "_watch_input", threading.Event)
    monkeypatch.setattr(sys, "stdout", out := io.StringIO())
    assert worker.main(["run", str(tmp_path), "--out", str(tmp_path / "run")]) == 0
    align, fdk, kernels, plain, _ = map(json.loads, out.getvalue().splitlines())
    assert (align["reason"], align["told"]) == ("there are 0 photos", skipped.to_json())
    assert fdk["message"] == "FDK from 3 projections"
    assert fdk["told"] == {"template": "FDK from {count} projections", "values": {"count": 3}}
    assert kernels["told"] == {"template": "compiling kernels, once", "values": {}}
    assert "told" not in plain
