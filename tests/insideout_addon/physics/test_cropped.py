"""A model of which the user has deleted splats: the run's mesh is still that of all, and that is said."""

from __future__ import annotations

import bpy
import pytest

from insideout.insideout_addon.physics.whole import mesh_path
from insideout.insideout_addon.scene.node_tree import TreeBuilder

TOLD = "Splats were deleted or added since the import: the mesh is still that of the whole run"


def crop(model):
    """Deletes the first splat, by nodes that are applied."""
    group = bpy.data.node_groups.new("crop", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        group.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    b = TreeBuilder(group)
    points = b.add("NodeGroupInput").outputs[0]
    first = b.compare("LESS_THAN", b.add("GeometryNodeInputIndex").outputs[0], 0.5)
    b.add("NodeGroupOutput", {0: b.deleted(points, first)})
    model.modifiers.new("crop", "NODES").node_group = group
    model.modifiers.move(len(model.modifiers) - 1, 0)
    bpy.context.view_layer.objects.active = model
    bpy.ops.object.modifier_apply(modifier="crop")


@pytest.fixture(params=["break_model", "make_rigid"])
def press(request, capsys):
    """Presses one of the buttons that use the mesh, and returns what Blender then tells."""

    def press():
        capsys.readouterr()
        assert getattr(bpy.ops.insideout, request.param)() == {"FINISHED"}
        return capsys.readouterr().out

    return press


def test_it_is_said_before_and_after(draw_panels, imported, hollow_ball, press):
    model = imported(*hollow_ball)
    count = len(model.data.points)
    crop(model)
    assert len(model.data.points) == count - 1
    assert TOLD in draw_panels(2000)
    assert f"Warning: {TOLD}" in press()


def test_of_a_model_as_it_was_imported_nothing_is_said(draw_panels, imported, hollow_ball, press):
    imported(*hollow_ball)
    assert TOLD not in draw_panels(2000)
    assert TOLD not in press()


def test_without_a_mesh_it_falls_by_its_own_hull(draw_panels, imported, hollow_ball, capsys):
    model = imported(*hollow_ball)
    mesh_path(model).unlink()
    crop(model)
    bpy.ops.insideout.make_rigid()
    assert TOLD not in capsys.readouterr().out
