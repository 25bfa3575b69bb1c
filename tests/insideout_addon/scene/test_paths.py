"""Paths as a .blend keeps them, and names that are still free."""

from __future__ import annotations

import os
from pathlib import Path

import bpy
import pytest

from insideout.insideout_addon.scene import showcase
from insideout.insideout_addon.scene.importing import import_splats
from insideout.insideout_addon.scene.paths import blend_relative, free_path


@pytest.fixture
def other_drive(monkeypatch):
    """What os.path.relpath does on Windows between C: and D:."""

    def refuse(path, start=None):
        raise ValueError("path is on mount 'D:', start on mount 'C:'")

    monkeypatch.setattr(os.path, "relpath", refuse)


def test_without_a_blend_a_path_stays_absolute(blender, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert blend_relative("run/fused.ply") == str(tmp_path / "run" / "fused.ply")


def test_a_path_is_seen_from_the_blend(blender, tmp_path):
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    assert blend_relative(tmp_path / "run" / "fused.ply") == "//run/fused.ply"
    assert blend_relative("//run/fused.ply") == "//run/fused.ply"
    assert blend_relative(tmp_path / "run", tmp_path / "elsewhere") == "//../run"


def test_another_drive_has_no_relative_path(blender, tmp_path, random_set, other_drive):
    run = tmp_path / "run"
    random_set.save(run / "fused.ply")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"), relative_remap=False)
    splats = import_splats(run / "fused.ply", "model", bpy.context)
    assert splats["insideout_source"] == str(run / "fused.ply")
    saved = showcase.save_blend(bpy.context.scene, tmp_path / "b.blend", run)
    assert saved == tmp_path / "b.blend"
    assert bpy.context.scene.insideout.run == str(run)


def test_a_name_that_is_taken_gets_a_number(tmp_path):
    path = tmp_path / "a.blend"
    for name in ("a.blend", "a-2.blend", "a-3.blend"):
        assert free_path(path) == Path(tmp_path / name)
        (tmp_path / name).touch()
