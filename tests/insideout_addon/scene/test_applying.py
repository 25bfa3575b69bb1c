"""The object's transform made one of its splats."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from insideout.core.steps import run_through
from insideout.insideout_addon.scene import showing
from insideout.insideout_addon.scene.cut_slots import HEIGHTS, NORMALS
from insideout.insideout_addon.scene.exporting import edited_splats
from insideout.insideout_addon.scene.node_tree import modifier_input, set_modifier_input
from insideout.insideout_addon.scene.placement import (
    SharedSplatsError,
    applied_to_splats,
    apply_in_steps,
    apply_transform,
    is_scaled,
)
from insideout.insideout_addon.scene.splats import read_splats


def _assert_same(found, expected, rtol=1e-6, atol=1e-6):
    for name in ("means", "quats", "scales", "opacities", "sh", "density", "modality"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=rtol, atol=atol, err_msg=name)


def test_nothing_moves(load):
    bpy.context.scene.unit_settings.scale_length = 0.01
    model, _ = load()
    placed = model.matrix_world.copy()
    model.location, model.rotation_euler, model.scale = (1, 2, 3), (0.1, 0.2, 0.3), (0.1, 0.2, -0.1)
    bpy.context.view_layer.update()
    before = edited_splats(model, bpy.context)
    apply_transform(model)
    bpy.context.view_layer.update()
    np.testing.assert_allclose(model.matrix_world, placed, atol=1e-6)
    _assert_same(read_splats(model), before, rtol=0, atol=0)
    _assert_same(edited_splats(model, bpy.context), before)


def test_nothing_moves_under_a_parent_that_is_turned_and_stretched(load):
    model, _ = load()
    parent, mark = (bpy.data.objects.new(name, None) for name in ("parent", "Mark"))
    for thing in (parent, mark):
        bpy.context.collection.objects.link(thing)
    parent.location, parent.rotation_euler, parent.scale = (5, 0, 1), (0.2, 0, 0.5), (2, 1, 1)
    model.parent, model.matrix_parent_inverse = parent, Matrix.Translation((1, 2, 3))
    mark.parent, mark.location = model, (1, 2, 3)
    model.rotation_euler.x = 0.3
    bpy.context.view_layer.update()
    before, place = edited_splats(model, bpy.context), mark.matrix_world.copy()
    apply_transform(model)
    bpy.context.view_layer.update()
    _assert_same(edited_splats(model, bpy.context), before, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(mark.matrix_world, place, atol=1e-5)
    assert not is_scaled(model)


@pytest.mark.parametrize("change", ["joined", "moved", "edited"])
def test_what_another_window_changes_meanwhile_is_not_overwritten(load, change):
    model, _ = load()
    twin = model.copy()
    twin.data = model.data.copy()
    bpy.context.collection.objects.link(twin)
    model.location.x = 2
    bpy.context.view_layer.update()
    steps = apply_in_steps(model)
    next(steps)
    if change == "joined":
        with bpy.context.temp_override(active_object=model, object=model, selected_editable_objects=[model, twin]):
            bpy.ops.object.join()
    elif change == "moved":
        model.location.x = 9
    else:
        model.data.attributes["density"].data[0].value = 0.5
        model.data.update_tag()
    bpy.context.view_layer.update()
    count, place = len(model.data.points), model.location.x
    with pytest.raises(ReferenceError):
        run_through(steps)
    assert (len(model.data.points), model.location.x) == (count, place)


def test_that_it_is_shown_otherwise_meanwhile_does_not_matter(load):
    model, _ = load()
    model.location.x = 2
    bpy.context.view_layer.update()
    steps = apply_in_steps(model)
    next(steps)
    showing.show_as(model, "POINTS")
    model.data.update_tag()
    bpy.context.view_layer.update()
    run_through(steps)
    assert model.location.x == 0


def test_what_follows_the_model_stays(load):
    model, _ = load()
    mark = bpy.data.objects.new("Mark", None)
    bpy.context.collection.objects.link(mark)
    mark.parent, mark.location = model, (1, 2, 3)
    model.location, model.rotation_euler, model.scale = (1, 2, 3), (0.1, 0.2, 0.3), (1.0, 2.0, 3.0)
    bpy.context.view_layer.update()
    before = mark.matrix_world.copy()
    apply_transform(model)
    bpy.context.view_layer.update()
    np.testing.assert_allclose(mark.matrix_world, before, atol=1e-5)


def test_the_same_splats_stay_ellipsoids(load):
    model, _ = load()
    modifier = showing.show_as(model, "MIXED")
    set_modifier_input(modifier, "Large From", 1.0)
    set_modifier_input(modifier, "Near Cuts", 2.0)
    model.scale = (0.5, 1.0, -0.25)
    bpy.context.view_layer.update()
    apply_transform(model)
    assert modifier_input(modifier, "Large From") == pytest.approx(0.5)
    assert modifier_input(modifier, "Near Cuts") == pytest.approx(1.0)


def test_twice_is_one_after_the_other(load):
    model, original = load()
    for _ in range(2):
        model.location, model.rotation_euler, model.scale = (1, 2, 3), (0.1, 0.2, 0.3), (1.0, 2.0, -1.0)
        bpy.context.view_layer.update()
        apply_transform(model)
    found = applied_to_splats(model).apply(original.means)
    np.testing.assert_allclose(found, read_splats(model).means, atol=1e-3)


def test_not_for_one_of_two_that_share_their_splats(load):
    model, original = load()
    twin = model.copy()
    bpy.context.collection.objects.link(twin)
    with pytest.raises(SharedSplatsError, match="2 objects share"):
        apply_transform(twin)
    _assert_same(read_splats(model), original, rtol=0, atol=0)


def test_a_fake_user_is_no_other_object(load):
    model, original = load()
    model.data.use_fake_user = True
    model.location.x = 5.0
    bpy.context.view_layer.update()
    apply_transform(model)
    np.testing.assert_allclose(read_splats(model).means, original.means + np.float32([5.0, 0, 0]), atol=1e-4)


def _cut_by(model, normals, heights):
    attributes = model.data.attributes
    attributes.new(NORMALS[0], "FLOAT_VECTOR", "POINT").data.foreach_set("vector", normals.astype(np.float32).ravel())
    attributes.new(HEIGHTS[0], "FLOAT", "POINT").data.foreach_set("value", heights.astype(np.float32))


def _cuts(model):
    count = len(model.data.points)
    normals, heights = np.empty((count, 3), np.float32), np.empty(count, np.float32)
    model.data.attributes[NORMALS[0]].data.foreach_get("vector", normals.ravel())
    model.data.attributes[HEIGHTS[0]].data.foreach_get("value", heights)
    return normals, heights


@pytest.mark.parametrize("size", [(1, 1, 1), (1, 2, 0.5), (-1, 1, 3)])
def test_the_faces_at_which_a_piece_is_broken_go_with_its_splats(load, size):
    model, _ = load()
    rng = np.random.default_rng(1)
    count = len(model.data.points)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[:5] = 0
    heights = np.where(normals.any(axis=1), rng.uniform(-1, 2, count), 0)
    _cut_by(model, normals, heights)
    # On each plane the place that is nearest to the splat's centre, and one beside it.
    beside = np.cross(normals, rng.normal(size=(count, 3)))
    on_plane = [read_splats(model).means + heights[:, None] * normals + way * beside for way in (0, 1)]
    placed = np.array(model.matrix_world)
    model.rotation_euler, model.location, model.scale = (0.5, 1.0, 0.2), (3, 0, 1), size
    bpy.context.view_layer.update()
    moved = np.linalg.inv(placed) @ np.array(model.matrix_world)
    apply_transform(model)
    after, heights_after = _cuts(model)
    cut = normals.any(axis=1)
    np.testing.assert_allclose(np.linalg.norm(after, axis=1), cut, atol=1e-5)
    np.testing.assert_allclose(heights_after[~cut], 0)
    for places in on_plane:
        away = places @ moved[:3, :3].T + moved[:3, 3] - read_splats(model).means
        np.testing.assert_allclose((away * after).sum(axis=1), heights_after, atol=1e-3)
    inwards = np.einsum("ni,ni->n", (after @ moved[:3, :3])[cut], normals[cut])
    assert (inwards > 0).all(), "the same side is hidden"
