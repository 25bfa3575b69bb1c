"""Check and reconstruct against small programs that speak the engine's protocol; background mode blocks."""

from __future__ import annotations

import sys
import tempfile
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import bpy
import pytest

from insideout.insideout_addon import preferences
from insideout.insideout_addon.engine import commands
from insideout.insideout_addon.engine.commands import _push_undo, forecast_subject


def test_check_shows_the_findings(blender, make_engine, tmp_path):
    make_engine(
        "assert arguments[0] == 'check', arguments\n"
        "send('finding', level='info', subject='photos', message=arguments[1])\n"
        "send('finding', level='warning', subject='xray', message='few angles', advice='scan more')\n"
        "send('done', errors=0)\n"
    )
    settings = bpy.context.scene.insideout
    settings.capture = str(tmp_path)
    assert bpy.ops.insideout.check() == {"FINISHED"}
    assert [(f.level, f.subject, f.advice) for f in settings.findings] == [
        ("info", "photos", ""),
        ("warning", "xray", "scan more"),
    ]
    assert settings.findings[0].message == settings.checked == str(tmp_path)


def test_reconstruct_imports_what_the_engine_made(blender, make_engine, tmp_path, random_set):
    random_set.save(tmp_path / "made.ply")
    make_engine(
        "import shutil, pathlib\n"
        "assert arguments[0] == 'run', arguments\n"
        "assert arguments[arguments.index('--preset') + 1] == 'draft'\n"
        "out = pathlib.Path(arguments[arguments.index('--out') + 1]); out.mkdir()\n"
        f"shutil.copy({str(tmp_path / 'made.ply')!r}, out / 'fused.ply')\n"
        "send('progress', stage='fuse', fraction=1.0)\n"
        "send('done', run=str(out), report={})\n"
    )
    settings = bpy.context.scene.insideout
    settings.capture = str(tmp_path / "capture")
    assert bpy.ops.insideout.reconstruct() == {"FINISHED"}
    assert settings.run == str(tmp_path / "capture run")
    assert len(settings.model.data.points) == 200


def test_after_the_first_stage_alone_there_is_nothing_to_import(blender, make_engine, tmp_path):
    make_engine(
        "import pathlib\n"
        "pathlib.Path(arguments[arguments.index('--out') + 1]).mkdir()\n"
        "send('done', run='', report={})\n"
    )
    settings = bpy.context.scene.insideout
    settings.capture, settings.stage = str(tmp_path / "capture"), "initialize"
    assert settings.import_when_done
    assert bpy.ops.insideout.reconstruct() == {"FINISHED"}
    assert bpy.context.window_manager.insideout.error == ""


def test_an_import_into_a_scene_that_no_window_shows_has_a_step_in_the_undo_history(blender):
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    bpy.ops.ed.undo_push(message="before")
    _push_undo(bpy.data.scenes.new("other"))
    bpy.ops.object.empty_add()
    bpy.ops.ed.undo_push(message="something else")
    assert bpy.ops.ed.undo() == {"FINISHED"}
    assert "other" in bpy.data.scenes
    assert "Empty" not in bpy.data.objects


@pytest.mark.parametrize(
    ("setting", "value", "asked"),
    [("stage", "align", "--resume --refine joint --stage align"), ("refine", "apart", "--refine apart")],
)
def test_a_stage_or_the_paper_s_route_can_be_asked_for(setting, value, asked, blender, make_engine, tmp_path):
    make_engine("send('error', kind='SettingError', message=' '.join(arguments)); sys.exit(2)\n")
    settings = bpy.context.scene.insideout
    settings.capture = str(tmp_path)
    setattr(settings, setting, value)
    with pytest.raises(RuntimeError, match=asked):
        bpy.ops.insideout.reconstruct()


@pytest.mark.parametrize("button", ["reconstruct", "forecast"])
def test_effects_can_be_asked_for(button, blender, make_engine, tmp_path):
    make_engine("send('error', kind='SettingError', message=' '.join(arguments)); sys.exit(2)\n")
    settings = bpy.context.scene.insideout
    settings.capture = str(tmp_path)
    (tmp_path / "photos").mkdir()
    press = getattr(bpy.ops.insideout, button)
    with pytest.raises(RuntimeError) as caught:
        press()
    assert "--effects" not in str(caught.value), "an engine of before effects goes on as it did"
    settings.effects = "AUTO"
    for _ in range(2):
        # Pressed again, the same is asked for, so that the run goes on.
        with pytest.raises(RuntimeError, match="--refine joint --effects auto"):
            press()
    settings.effects = "NAMED"
    settings.named_effects.exposure = settings.named_effects.defocus = settings.named_effects.geometry = True
    with pytest.raises(RuntimeError, match="--refine joint --effects exposure,defocus") as caught:
        press()
    assert "geometry" not in str(caught.value), "there are no projections"


