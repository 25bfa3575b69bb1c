"""Pieces that the user has duplicated are the user's: they weigh nothing of the object's and stay when it is whole."""

from __future__ import annotations

import bpy
import pytest

from insideout.core.steps import run_through
from insideout.insideout_addon.physics.baking import bake_in_steps
from insideout.insideout_addon.physics.breaking import BreakOptions, break_model, make_whole, pieces_of
from insideout.insideout_addon.physics.whole import make_rigid
from insideout.insideout_addon.physics.world import bodies_of


@pytest.fixture
def broken(imported, hollow_ball):
    """(model, its pieces)."""
    model = imported(*hollow_ball)
    return model, break_model(model, bpy.context, BreakOptions(g_cm3_per_mm_inv=50.0, pieces=3, spacing_mm=4.0))


def duplicate(thing):
    """As Shift+D does."""
    for other in bpy.context.view_layer.objects:
        other.select_set(other == thing)
    bpy.context.view_layer.objects.active = thing
    bpy.ops.object.duplicate()
    return bpy.context.view_layer.objects.active


def test_a_copy_is_no_piece_and_stays(broken, draw_panels):
    model, pieces = broken
    told = next(text for text in draw_panels() if "3 pieces, " in text)
    copy = duplicate(pieces[1])
    copy.name = "A shard for the printer"
    assert pieces_of(bpy.context.scene, model) == pieces
    assert told in draw_panels()
    make_whole(model, bpy.context.scene)
    assert [thing.name for thing in bpy.data.objects if thing.type == "MESH"] == ["A shard for the printer"]
    assert bodies_of(bpy.context.scene) == []
    # It still falls, as fast as before, until it is no body any more.
    assert copy.rigid_body is not None
    assert bpy.context.scene.gravity.z == pytest.approx(-9810)
    with bpy.context.temp_override(object=copy, active_object=copy):
        bpy.ops.rigidbody.object_remove()
    assert bpy.ops.insideout.unbreak() == {"FINISHED"}
    assert bpy.context.scene.gravity.z == pytest.approx(-9.81)


def test_a_copy_is_baked_with_the_pieces(broken):
    """It falls among them."""
    copy = duplicate(broken[1][1])
    assert set(run_through(bake_in_steps(bpy.context.scene, 1, 3))) == {*broken[1], copy}
    assert copy.rigid_body is None
    assert copy.animation_data is not None
    assert bpy.context.scene.rigidbody_world is None
    assert bpy.context.scene.gravity.z == pytest.approx(-9.81)


def test_a_copy_in_another_scene_is_none_of_the_object_s_either(broken):
    model, pieces = broken
    copy, other = duplicate(pieces[0]), bpy.data.scenes.new("Prints")
    for collection in copy.users_collection:
        collection.objects.unlink(copy)
    other.collection.objects.link(copy)
    assert bodies_of(other, model) == []
    make_whole(model, other)
    assert copy.name in other.objects


def test_of_a_file_that_is_opened_again_too(broken, tmp_path):
    """Things are read in the order of their names, and the copy's comes first."""
    duplicate(broken[1][1]).name = "A shard for the printer"
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    model = bpy.context.scene.insideout.model
    assert "A shard for the printer" not in {piece.name for piece in pieces_of(bpy.context.scene, model)}
    assert len(pieces_of(bpy.context.scene, model)) == 3


def test_a_copy_with_its_splats_keeps_them(broken):
    model, pieces = broken
    (cloud,) = pieces[0].children
    for thing in bpy.context.view_layer.objects:
        thing.select_set(thing in (pieces[0], cloud))
    cloud.hide_set(False)
    cloud.hide_viewport = False
    cloud.select_set(True)
    bpy.context.view_layer.objects.active = pieces[0]
    bpy.ops.object.duplicate()
    copies = [thing for thing in bpy.context.selected_objects if thing not in (pieces[0], cloud)]
    assert len(copies) == 2
    make_whole(model, bpy.context.scene)
    assert all(copy.name in bpy.context.scene.objects for copy in copies)
    assert cloud not in list(bpy.data.objects)


def test_where_the_piece_itself_was_deleted_its_copy_takes_its_place(broken):
    model, pieces = broken
    copy = duplicate(pieces[2])
    bpy.data.objects.remove(pieces[2])
    assert pieces_of(bpy.context.scene, model)[2] == copy


def test_a_copy_of_a_rigid_body_stays(imported, hollow_ball):
    model = imported(*hollow_ball)
    body = make_rigid(model, bpy.context.scene, 50.0)
    duplicate(body).name = "Mine"
    make_whole(model, bpy.context.scene)
    assert "Mine" in bpy.context.scene.objects
    assert [thing.name for thing in bpy.data.objects if thing.type == "MESH"] == ["Mine"]
