"""The add-on comes and goes without a trace."""

from __future__ import annotations

import subprocess
import sys

import bpy

import insideout


def _traces():
    handlers = {name: list(getattr(bpy.app.handlers, name)) for name in ("depsgraph_update_post", "load_post")}
    return set(dir(bpy.types)), set(dir(bpy.types.Scene)), set(dir(bpy.types.WindowManager)), handlers


def test_unregister_leaves_nothing_behind():
    before = _traces()
    insideout.register()
    assert hasattr(bpy.types.Scene, "insideout")
    assert hasattr(bpy.types, "INSIDEOUT_PT_section")
    insideout.unregister()
    assert _traces() == before


def test_can_be_enabled_again():
    for _ in range(2):
        insideout.register()
        assert hasattr(bpy.types, "INSIDEOUT_PT_section")
        insideout.unregister()
        assert not hasattr(bpy.types, "INSIDEOUT_PT_section")


def test_nothing_of_ours_hangs_on_blenders_modules(blender):
    for module in (bpy, bpy.app, bpy.app.handlers, bpy.data):
        assert [name for name in dir(module) if "insideout" in name.lower()] == []


def test_blender_needs_numpy_alone():
    """Blender has no torch: registering, and all that operators import, must do without the engine's packages."""
    code = (
        "import bpy, sys, insideout; insideout.register(); "
        "import insideout.insideout_addon.scene.showcase; "
        "bad = {'torch', 'scipy', 'numba', 'skimage', 'cv2', 'PIL', 'trimesh', 'SimpleITK'} & set(sys.modules); "
        "insideout.unregister(); "
        "print('heavy:', sorted(bad))"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "heavy: []" in answer.stdout