def test_a_time_is_asked_for_in_place_of_a_preset(blender, make_engine, tmp_path):
    make_engine("send('error', kind='SettingError', message=' '.join(arguments)); sys.exit(2)\n")
    settings = bpy.context.scene.insideout
    settings.capture, settings.limit_time, settings.minutes = str(tmp_path), True, 7.5
    with pytest.raises(RuntimeError, match="--time-budget 450s --resume") as caught:
        bpy.ops.insideout.reconstruct()
    assert "--preset" not in str(caught.value)


def test_times_are_estimated_for_each_preset(blender, make_engine, tmp_path):
    make_engine(
        "assert arguments[0] == 'forecast', arguments\n"
        f"assert arguments[1:] == [{str(tmp_path)!r}, '--refine', 'apart'], arguments\n"
        "send('forecast', preset='draft', seconds=77.0, parts={}, cameras=False)\n"
        "send('forecast', preset='standard', seconds=400.0, parts={}, cameras=True)\n"
        "send('done')\n"
    )
    settings = bpy.context.scene.insideout
    settings.capture, settings.refine = str(tmp_path), "apart"
    assert bpy.ops.insideout.forecast() == {"FINISHED"}
    state = bpy.context.window_manager.insideout
    assert [(row.name, row.seconds, row.cameras) for row in state.forecasts] == [
        ("draft", 77.0, False),
        ("standard", 400.0, True),
    ]
    assert state.forecast_of == forecast_subject(settings)
    settings.refine = "joint"
    assert state.forecast_of != forecast_subject(settings)
    settings.refine, settings.effects = "apart", "AUTO"
    assert state.forecast_of != forecast_subject(settings), "looking takes time, too"


def test_what_presets_may_reach_is_told_from_the_finished_run(blender, make_engine, tmp_path):
    capture, run = tmp_path / "vase", tmp_path / "vase run"
    make_engine(
        "import os\n"
        f"run = os.environ['INSIDEOUT_RUN']; assert run == {str(run)!r}, run\n"
        "known = os.path.isfile(os.path.join(run, 'report.json'))\n"
        "send('forecast', preset='draft', seconds=7.0, psnr={'photos': [27.5, 31.0], 'projections': [40, 41]})\n"
        "send('forecast', preset='paper', seconds=70.0, psnr={})\n"
        "send('done', known=known)\n"
    )
    bpy.context.scene.insideout.capture = str(capture)
    state = bpy.context.window_manager.insideout
    bpy.ops.insideout.forecast()
    assert [(row.quality, row.least_db, row.most_db) for row in state.forecasts] == [
        ("photos", 27.5, 31.0),
        ("", 0.0, 0.0),
    ]
    assert not state.forecast_known, "there is no run yet"
    run.mkdir()
    (run / "report.json").write_text("{}")
    bpy.ops.insideout.forecast()
    assert state.forecast_known


def test_an_engine_of_before_decibels_estimates_times_still(blender, make_engine, tmp_path):
    make_engine(
        "import argparse\n"
        "parser = argparse.ArgumentParser(); parser.add_argument('command'); parser.add_argument('capture')\n"
        "parser.add_argument('--refine'); parser.parse_args(arguments)\n"
        "send('forecast', preset='draft', seconds=7.0); send('done')\n"
    )
    settings, run = bpy.context.scene.insideout, tmp_path / "vase run"
    run.mkdir()
    (run / "report.json").write_text("{}")
    settings.capture = str(tmp_path / "vase")
    assert bpy.ops.insideout.forecast() == {"FINISHED"}
    assert bpy.context.window_manager.insideout.forecasts[0].seconds == 7.0


