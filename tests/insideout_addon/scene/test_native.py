"""Blender 5.3's own splats: what can be tried in a Blender that has none."""

from __future__ import annotations

from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from insideout.insideout_addon.scene import display, exporting, memory, native, showing, splats
from insideout.insideout_addon.scene.node_tree import modifier_input, set_modifier_input
from insideout.insideout_addon.scene.splats import create_splats, read_splats

pytestmark = pytest.mark.builds_groups

FLOAT4 = "FLOAT4" in bpy.types.Attribute.bl_rna.properties["data_type"].enum_items
needs_float4 = pytest.mark.skipif(not FLOAT4, reason="four numbers a point are there since Blender 5.2")


@pytest.fixture
def as_if(monkeypatch):
    """This Blender taken for one that draws splats; the type is set on nothing."""
    for module in (display, memory, showing, splats):
        if hasattr(module, "draws_splats"):
            monkeypatch.setattr(module, "draws_splats", lambda: True)


def _cloud(model):
    depsgraph = bpy.context.evaluated_depsgraph_get()
    depsgraph.update()
    return model.evaluated_get(depsgraph).evaluated_geometry()


def _vectors(cloud, name):
    values = np.empty(3 * len(cloud.points), np.float32)
    cloud.attributes[name].data.foreach_get("vector", values)
    return values.reshape(-1, 3)


def test_it_is_told_by_the_types_of_point_clouds(blender, monkeypatch):
    known = {"POINTS": None, "GAUSSIAN_SPLAT": None}
    kinds = {"type": SimpleNamespace(enum_items=known)}
    rna = SimpleNamespace(PointCloud=SimpleNamespace(bl_rna=SimpleNamespace(properties=kinds)))
    monkeypatch.setattr(native.bpy, "types", rna)
    assert native.draws_splats()
    cloud = SimpleNamespace(type="POINTS")
    native.make_native(cloud)
    assert cloud.type == "GAUSSIAN_SPLAT"
    del known["GAUSSIAN_SPLAT"]
    assert not native.draws_splats()
    kinds.clear()
    assert not native.draws_splats()


def test_a_blender_without_them_is_left_alone(blender, random_set):
    if native.draws_splats():
        pytest.skip("this Blender draws splats")
    model = create_splats(random_set, "model", bpy.context)
    assert model.data.attributes["radiance:base"].data_type == "FLOAT_COLOR"
    assert not hasattr(model.data, "type")


@needs_float4
def test_four_numbers_are_written_as_blender_has_them_and_read(blender, random_set, as_if):
    model = create_splats(random_set, "model", bpy.context)
    assert model.data.attributes["radiance:base"].data_type == "FLOAT4"
    back = read_splats(model)
    np.testing.assert_array_equal(back.opacities, random_set.opacities)
    np.testing.assert_array_equal(back.sh, random_set.sh)


@needs_float4
def test_colours_of_an_older_file_become_four_numbers_when_they_are_rewritten(blender, random_set, monkeypatch):
    model = create_splats(random_set, "model", bpy.context)
    monkeypatch.setattr(splats, "draws_splats", lambda: True)
    splats.rewrite_splats(model, read_splats(model))
    assert model.data.attributes["radiance:base"].data_type == "FLOAT4"
    np.testing.assert_array_equal(read_splats(model).sh, random_set.sh)


@pytest.mark.parametrize("display", ["POINTS", "ELLIPSOIDS"])
def test_colours_of_an_older_file_become_four_numbers_when_it_is_shown_anew(
    blender, random_set, monkeypatch, as_if, display
):
    """Blender's own splats may not be drawn in colours of another type."""
    with monkeypatch.context() as older:
        older.setattr(splats, "draws_splats", lambda: False)
        model = create_splats(random_set, "model", bpy.context)
    if not FLOAT4:
        # Four numbers of this Blender in their place.
        monkeypatch.setattr(splats, "_NATIVE_BASE", ("QUATERNION", "value", 4))
    for _ in range(2):
        showing.show_as(model, display)
        assert model.data.attributes["radiance:base"].data_type == splats._NATIVE_BASE[0]
    back = read_splats(model)
    np.testing.assert_array_equal(back.opacities, random_set.opacities)
    np.testing.assert_array_equal(back.sh, random_set.sh)


