"""Blender's own Apply on section planes and boxes: their cuts stay where they are."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from mathutils import Euler, Matrix

from insideout.insideout_addon.scene.section import section_view
from insideout.insideout_addon.scene.section_box import box_views
from insideout.insideout_addon.scene.section_picture import refresh_sections
from insideout.insideout_addon.scene.sections import add_section_box, add_section_plane

APPLIED = [
    {"location": False, "rotation": True, "scale": False},
    {"location": False, "rotation": False, "scale": True},
    {"location": True, "rotation": True, "scale": True},
]


def _sections():
    return bpy.context.scene.insideout.sections


def _apply(thing, **what):
    for other in bpy.context.scene.objects:
        other.select_set(other == thing)
    bpy.context.view_layer.objects.active = thing
    assert bpy.ops.object.transform_apply(**what) == {"FINISHED"}


def _cut(section, model):
    """(planes, 2, 3) the middle and the normal of what it cuts at, in the model's frame."""
    views = box_views if section.shape == "BOX" else lambda *given: [section_view(*given)]
    found = views(section.object, model, 16)
    middles = [view.points().reshape(-1, 3).mean(axis=0) for view in found]
    return np.array([middles, [view.normal for view in found]]).swapaxes(0, 1)


def _size(section, model):
    view = section_view(section.object, model, 16)
    return np.linalg.norm([view.width * np.asarray(view.u), view.height * np.asarray(view.v)], axis=1)


@pytest.fixture(params=[1.0, 0.001])
def scaled(request, model):
    """The model as in a scene in mm, and as in one in metres."""
    model.scale = (request.param,) * 3
    bpy.context.view_layer.update()
    return model


@pytest.mark.parametrize("what", APPLIED)
@pytest.mark.parametrize("apart", [0.0, 3.0])
def test_a_plane_cuts_where_it_did(scaled, what, apart):
    plane = add_section_plane(scaled, bpy.context)
    section = _sections()[0]
    section.apart_mm = apart
    plane.matrix_world = Euler((0.2, 0.4, -0.3)).to_matrix().to_4x4() @ plane.matrix_world
    plane.location.x += 3 * scaled.scale.x
    bpy.context.view_layer.update()
    refresh_sections(bpy.context.scene)
    before, size, basis = _cut(section, scaled), _size(section, scaled), plane.matrix_basis.copy()
    corners = [tuple(vertex.co) for vertex in plane.data.vertices]
    _apply(plane, **what)
    np.testing.assert_allclose(_cut(section, scaled), before, atol=1e-4)
    np.testing.assert_allclose(_size(section, scaled), size, rtol=1e-5)
    np.testing.assert_allclose(plane.matrix_basis, basis, atol=1e-6)
    np.testing.assert_allclose([tuple(vertex.co) for vertex in plane.data.vertices], corners, rtol=1e-6)


def test_the_first_plane_which_faces_the_front_does_not_lie_down(model):
    plane = add_section_plane(model, bpy.context)
    _apply(plane, location=False, rotation=True, scale=False)
    assert abs(plane.matrix_world.col[2].y) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("what", APPLIED[1:])
def test_a_box_keeps_its_three_edges(scaled, what):
    box = add_section_box(scaled, bpy.context)
    box.scale.x *= 3
    bpy.context.view_layer.update()
    before = _cut(_sections()[0], scaled)
    _apply(box, **what)
    np.testing.assert_allclose(_cut(_sections()[0], scaled), before, atol=1e-4)
    assert box.empty_display_size == 1.0


@pytest.mark.parametrize("add", [add_section_plane, add_section_box])
def test_under_a_parent_too(model, add):
    thing = add(model, bpy.context)
    parent = bpy.data.objects.new("parent", None)
    bpy.context.scene.collection.objects.link(parent)
    parent.matrix_world = Matrix.LocRotScale((1, 2, 3), Euler((0.3, 0.2, 0.1)), (2, 2, 2))
    thing.parent, thing.rotation_euler.z = parent, 0.4
    bpy.context.view_layer.update()
    before = _cut(_sections()[0], model)
    _apply(thing, location=True, rotation=True, scale=True)
    np.testing.assert_allclose(_cut(_sections()[0], model), before, atol=1e-3)


def test_another_origin_does_not_move_the_cut(model):
    plane = add_section_plane(model, bpy.context)
    before = _cut(_sections()[0], model)
    bpy.context.scene.cursor.location = (5, 6, 7)
    for other in bpy.context.scene.objects:
        other.select_set(other == plane)
    bpy.context.view_layer.objects.active = plane
    assert bpy.ops.object.origin_set(type="ORIGIN_CURSOR") == {"FINISHED"}
    np.testing.assert_allclose(_cut(_sections()[0], model), before, atol=1e-4)


@pytest.mark.parametrize("add", [add_section_plane, add_section_box])
def test_undo_after_it_leaves_the_cut_there(model, add):
    """Blender's step of Apply has the object as Apply left it, before it was put back."""
    name = add(model, bpy.context).name
    bpy.context.view_layer.update()
    bpy.ops.ed.undo_push(message="before")
    before = _cut(_sections()[0], model)
    thing = bpy.data.objects[name]
    handlers = bpy.app.handlers.depsgraph_update_post
    ours = list(handlers)
    handlers.clear()
    _apply(thing, location=False, rotation=True, scale=True)
    bpy.ops.ed.undo_push(message="apply")
    handlers.extend(ours)
    thing.update_tag()
    bpy.context.view_layer.update()
    np.testing.assert_allclose(_cut(_sections()[0], model), before, atol=1e-4)
    thing.location.x += 4
    bpy.context.view_layer.update()
    bpy.ops.ed.undo_push(message="move")
    bpy.ops.ed.undo()
    bpy.context.view_layer.update()
    np.testing.assert_allclose(_cut(_sections()[0], bpy.context.scene.insideout.model), before, atol=1e-4)


def test_what_the_user_does_to_it_otherwise_stays(model):
    plane, box = add_section_plane(model, bpy.context), add_section_box(model, bpy.context)
    plane.rotation_euler, plane.scale = (0, 0, 0), (2, 2, 2)
    box.scale = (1, 1, 1)
    bpy.context.view_layer.update()
    assert tuple(plane.scale) == (2, 2, 2)
    assert tuple(box.scale) == (1, 1, 1)
    box.empty_display_size = 3.0
    bpy.context.view_layer.update()
    assert (tuple(box.scale), box.empty_display_size) == ((1, 1, 1), 3.0)
    for vertex in plane.data.vertices:
        vertex.co.x += 1
    plane.data.update()
    bpy.context.view_layer.update()
    assert tuple(plane.scale) == (2, 2, 2)


def test_a_plane_that_stands_still_is_not_written_to_again(model):
    plane = add_section_plane(model, bpy.context)
    bpy.context.view_layer.update()
    counted = []
    bpy.app.handlers.depsgraph_update_post.append(lambda *_: counted.append(1))
    plane.location.x += 1
    for _ in range(3):
        bpy.context.view_layer.update()
    assert len(counted) == 1