@pytest.mark.parametrize(
    ("presets", "told"),
    [
        (
            [{"photos": [27, 31]}, {"projections": [40, 41]}, {"photos": [33, 35]}],
            [("photos", 27, 31), ("", 0, 0), ("photos", 33, 35)],
        ),
        (
            [{"photos": [27, 31], "projections": [40, 41]}, {"projections": [44, 45]}],
            [("projections", 40, 41), ("projections", 44, 45)],
        ),
        ([{}, {}], [("", 0, 0), ("", 0, 0)]),
    ],
)
def test_figures_beside_each_other_are_of_one_kind(blender, make_engine, tmp_path, presets, told):
    rows = zip(("draft", "standard", "paper"), presets, strict=False)
    sent = [f"send('forecast', preset={preset!r}, seconds=7.0, psnr={psnr})\n" for preset, psnr in rows]
    make_engine("".join([*sent, "send('done', known=False)\n"]))
    bpy.context.scene.insideout.capture = str(tmp_path)
    bpy.ops.insideout.forecast()
    found = bpy.context.window_manager.insideout.forecasts
    assert [(row.quality, row.least_db, row.most_db) for row in found] == told


def test_an_estimate_is_of_the_run_that_it_was_told_from(blender, make_engine, tmp_path):
    make_engine("send('forecast', preset='draft', seconds=7.0, psnr={'photos': [27, 31]}); send('done', known=True)\n")
    settings, state = bpy.context.scene.insideout, bpy.context.window_manager.insideout
    settings.capture = str(tmp_path / "vase")
    bpy.ops.insideout.forecast()
    settings.run = str(tmp_path / "vase run")
    assert state.forecast_of == forecast_subject(settings), "that is where it goes by itself"
    settings.run = str(tmp_path / "other run")
    assert state.forecast_of != forecast_subject(settings)


@pytest.mark.parametrize("end", ["send('done')", "send('cancelled'); sys.exit(130)", "sys.exit(1)"])
def test_a_run_that_ends_outdates_the_estimate(blender, make_engine, tmp_path, end):
    make_engine(
        f"if arguments[0] == 'forecast': send('forecast', preset='draft', seconds=7.0); send('done')\nelse: {end}\n"
    )
    settings, state = bpy.context.scene.insideout, bpy.context.window_manager.insideout
    settings.capture, settings.import_when_done = str(tmp_path / "vase"), False
    bpy.ops.insideout.forecast()
    assert state.forecast_of == forecast_subject(settings)
    with suppress(RuntimeError):
        bpy.ops.insideout.reconstruct()
    assert state.forecast_of != forecast_subject(settings)


def test_a_capture_is_the_same_however_its_path_is_written(blender, make_engine, tmp_path):
    """Saving makes it relative to the .blend, with .. in it where that lies elsewhere."""
    make_engine("send('error', kind='SettingError', message=' '.join(arguments)); sys.exit(2)\n")
    (tmp_path / "capture" / "scenes").mkdir(parents=True)
    settings = bpy.context.scene.insideout
    settings.capture = f"{tmp_path / 'capture'}/"
    subject = forecast_subject(settings)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "capture" / "scenes" / "a.blend"))
    settings.capture = "//../"
    assert forecast_subject(settings) == subject
    with pytest.raises(RuntimeError, match=f"run {tmp_path}/capture --out {tmp_path}/capture run"):
        bpy.ops.insideout.reconstruct()


def test_the_root_of_a_disk_has_an_estimate_too(blender):
    settings = bpy.context.scene.insideout
    settings.capture = str(Path(tempfile.gettempdir()).anchor)
    assert forecast_subject(settings).endswith(" run")


def test_an_estimate_that_failed_leaves_none(blender, make_engine, tmp_path):
    make_engine("send('error', kind='CaptureError', message='photos/: empty; add photos.'); sys.exit(2)\n")
    state = bpy.context.window_manager.insideout
    bpy.context.scene.insideout.capture = str(tmp_path)
    state.forecasts.add().name = "draft"
    with pytest.raises(RuntimeError, match="photos/: empty"):
        bpy.ops.insideout.forecast()
    assert (len(state.forecasts), state.forecast_of) == (0, "")


def test_an_estimate_stays_with_the_machine_it_was_made_on(blender, tmp_path):
    """A file that is opened elsewhere has its capture under the same path perhaps, but not the same speed."""
    state = bpy.context.window_manager.insideout
    state.forecasts.add().name = "draft"
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shared.blend"))
    state.forecasts.clear()
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "shared.blend"))
    assert not len(bpy.context.window_manager.insideout.forecasts)


def test_starting_over_is_for_one_run(blender, make_engine, tmp_path):
    make_engine("send('error', kind='SettingError', message=' '.join(arguments)); sys.exit(2)\n")
    bpy.context.scene.insideout.capture = str(tmp_path)
    bpy.context.window_manager.insideout.start_over = True
    with pytest.raises(RuntimeError, match="--preset draft --fresh"):
        bpy.ops.insideout.reconstruct()
    with pytest.raises(RuntimeError, match="--preset draft --resume"):
        bpy.ops.insideout.reconstruct()


