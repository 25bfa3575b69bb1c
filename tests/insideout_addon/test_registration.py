"""The add-on comes and goes without a trace."""

from __future__ import annotations

import gc
import subprocess
import sys

import bpy

import insideout
from insideout import operators
from insideout.insideout_addon import properties
from insideout.insideout_addon.engine import curve_icons, job
from insideout.insideout_addon.scene import section_live


def _traces():
    lists = [name for name in dir(bpy.app.handlers) if isinstance(getattr(bpy.app.handlers, name), list)]
    assert "frame_change_post" in lists
    return {
        "types": set(dir(bpy.types)),
        "properties": (set(dir(bpy.types.Scene)), set(dir(bpy.types.WindowManager))),
        "handlers": {name: list(getattr(bpy.app.handlers, name)) for name in lists},
        "timers": [bpy.app.timers.is_registered(timer) for timer in (section_live._redraw_live, job.tick)],
        "bpy": set(vars(bpy)),
        "drivers": set(bpy.app.driver_namespace),
    }


def test_unregister_leaves_nothing_behind():
    before = _traces()
    insideout.register()
    assert hasattr(bpy.types.Scene, "insideout")
    assert hasattr(bpy.types, "INSIDEOUT_PT_section")
    insideout.unregister()
    assert _traces() == before


def _paths(rna):
    return [prop for prop in rna.properties if prop.type == "STRING" and prop.subtype in ("FILE_PATH", "DIR_PATH")]


def test_every_path_may_start_from_the_folder_of_the_blend(blender):
    """Else Blender warns of "//", and its file browser offers no relative path."""
    owners = [properties.InsideOutSettings.bl_rna]
    for cls in operators.CLASSES:
        group, name = cls.bl_idname.split(".")
        owners.append(getattr(getattr(bpy.ops, group), name).get_rna_type())
    paths = [(owner.identifier, prop) for owner in owners for prop in _paths(owner)]
    assert len(paths) > 10
    assert [(owner, prop.identifier) for owner, prop in paths if not prop.is_path_supports_blend_relative] == []


def test_can_be_enabled_again():
    for _ in range(2):
        insideout.register()
        assert hasattr(bpy.types, "INSIDEOUT_PT_section")
        insideout.unregister()
        assert not hasattr(bpy.types, "INSIDEOUT_PT_section")


def test_it_can_be_disabled_after_a_script_has_cleared_blenders_handlers():
    before = _traces()
    insideout.register()
    for name, handlers in before["handlers"].items():
        # As some do that render animations.
        getattr(bpy.app.handlers, name)[:] = handlers
    insideout.unregister()
    assert _traces() == before


def test_timers_end_with_the_add_on():
    insideout.register()
    for timer in (section_live._redraw_live, job.tick):
        bpy.app.timers.register(timer, first_interval=60.0)
    assert _traces()["timers"] == [True, True]
    insideout.unregister()
    assert _traces()["timers"] == [False, False]


def test_using_it_hangs_nothing_onto_blenders_modules(blender, random_set, tmp_path):
    random_set.save(tmp_path / "fused.ply")
    before = _traces()
    bpy.ops.insideout.import_run(filepath=str(tmp_path / "fused.ply"))
    bpy.ops.insideout.section_add()
    bpy.ops.insideout.section_save(filepath=str(tmp_path / "section.png"))
    assert _traces() == before


def test_pictures_of_curves_go_with_the_add_on(capfd):
    insideout.register()
    curve_icons.curve_icon("run", ())
    curve_icons.mark_icon("photos")
    (pictures,) = curve_icons._collections
    insideout.unregister()
    assert curve_icons._collections == []
    assert len(pictures) == 0
    del pictures
    gc.collect()
    assert "left open" not in "".join(capfd.readouterr()), "what Blender says of pictures that are not removed"
    insideout.register()
    curve_icons.curve_icon("run", ())
    insideout.unregister()


def test_pictures_of_curves_change_no_file(blender):
    before = {name: len(getattr(bpy.data, name)) for name in ("images", "textures", "materials", "objects")}
    curve_icons.curve_icon("run", ())
    assert {name: len(getattr(bpy.data, name)) for name in before} == before


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


def test_what_callbacks_follow_cannot_be_keyframed(blender):
    """Blender calls none for keyframes."""
    from insideout.insideout_addon import properties

    section = ("cut", "flip", "slab_mm", "apart_mm", "show_density", "picture", "beside")
    colors = ("low", "high", "colors", "unit", "water", "pixels", "color_by")
    scene = ("section_index", *colors, "hide_background", "peel_mm")
    for kind, names in ((properties.InsideOutSection, section), (properties.InsideOutSettings, scene)):
        assert [name for name in names if kind.bl_rna.properties[name].is_animatable] == []
