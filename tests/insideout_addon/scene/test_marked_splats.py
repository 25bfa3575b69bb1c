"""Where the frame of a model's file is after Blender's own Apply, which moves the points and tells nobody."""

from __future__ import annotations

from dataclasses import replace

import bpy
import numpy as np
import pytest

from insideout.core.errors import SettingError
from insideout.core.gaussians import Modality
from insideout.insideout_addon.scene import section, section_picture, sections
from insideout.insideout_addon.scene.node_tree import TreeBuilder
from insideout.insideout_addon.scene.placement import (
    applied_to_splats,
    apply_transform,
    remember_placement,
    splats_are_left_behind,
)
from insideout.insideout_addon.scene.splats import create_splats, read_splats


@pytest.fixture
def model(blender, random_set):
    splats = create_splats(random_set, "model", bpy.context)
    remember_placement(splats)
    return splats


def _apply(model, **transform):
    """What Object > Apply > All Transforms does."""
    for name, value in transform.items():
        setattr(model, name, value)
    bpy.context.view_layer.objects.active = model
    model.select_set(True)
    bpy.context.view_layer.update()
    assert bpy.ops.object.transform_apply() == {"FINISHED"}
    bpy.context.view_layer.update()


def _edit(model, change):
    places = read_splats(model).means
    model.data.attributes["position"].data.foreach_set("vector", change(places).astype(np.float32).ravel())


ALL = {"location": (100, 2, -3), "rotation_euler": (0.1, 0.7, 2.0), "scale": (2.0, 2.0, -0.5)}


@pytest.mark.parametrize("part", [*ALL, "all"])
def test_it_is_known_what_blender_applied(model, random_set, part):
    _apply(model, **(ALL if part == "all" else {part: ALL[part]}))
    np.testing.assert_allclose(applied_to_splats(model).apply(random_set.means), read_splats(model).means, atol=1e-3)


def test_also_between_two_transforms_to_splats(model, random_set):
    for apply in (lambda _: None, lambda moved: _apply(moved), lambda _: None):
        model.location = (100, 0, 0)
        bpy.context.view_layer.update()
        apply(model)
        model.rotation_euler = (0.0, 0.0, 0.5)
        bpy.context.view_layer.update()
        apply_transform(model)
    np.testing.assert_allclose(applied_to_splats(model).apply(random_set.means), read_splats(model).means, atol=1e-3)


@pytest.mark.parametrize("applied", [False, True])
def test_splats_that_were_moved_by_themselves_move_no_frame(model, random_set, applied):
    own = np.arange(len(random_set)) % 4 == 0
    _edit(model, lambda places: places + 5.0 * own[:, None])
    if applied:
        _apply(model, **ALL)
    found = applied_to_splats(model).apply(random_set.means)
    np.testing.assert_allclose(found[~own], read_splats(model).means[~own], atol=1e-3)


@pytest.mark.parametrize("scale", [0.001, 0.0005])
def test_also_in_metres_away_from_the_origin(model, random_set, scale):
    _apply(model, location=(1, 2, 0.5), scale=(scale,) * 3)
    found = applied_to_splats(model).apply(random_set.means)
    np.testing.assert_allclose(found, read_splats(model).means, atol=1e-3 * scale * np.ptp(random_set.means))
    assert splats_are_left_behind(model)


@pytest.mark.parametrize(
    "transform",
    [
        {"scale": (1.1,) * 3},
        {"scale": (1.0, 1.0, 2.0)},
        {**ALL, "scale": (-1.02,) * 3},
        {"rotation_euler": (0, 0, 0.01)},
        {"rotation_euler": (0, np.pi / 2, 0), "location": (1e4, 0, 0)},
        {"scale": (1.0, 1.0, -1.0)},
    ],
)
def test_splats_whose_points_blender_has_turned_or_scaled_are_transformed_no_more(model, random_set, transform):
    """Nobody knows any more that their shapes and densities are of before."""
    _apply(model, **transform)
    assert splats_are_left_behind(model)
    with pytest.raises(SettingError, match="Blender's own Apply has turned or scaled the points of model"):
        apply_transform(model)
    for name in ("scales", "quats"):
        np.testing.assert_array_equal(getattr(read_splats(model), name), getattr(random_set, name))


@pytest.mark.parametrize("kind", [Modality.XRAY, Modality.RGB])
def test_in_metres_neither_are_they_where_nobody_has_scaled_anything(blender, random_set, kind):
    of_a_kind = replace(random_set, modality=np.full(len(random_set), kind, np.uint8), density=0 * random_set.density)
    model = create_splats(of_a_kind, "model", bpy.context)
    model.scale = (0.001,) * 3
    remember_placement(model)
    _apply(model)
    with pytest.raises(SettingError, match="Blender's own Apply"):
        apply_transform(model)