def test_an_undo_after_a_run_does_not_bring_starting_over_back(blender, make_engine, tmp_path):
    """The next run would discard what that one has made."""
    make_engine("send('error', kind='SettingError', message=' '.join(arguments)); sys.exit(2)\n")
    bpy.context.scene.insideout.capture = str(tmp_path)
    bpy.context.window_manager.insideout.start_over = True
    bpy.ops.ed.undo_push(message="chosen")
    with pytest.raises(RuntimeError, match="--preset draft --fresh"):
        bpy.ops.insideout.reconstruct()
    bpy.ops.object.empty_add()
    bpy.ops.ed.undo_push(message="something else")
    assert bpy.ops.ed.undo() == {"FINISHED"}
    with pytest.raises(RuntimeError, match="--preset draft --resume"):
        bpy.ops.insideout.reconstruct()


@pytest.mark.parametrize("load_ui", [False, True])
def test_starting_over_is_not_for_the_run_of_another_file(blender, tmp_path, load_ui):
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "other.blend"))
    bpy.context.window_manager.insideout.start_over = True
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "other.blend"), load_ui=load_ui)
    assert not bpy.context.window_manager.insideout.start_over


def test_starting_over_is_not_for_the_run_of_another_scene(blender, make_engine, tmp_path):
    make_engine("send('error', kind='SettingError', message=' '.join(arguments)); sys.exit(2)\n")
    bpy.context.window_manager.insideout.start_over = True
    bpy.context.window.scene = bpy.data.scenes.new("another")
    bpy.context.scene.insideout.capture = str(tmp_path)
    assert not bpy.context.window_manager.insideout.start_over
    with pytest.raises(RuntimeError, match="--preset draft --resume"):
        bpy.ops.insideout.reconstruct()


class TestTheRunFolderThatWasFilledIn:
    """Of one capture; another's runs are refused there."""

    @pytest.fixture
    def runs(self, blender, make_engine, tmp_path):
        """`runs(capture)`: where the run of a capture goes."""
        make_engine("send('done', run=arguments[arguments.index('--out') + 1], report={})\n")
        settings = bpy.context.scene.insideout
        settings.import_when_done = False

        def run(capture):
            settings.capture = str(tmp_path / capture)
            assert bpy.ops.insideout.reconstruct() == {"FINISHED"}
            return Path(bpy.path.abspath(settings.run)).resolve()

        return run

    def test_follows_the_capture(self, runs, tmp_path):
        assert [runs(capture) for capture in "aba"] == [tmp_path / f"{capture} run" for capture in "aba"]

    def test_follows_it_after_the_blend_was_saved(self, runs, tmp_path):
        runs("a")
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"), relative_remap=True)
        assert bpy.context.scene.insideout.run == "//a run"
        assert runs("a") == tmp_path / "a run"
        assert runs("b") == tmp_path / "b run"

    def test_follows_it_after_the_project_was_moved(self, runs, tmp_path):
        project, moved = tmp_path / "project", tmp_path / "moved"
        project.mkdir()
        runs("project/a")
        bpy.ops.wm.save_as_mainfile(filepath=str(project / "a.blend"), relative_remap=True)
        project.rename(moved)
        bpy.ops.wm.open_mainfile(filepath=str(moved / "a.blend"))
        bpy.context.scene.insideout.import_when_done = False
        assert Path(bpy.path.abspath(bpy.context.scene.insideout.run)) == moved / "a run"
        bpy.context.scene.insideout.capture = str(moved / "b")
        assert bpy.ops.insideout.reconstruct() == {"FINISHED"}
        assert Path(bpy.path.abspath(bpy.context.scene.insideout.run)) == moved / "b run"

    def test_stays_where_it_was_chosen(self, runs, tmp_path):
        runs("a")
        bpy.context.scene.insideout.run = str(tmp_path / "mine")
        assert runs("b") == tmp_path / "mine"

    def test_is_said_to_be_another_before_the_run(self, runs, draw_panels, tmp_path):
        def said():
            return [text for text in draw_panels(5000) if text.startswith("The next run goes to")]

        runs("a")
        assert said() == []
        settings, subject = bpy.context.scene.insideout, forecast_subject(bpy.context.scene.insideout)
        settings.capture = str(tmp_path / "b")
        assert said() == [f"The next run goes to {tmp_path / 'b run'}"]
        assert forecast_subject(settings) == subject.replace(str(tmp_path / "a"), str(tmp_path / "b"))


