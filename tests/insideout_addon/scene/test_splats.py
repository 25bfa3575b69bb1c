"""Splats as point clouds: names, types and values of the attributes."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from insideout.core.srgb import srgb_to_linear
from insideout.insideout_addon.scene import memory
from insideout.insideout_addon.scene.display import show_splats
from insideout.insideout_addon.scene.memory import AUTOMATIC_ELLIPSOIDS, chosen_display, import_cost
from insideout.insideout_addon.scene.splats import create_splats, is_splats, read_splats


def _values(splats, name, field, width):
    data = splats.data.attributes[name].data
    values = np.empty(len(data) * width, np.float32)
    data.foreach_get(field, values)
    return values.reshape(-1, width)


def test_attributes_are_those_of_native_splats(blender, random_set):
    splats = create_splats(random_set, "model", bpy.context)
    kinds = {a.name: (a.data_type, a.domain) for a in splats.data.attributes}
    assert splats.type == "POINTCLOUD"
    assert len(splats.data.points) == 200
    assert kinds["position"] == ("FLOAT_VECTOR", "POINT")
    assert kinds["scale"] == ("FLOAT_VECTOR", "POINT")
    assert kinds["rotation"] == ("QUATERNION", "POINT")
    assert kinds["radiance:base"] == ("FLOAT_COLOR", "POINT")
    assert [f"radiance:sh_{k}" in kinds for k in range(4)] == [True, True, True, False]


def test_values_arrive(blender, random_set):
    splats = create_splats(random_set, "model", bpy.context)
    base = _values(splats, "radiance:base", "color", 4)
    np.testing.assert_allclose(base[:, :3], random_set.sh[:, 0], rtol=1e-6)
    np.testing.assert_allclose(base[:, 3], random_set.opacities, rtol=1e-6)
    np.testing.assert_allclose(_values(splats, "rotation", "value", 4), random_set.quats, rtol=1e-6)
    np.testing.assert_allclose(_values(splats, "radiance:sh_2", "vector", 3), random_set.sh[:, 3], rtol=1e-6)
    np.testing.assert_allclose(_values(splats, "density", "value", 1)[:, 0], random_set.density, rtol=1e-6)


def test_what_is_written_is_read_back(blender, random_set):
    back = read_splats(create_splats(random_set, "model", bpy.context))
    for field in ("means", "quats", "scales", "opacities", "sh", "density", "modality"):
        np.testing.assert_allclose(getattr(back, field), getattr(random_set, field), rtol=1e-6, err_msg=field)


def test_view_dependent_colour_can_be_left_out(blender, random_set):
    splats = create_splats(random_set, "model", bpy.context, view_dependent=False)
    assert "radiance:sh_0" not in splats.data.attributes
    assert read_splats(splats).sh.shape == (200, 1, 3)


def test_display_colour_is_scene_linear(blender, random_set):
    shown = _values(create_splats(random_set, "model", bpy.context), "display_color", "color", 4)
    rgb = np.clip(0.5 + 0.28209479 * random_set.sh[:, 0], 0, 1)
    np.testing.assert_allclose(shown[:, :3], srgb_to_linear(rgb), atol=1e-5)
    assert srgb_to_linear(np.array([0.5])) == pytest.approx(0.2140, abs=1e-4)


def test_blender_knows_how_large_it_is(blender, random_set):
    """Framing and culling in the viewport go by the bounding box."""
    splats = create_splats(random_set, "model", bpy.context)
    bpy.context.view_layer.update()
    corners = np.array(splats.bound_box)
    np.testing.assert_allclose(corners.min(axis=0), random_set.means.min(axis=0), atol=random_set.scales.max())
    np.testing.assert_allclose(corners.max(axis=0), random_set.means.max(axis=0), atol=random_set.scales.max())


def test_nothing_else_is_left_in_the_file(blender, random_set):
    create_splats(random_set, "model", bpy.context)
    assert len(bpy.data.meshes) == 0
    assert len(bpy.data.pointclouds) == 1
    assert [o.name for o in bpy.data.objects] == ["model"]


def test_where_the_active_collection_takes_none_they_come_into_the_scene_s_own(linked_collection, random_set):
    model = create_splats(random_set, "model", bpy.context)
    assert list(bpy.context.scene.collection.objects) == [model]


def test_where_no_collection_takes_them_nothing_is_left(linked_collection, random_set, monkeypatch):
    monkeypatch.setattr("insideout.insideout_addon.scene.splats.open_collection", lambda context: linked_collection)
    with pytest.raises(RuntimeError, match="Linked"):
        create_splats(random_set, "model", bpy.context)
    assert [len(kind) for kind in (bpy.data.objects, bpy.data.meshes, bpy.data.pointclouds)] == [0, 0, 0]


def test_other_objects_are_no_splats(blender):
    bpy.ops.object.empty_add()
    assert not is_splats(bpy.context.object)
    assert not is_splats(None)


def test_memory_is_told_from_the_header(tmp_path, random_set):
    random_set.save(tmp_path / "a.ply")
    points = import_cost(tmp_path / "a.ply", "POINTS")
    ellipsoids = import_cost(tmp_path / "a.ply", "ELLIPSOIDS")
    plain = import_cost(tmp_path / "a.ply", "POINTS", view_dependent=False)
    assert points.splats == 200
    assert ellipsoids.scene_bytes > points.scene_bytes
    assert ellipsoids.cycles_bytes > 10 * points.cycles_bytes
    assert points.scene_bytes - plain.scene_bytes == 200 * 3 * 12


def test_of_mixed_models_only_the_ellipsoids_take_much(tmp_path, random_set, monkeypatch):
    monkeypatch.setattr(memory, "MOST_ELLIPSOIDS", 50)
    random_set.save(tmp_path / "a.ply")
    points, mixed, ellipsoids = (import_cost(tmp_path / "a.ply", name) for name in ("POINTS", "MIXED", "ELLIPSOIDS"))
    assert [cost.ellipsoids for cost in (points, mixed, ellipsoids)] == [0, 50, 200]
    for name in ("scene_bytes", "cycles_bytes"):
        low, between, high = (getattr(cost, name) for cost in (points, mixed, ellipsoids))
        assert between == pytest.approx(low + (high - low) / 4)


def test_estimated_memory_is_what_attributes_take_and_what_is_shown_of_them(blender, random_set, tmp_path):
    random_set.save(tmp_path / "a.ply")
    splats = create_splats(random_set, "model", bpy.context)
    sizes = {"FLOAT": 4, "INT8": 1, "FLOAT_VECTOR": 12, "FLOAT_COLOR": 16, "QUATERNION": 16}
    show_splats(splats, ellipsoids=False)
    shown = splats.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    taken = [
        sum(sizes[a.data_type] * len(splats.data.points) for a in data.attributes if a.data_type in sizes)
        for data in (splats.data, shown)
    ]
    assert len(shown.points) > 0
    assert taken[1] == taken[0] - 200 * 3 * 12, "the view-dependent colours"
    assert import_cost(tmp_path / "a.ply", "POINTS").scene_bytes == sum(taken)


def test_of_large_models_only_what_matters_is_ellipsoids():
    assert chosen_display("AUTOMATIC", AUTOMATIC_ELLIPSOIDS) == "ELLIPSOIDS"
    assert chosen_display("AUTOMATIC", AUTOMATIC_ELLIPSOIDS + 1) == "MIXED"
    assert chosen_display("ELLIPSOIDS", 10**7) == "ELLIPSOIDS"