@pytest.mark.parametrize("location", [(0, 0, 0), (1e4, 0, 0)])
def test_what_was_but_moved_can_be_transformed_after_blenders_own_apply(model, random_set, location):
    _apply(model, location=location)
    model.scale = (2.0,) * 3
    bpy.context.view_layer.update()
    apply_transform(model)
    assert not splats_are_left_behind(model)
    np.testing.assert_allclose(read_splats(model).scales, 2.0 * random_set.scales, rtol=1e-5)


def test_of_a_flat_model_rounding_is_no_turn_or_scale(blender, random_set):
    means = random_set.means * [1, 1, 1e-4]
    model = create_splats(replace(random_set, means=means.astype(np.float32)), "model", bpy.context)
    remember_placement(model)
    _apply(model, location=(0, 0, 1e4))
    assert not splats_are_left_behind(model)


def test_splats_without_a_place_hide_nothing_of_the_others(model, random_set):
    """The panels ask whenever they are drawn."""
    _apply(model, **ALL)
    own = np.arange(len(random_set)) % 4 == 0
    _edit(model, lambda places: np.where(own[:, None], np.nan, places))
    found = applied_to_splats(model).apply(random_set.means)
    np.testing.assert_allclose(found[~own], read_splats(model).means[~own], atol=1e-3)
    assert splats_are_left_behind(model)


def test_deleted_splats_are_not_needed(model, random_set):
    keep = np.arange(len(random_set)) % 3 > 0
    group = bpy.data.node_groups.new("Thin", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        group.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    b = TreeBuilder(group)
    points = b.add("NodeGroupInput").outputs[0]
    third = b.math("MODULO", b.add("GeometryNodeInputIndex").outputs[0], 3.0)
    b.add("NodeGroupOutput", {0: b.deleted(points, b.compare("LESS_THAN", third, 0.5))})
    model.modifiers.new("Thin", "NODES").node_group = group
    bpy.context.view_layer.objects.active = model
    bpy.ops.object.modifier_apply(modifier="Thin")
    assert len(model.data.points) == keep.sum()

    _apply(model, **ALL)
    found = applied_to_splats(model).apply(random_set.means[keep])
    np.testing.assert_allclose(found, read_splats(model).means, atol=1e-3)


def test_of_a_file_from_before_splats_were_marked_what_was_noted_counts(blender, random_set):
    model = create_splats(random_set, "model", bpy.context)
    _apply(model, location=(100, 0, 0))
    np.testing.assert_array_equal(applied_to_splats(model).translation, [0, 0, 0])


def test_the_ct_is_where_the_model_was_moved_to(scanned):
    remember_placement(scanned)
    plane = sections.add_section_plane(scanned, bpy.context)
    _, view = section.sample_section(bpy.context.scene)
    before = section_picture.scan_on(view, scanned)
    plane.location.x += 100
    _apply(scanned, location=(100, 0, 0))
    _, view = section.sample_section(bpy.context.scene)
    np.testing.assert_allclose(section_picture.scan_on(view, scanned), before, atol=1e-4)
    assert before.max() > 0.01


def _follow(model, parent):
    model.constraints.new("COPY_LOCATION").target = parent


def _keyframe(model, parent):
    model.keyframe_insert("location", frame=1)
    model.location.x += 10
    model.keyframe_insert("location", frame=20)


def _strip(model, parent):
    model.keyframe_insert("delta_scale", frame=1)
    animation = model.animation_data
    animation.nla_tracks.new().strips.new("Strip", 1, animation.action)
    animation.action = None


def _drive(model, parent):
    model.driver_add("rotation_euler", 2).driver.expression = "1"


def _not_at_all(model, parent):
    model.constraints.new("COPY_LOCATION").mute = True
    model.constraints.new("COPY_LOCATION").influence = 0
    _strip(model, parent)
    model.animation_data.nla_tracks[0].mute = True
    _strip(model, parent)
    model.animation_data.nla_tracks[1].strips[0].mute = True
    model.keyframe_insert("hide_render", frame=1)
    model.parent = parent
    parent.keyframe_insert("location", frame=1)


@pytest.mark.parametrize("move", [_follow, _keyframe, _strip, _drive])
def test_what_moves_by_itself_is_not_transformed(model, random_set, move):
    """Its splats would be moved once, and with the next frame the object again."""
    move(model, bpy.data.objects.new("Parent", None))
    bpy.context.view_layer.update()
    with pytest.raises(SettingError, match="model is moved by constraints, keyframes or drivers"):
        apply_transform(model)
    np.testing.assert_array_equal(read_splats(model).means, random_set.means)


def test_what_only_its_parent_moves_is_transformed(model, random_set):
    parent = bpy.data.objects.new("Parent", None)
    bpy.context.scene.collection.objects.link(parent)
    _not_at_all(model, parent)
    model.location = (5, 0, 0)
    bpy.context.view_layer.update()
    apply_transform(model)
    np.testing.assert_allclose(read_splats(model).means, random_set.means + np.array([5, 0, 0]), atol=1e-4)
