"""On Linux names of files may be any bytes: of those that are no UTF-8 Python keeps something that Blender refuses."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import bpy
import pytest

from insideout.insideout_addon.engine import job
from insideout.insideout_addon.engine.commands import forecast_subject
from insideout.insideout_addon.remembered import forget
from insideout.insideout_addon.told_text import displayable

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="other systems have names of letters alone")


@pytest.fixture
def place(blender, tmp_path):
    """A folder called so."""
    path = Path(os.fsdecode(os.fsencode(tmp_path / "caf") + b"\xe9"))
    path.mkdir()
    return path


def _check_texts(texts):
    assert [text for text in texts if text != displayable(text)] == []


def test_what_is_no_utf_8_is_a_question_mark():
    assert displayable("caf\udce9 b\u00e4r") == "caf? b\u00e4r"
    assert displayable(Path("a")) == "a"


def test_findings_of_it_are_shown(place, make_engine, draw_panels):
    make_engine(
        "subject = arguments[1] + '/photos'\n"
        "send('finding', level='warning', subject=subject, message=subject + ' is bad', advice='rename ' + subject)\n"
        "send('done')\n"
    )
    settings = bpy.context.scene.insideout
    settings.capture = str(place)
    assert bpy.ops.insideout.check() == {"FINISHED"}
    texts = draw_panels(5000)
    assert any(text.endswith("caf?/photos is bad") for text in texts)
    _check_texts(texts)


def test_times_are_estimated(place, make_engine):
    make_engine("send('forecast', preset='draft', seconds=7.0, psnr={}); send('done')\n")
    bpy.context.scene.insideout.capture = str(place)
    assert bpy.ops.insideout.forecast() == {"FINISHED"}
    state = bpy.context.window_manager.insideout
    assert state.forecast_of == forecast_subject(bpy.context.scene.insideout)


def test_a_run_shows_how_far_it_is_and_its_model(place, make_engine, draw_panels, tmp_path, random_set):
    random_set.save(tmp_path / "made.ply")
    make_engine(
        "import shutil, pathlib\n"
        "out = pathlib.Path(arguments[arguments.index('--out') + 1]); out.mkdir()\n"
        f"shutil.copy({str(tmp_path / 'made.ply')!r}, out / 'fused.ply')\n"
        "send('stage', stage='surface', state='skipped', reason='nothing in ' + arguments[1])\n"
        "send('progress', stage='fuse', fraction=0.5, message=arguments[1])\n"
        "send('done')\n"
    )
    settings = bpy.context.scene.insideout
    settings.capture = str(place)
    assert bpy.ops.insideout.reconstruct() == {"FINISHED"}
    assert settings.model.name == "caf? run fused"
    assert Path(settings.run).name == f"{place.name} run"
    texts = draw_panels(5000)
    assert any(text.endswith("caf?") for text in texts)
    _check_texts(texts)
    (Path(settings.run) / "fused.ply").rename(Path(settings.run) / "gone.ply")
    forget()
    _check_texts(draw_panels(5000))


def test_an_error_is_told(place, make_engine):
    make_engine("send('error', kind='CaptureError', message=arguments[1])\n")
    bpy.context.scene.insideout.capture = str(place)
    with pytest.raises(RuntimeError, match=r"caf\?"):
        bpy.ops.insideout.reconstruct()
    assert "caf?" in bpy.context.window_manager.insideout.error


def test_models_are_imported_from_there_and_saved_there(place, random_set, capsys):
    random_set.save(place / f"{place.name}.ply")
    settings = bpy.context.scene.insideout
    settings.pixels = 32
    for press in (bpy.ops.insideout.import_file, bpy.ops.insideout.import_run):
        assert press(filepath=str(place / f"{place.name}.ply")) == {"FINISHED"}
    assert bpy.ops.insideout.export_file(filepath=str(place / f"{place.name} 2.ply")) == {"FINISHED"}
    bpy.ops.insideout.section_add()
    assert bpy.ops.insideout.section_save(filepath=str(place / "section.png")) == {"FINISHED"}
    assert bpy.ops.insideout.relink(filepath=str(place / f"{place.name}.ply")) == {"FINISHED"}
    said = capsys.readouterr().out
    assert said.count("caf?") >= 5
    with pytest.raises(RuntimeError, match=r"caf\?.*is a folder"):
        bpy.ops.insideout.export_file(filepath=str(place))


def test_whatever_else_goes_wrong_in_the_timer_is_said(blender, monkeypatch):
    class Process:
        killed = False

        def poll(self):
            raise ValueError("no such number")

        def kill(self):
            self.killed = True

    running, state = job.Job(Process(), "Working", print, print), bpy.context.window_manager.insideout
    monkeypatch.setattr(job, "_current", [running])
    job._reset_state("Working", "reconstruct")
    with pytest.raises(ValueError, match="no such number"):
        job.tick()
    assert running.process.killed
    assert not job.job_running()
    assert (state.running, state.error) == (False, "no such number")
