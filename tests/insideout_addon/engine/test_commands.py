"""What a finished run does to the scene when the user has gone on working meanwhile."""

from __future__ import annotations

import subprocess
import sys
from types import SimpleNamespace

import bpy
import pytest

from insideout.insideout_addon.engine import job

_RUN = (
    "import pathlib, shutil\n"
    "out = pathlib.Path(arguments[arguments.index('--out') + 1]); out.mkdir()\n"
    "shutil.copy({made!r}, out / 'fused.ply')\n"
    "send('stage', stage='fuse', state='started')\n"
    "while not pathlib.Path({go!r}).exists(): time.sleep(0.02)\n"
    "send('done', run=str(out))\n"
)


# Blender's own start file has a window, whose scene stays as it is; a timer is called without one.
_OTHER_SCENE = """
import sys
from pathlib import Path
from types import SimpleNamespace

import bpy
import insideout
from insideout.insideout_addon.engine.commands import import_result

bpy.ops.wm.read_factory_settings(use_empty=False)
assert len(bpy.context.window_manager.windows)
asked = bpy.data.scenes.new("Asked")
insideout.register()
with bpy.context.temp_override(window=None):
    import_result(asked.session_uid, Path({run!r}))
print("Asked:", sorted(asked.objects.keys()), "Scene:", sorted(bpy.data.scenes["Scene"].objects.keys()))
print("Meshes:", list(bpy.data.meshes.keys()))
error = bpy.context.window_manager.insideout.error
insideout.unregister()
sys.exit(error or 0)
"""

# Without a window the file is read and placed at once; the timer's steps are taken one by one here.
_TAKEN_AWAY = """
import sys
from concurrent.futures import Future
from pathlib import Path

import bpy
import insideout
from insideout.insideout_addon.engine.commands import _placing, _step
from insideout.insideout_addon.scene.display import PARTS
from insideout.insideout_addon.scene.importing import load_splats

bpy.ops.wm.read_factory_settings(use_empty=False)
insideout.register()
for message in ("Before", "Here"):
    bpy.ops.ed.undo_push(message=message)
loaded, asked = Future(), bpy.context.scene.session_uid
loaded.set_result(load_splats(Path({run!r}) / "fused.ply"))
steps = _placing(loaded, asked, "run", False)
for _ in range(len(PARTS) + 3):
    assert _step(steps, asked)
assert len(bpy.data.pointclouds) == 1
{take_away}
assert len(bpy.data.pointclouds) == 0
print("More:", _step(steps, asked), "Left:", sorted(bpy.data.objects.keys()), list(bpy.data.node_groups))
print(bpy.context.window_manager.insideout.error)
insideout.unregister()
"""


@pytest.fixture
def running(window, make_engine, tmp_path, random_set):
    """A run that is about to end; `running()` lets it end and turns the loop until `settled` says so."""
    random_set.save(tmp_path / "made.ply")
    make_engine(_RUN.format(made=str(tmp_path / "made.ply"), go=str(tmp_path / "go")))
    settings = bpy.context.scene.insideout
    settings.capture, settings.run = str(tmp_path / "capture"), str(tmp_path / "run")
    bpy.ops.insideout.reconstruct()
    window.run(lambda: len(bpy.context.window_manager.insideout.stages) == 1, within_s=20)

    def finish(settled):
        (tmp_path / "go").write_text("", "utf-8")
        window.run(lambda: not job.job_running() and settled(), within_s=20)

    return finish


def test_a_scene_that_was_renamed_gets_its_model(running):
    scene = bpy.context.scene
    scene.name = "Renamed"
    running(lambda: scene.insideout.model is not None)
    assert len(scene.insideout.model.data.points) == 200


def test_another_scene_in_the_window_stays_as_it_is(running):
    """Background mode shows no windows, so the override is what matters here."""
    scene, other = bpy.context.scene, bpy.data.scenes.new("Other")
    running(lambda: scene.insideout.model is not None)
    assert scene.insideout.model.name in scene.objects
    assert len(other.objects) == 0


def test_the_scene_of_the_run_need_not_be_in_the_window(tmp_path, random_set):
    """In a process of its own: Blender crashed when the window's scene was another than the view layer's."""
    random_set.save(tmp_path / "run" / "fused.ply")
    code = _OTHER_SCENE.format(run=str(tmp_path / "run"))
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=100)
    assert answer.returncode == 0, answer.stderr
    assert "Asked: ['run fused'] Scene: ['Camera', 'Cube', 'Light']" in answer.stdout
    assert "Meshes: ['Cube']" in answer.stdout


@pytest.mark.parametrize("take_away", ["bpy.ops.ed.undo()", "bpy.data.orphans_purge(do_recursive=True)"])
def test_what_is_taken_away_while_it_is_placed_ends_the_import(tmp_path, random_set, take_away):
    """In a process of its own: Blender crashed when a point cloud that was gone was to be removed."""
    random_set.save(tmp_path / "run" / "fused.ply")
    code = _TAKEN_AWAY.format(run=str(tmp_path / "run"), take_away=take_away)
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=100)
    assert answer.returncode == 0, answer.stderr
    assert "More: False Left: ['Camera', 'Cube', 'Light'] []" in answer.stdout
    assert "The import was undone before it ended; press Import under Model." in answer.stdout


def test_another_file_stays_as_it_is_and_the_user_is_told_where_the_result_lies(running, window, tmp_path):
    """Both files have a scene called Scene."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    assert job.job_running()
    state = bpy.context.window_manager.insideout
    running(lambda: True)
    assert not window.timers
    assert state.message == f"Done; the result is in {tmp_path / 'run'}"
    assert state.title == "Reconstructing"
    assert bpy.context.scene.insideout.model is None
    assert len(bpy.data.objects) == 0


def test_a_deleted_scene_does_no_harm(running, window):
    other = bpy.data.scenes.new("Other")
    bpy.data.scenes.remove(next(scene for scene in bpy.data.scenes if scene != other))
    running(lambda: True)
    assert not window.timers
    assert other.insideout.model is None


def test_the_model_waits_until_the_user_leaves_edit_mode(running, window, monkeypatch):
    from insideout.insideout_addon.engine import commands

    editing = [True]
    monkeypatch.setattr(commands, "_editing", lambda scene: editing[0])
    scene = bpy.context.scene
    running(lambda: True)
    window.turns(20)
    assert scene.insideout.model is None
    editing[0] = False
    window.run(lambda: scene.insideout.model is not None, within_s=10)


def test_the_model_waits_until_what_an_operator_works_on_is_done(running, window, monkeypatch):
    from insideout.insideout_addon import in_work

    operators = [SimpleNamespace(in_work=True)]
    monkeypatch.setattr(in_work, "modal_operators", lambda: operators)
    scene = bpy.context.scene
    running(lambda: True)
    window.turns(20)
    assert scene.insideout.model is None
    operators[0].in_work = False
    window.run(in_work.is_importing, within_s=10)
    window.run(lambda: scene.insideout.model is not None and not in_work.is_importing(), within_s=10)


def test_a_result_that_cannot_be_read_is_told(running, window, tmp_path):
    (tmp_path / "run" / "fused.ply").write_text("not a ply", "utf-8")
    running(lambda: not window.timers)
    assert "fused.ply" in bpy.context.window_manager.insideout.error
    assert bpy.context.scene.insideout.model is None
