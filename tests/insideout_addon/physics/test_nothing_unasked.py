"""A scene that asks for no physics has none: no body, no modifier, no cache, no larger file."""

from __future__ import annotations

import bpy


def facts(tmp_path):
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    return {
        "bytes": (tmp_path / "scene.blend").stat().st_size,
        "modifiers": sorted(modifier.type for thing in bpy.data.objects for modifier in thing.modifiers),
        "worlds": sum(scene.rigidbody_world is not None for scene in bpy.data.scenes),
        "bodies": sum(thing.rigid_body is not None for thing in bpy.data.objects),
        "meshes": len(bpy.data.meshes),
        "gravity": tuple(bpy.context.scene.gravity),
        "keys": sorted(bpy.context.scene.keys()),
    }


def test_import_and_section_simulate_nothing(imported, hollow_ball, tmp_path):
    imported(*hollow_ball)
    bpy.ops.insideout.section_add()
    bpy.context.scene.frame_set(10)
    found = facts(tmp_path)
    assert found["worlds"] == found["bodies"] == 0
    assert set(found["modifiers"]) == {"NODES"}
    assert found["gravity"][2] == bpy.types.Scene.bl_rna.properties["gravity"].default_array[2]


def test_a_file_is_as_small_after_a_break_was_undone(imported, hollow_ball, tmp_path):
    imported(*hollow_ball)
    before = facts(tmp_path)
    bpy.ops.insideout.break_model(pieces=4)
    broken = facts(tmp_path)
    assert broken["worlds"] == 1
    assert broken["bodies"] > 4
    bpy.ops.insideout.unbreak()
    after = facts(tmp_path)
    assert abs(after.pop("bytes") - before.pop("bytes")) < 4096
    assert after == before