@needs_float4
def test_colours_can_stand_for_something_else_and_come_back(blender, random_set, as_if):
    model = create_splats(random_set, "model", bpy.context)
    before = splats.read_values(model, splats.DISPLAY_COLOR)
    splats.show_colors(model, np.zeros((200, 3)), "black")
    shown = splats.read_values(model, splats.DISPLAY_COLOR)
    assert shown[:, :3].max() == 0
    np.testing.assert_array_equal(shown[:, 3], random_set.opacities)
    splats.show_colors(model, None)
    np.testing.assert_array_equal(splats.read_values(model, splats.DISPLAY_COLOR), before)


@needs_float4
def test_faint_splats_of_four_numbers_are_hidden_as_ever(blender, random_set, as_if):
    model = create_splats(random_set, "model", bpy.context)
    modifier = showing.show_as(model, "POINTS")
    set_modifier_input(modifier, "Minimum Opacity", 0.6)
    shown = _cloud(model)
    assert len(shown.pointcloud.points) == np.count_nonzero(random_set.opacities >= 0.6)


class TestDisplay:
    @pytest.fixture(autouse=True)
    def colours(self, as_if, monkeypatch):
        if not FLOAT4:
            monkeypatch.setattr(splats, "draws_splats", lambda: False)

    def test_without_cuts_all_splats_are_blenders_own_as_they_are(self, blender, random_set):
        model = create_splats(random_set, "model", bpy.context)
        modifier = showing.show_as(model, "AUTOMATIC")
        set_modifier_input(modifier, "Minimum Opacity", 0.0)
        shown = _cloud(model)
        assert showing.shown_as(model) == "MIXED"
        assert shown.instances_pointcloud() is None
        np.testing.assert_allclose(_vectors(shown.pointcloud, "scale"), random_set.scales, rtol=1e-5)
        assert not [material for material in shown.pointcloud.materials if material]

    def test_at_cuts_they_are_closed_ellipsoids(self, blender, random_set):
        model = create_splats(random_set, "model", bpy.context)
        plane = model.data.attributes.new("cut_normal_0", "FLOAT_VECTOR", "POINT")
        plane.data.foreach_set("vector", np.tile(np.float32([0, 0, 1]), 200))
        height = model.data.attributes.new("cut_height_0", "FLOAT", "POINT")
        height.data.foreach_set("value", np.ascontiguousarray(-random_set.means[:, 2], np.float32))
        modifier = showing.show_as(model, "AUTOMATIC")
        for name, value in {"Cut": True, "Minimum Opacity": 0.0, "Soft": False}.items():
            set_modifier_input(modifier, name, value)
        shown = _cloud(model)
        reach = modifier_input(modifier, "Size") * np.sqrt(random_set.covariances()[:, 2, 2])
        crossing = np.abs(random_set.means[:, 2]) < reach
        assert len(shown.instances_pointcloud().points) == crossing.sum()
        assert len(shown.pointcloud.points) == (random_set.means[:, 2] < -reach).sum()

    def test_what_is_visible_goes_out_with_its_own_axes(self, blender, one_ball):
        model = create_splats(one_ball, "model", bpy.context)
        model.data.attributes.new("cut_normal_0", "FLOAT_VECTOR", "POINT").data[0].vector = (0, 0, 1)
        model.data.attributes.new("cut_height_0", "FLOAT", "POINT").data[0].value = 2.0
        set_modifier_input(showing.show_as(model, "POINTS"), "Cut", True)
        found = exporting.edited_splats(model, bpy.context, visible_only=True)
        np.testing.assert_allclose(found.scales, one_ball.scales, rtol=1e-6)

    def test_those_that_stay_points_at_a_cut_shrink(self, blender, one_ball):
        model = create_splats(one_ball, "model", bpy.context)
        model.data.attributes.new("cut_normal_0", "FLOAT_VECTOR", "POINT").data[0].vector = (0, 0, 1)
        model.data.attributes.new("cut_height_0", "FLOAT", "POINT").data[0].value = 2.0
        modifier = showing.show_as(model, "POINTS")
        set_modifier_input(modifier, "Cut", True)
        shown = _cloud(model)
        # Size times the standard deviation, 1.6 · 5 mm, becomes the 2 mm to the plane.
        np.testing.assert_allclose(_vectors(shown.pointcloud, "scale"), [[1.25] * 3], rtol=1e-5)