def test_an_import_without_a_run_says_what_to_choose(blender):
    with pytest.raises(RuntimeError, match="Choose the folder of a run"):
        bpy.ops.insideout.import_run()


def test_a_crash_shows_its_message_and_leaves_the_scene_as_it_was(blender, make_engine, tmp_path):
    make_engine("print('torch exploded', file=sys.stderr); sys.exit(9)\n")
    bpy.ops.object.empty_add()
    settings = bpy.context.scene.insideout
    settings.capture = str(tmp_path)
    before = sorted(o.name for o in bpy.data.objects)
    with pytest.raises(RuntimeError, match="torch exploded"):
        bpy.ops.insideout.reconstruct()
    assert "torch exploded" in bpy.context.window_manager.insideout.error
    assert sorted(o.name for o in bpy.data.objects) == before
    assert settings.model is None


def test_a_mistake_of_the_users_is_shown_as_the_engine_says_it(blender, make_engine, tmp_path):
    make_engine("send('error', kind='CaptureError', message='photos/: empty; add photos.'); sys.exit(2)\n")
    bpy.context.scene.insideout.capture = str(tmp_path)
    with pytest.raises(RuntimeError, match="photos/: empty; add photos"):
        bpy.ops.insideout.reconstruct()


def test_without_an_engine_the_user_is_told_what_to_do_and_nothing_changes(blender, no_engine, tmp_path):
    settings, state = bpy.context.scene.insideout, bpy.context.window_manager.insideout
    settings.capture = settings.checked = str(tmp_path)
    state.start_over = True
    settings.findings.add().message = "few photos"
    for button in (bpy.ops.insideout.reconstruct, bpy.ops.insideout.check):
        with pytest.raises(RuntimeError, match=r"No engine found; name the Python.*--engine"):
            button()
    assert (settings.run, state.start_over) == ("", True)
    assert [finding.message for finding in settings.findings] == ["few photos"]
    assert settings.checked == str(tmp_path)


def test_an_engine_that_is_not_where_it_was_is_named(blender, no_engine, monkeypatch, tmp_path):
    monkeypatch.setenv("INSIDEOUT_ENGINE", str(tmp_path / "gone"))
    with pytest.raises(RuntimeError, match="gone: INSIDEOUT_ENGINE is not there"):
        bpy.ops.insideout.engine_check()


def test_relative_paths_mean_blenders_folder(blender, make_engine, tmp_path, monkeypatch):
    """The engine starts in another one."""
    make_engine("send('error', kind='SettingError', message=' '.join(arguments)); sys.exit(2)\n")
    monkeypatch.chdir(tmp_path)
    bpy.context.scene.insideout.capture = "cap"
    with pytest.raises(RuntimeError, match=f"run {tmp_path}/cap --out {tmp_path}/cap run"):
        bpy.ops.insideout.reconstruct()
    with pytest.raises(RuntimeError, match=f"check {tmp_path}/cap"):
        bpy.ops.insideout.check()


def test_without_a_capture_there_is_nothing_to_run(blender):
    assert not bpy.ops.insideout.reconstruct.poll()
    assert not bpy.ops.insideout.check.poll()
    assert not bpy.ops.insideout.forecast.poll()
    assert not bpy.ops.insideout.cancel.poll()


def test_the_engine_says_its_version(blender, make_engine):
    make_engine("send('version', insideout='1.2', torch='9.9')\n")
    bpy.ops.insideout.engine_check()
    assert bpy.context.window_manager.insideout.engine_version == "InsideOut 1.2, torch 9.9"


@pytest.mark.parametrize("press", ["try", "make", "choose"])
def test_a_version_that_was_another_engine_s_is_not_shown(blender, make_engine, monkeypatch, tmp_path, press):
    make_engine("send('error', kind='CaptureError', message='no torch'); sys.exit(2)\n")
    state = bpy.context.window_manager.insideout
    state.engine_version = "InsideOut 1.2, torch 9.9"
    if press == "try":
        with pytest.raises(RuntimeError, match="no torch"):
            bpy.ops.insideout.engine_check()
    elif press == "make":
        monkeypatch.setattr(commands, "setup_command", lambda *_: [sys.executable, "-c", ""])
        commands.start_setup(SimpleNamespace(report=lambda *_: None), Path(sys.executable), tmp_path)
    else:
        preferences._on_engine_changed(None, bpy.context)
    assert state.engine_version == ""


def test_downloads_need_online_access(blender):
    assert bpy.ops.insideout.engine_setup.poll() == bpy.app.online_access
