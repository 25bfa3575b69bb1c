"""Models that were edited in Blender, back out as .ply."""

from __future__ import annotations

import math

import bpy
import numpy as np
import pytest
from mathutils import Euler, Matrix

from insideout.core.affine import Affine, Kept, affine_transformed
from insideout.core.errors import SettingError
from insideout.core.gaussians import GaussianSet
from insideout.core.ply import read_comments
from insideout.insideout_addon.scene.display import display_modifier
from insideout.insideout_addon.scene.exporting import (
    edited_splats,
    export_splats,
    is_edited_by_modifiers,
    model_to_export,
)
from insideout.insideout_addon.scene.importing import import_splats
from insideout.insideout_addon.scene.node_tree import modifier_input
from insideout.insideout_addon.scene.placement import apply_transform
from insideout.insideout_addon.scene.section_cut import cut_modifiers
from insideout.insideout_addon.scene.splats import DamagedSplatsError, create_splats

FIELDS = ("means", "quats", "scales", "opacities", "sh", "density", "modality")


def _assert_same(found, expected, rtol=1e-6, atol=1e-6):
    for name in FIELDS:
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=rtol, atol=atol, err_msg=name)


def _edit(model, **changes):
    for name, value in changes.items():
        setattr(model, name, value)
    return edited_splats(model, bpy.context)


def _keep_negative_x():
    """A node group that deletes points at x > 0."""
    group = bpy.data.node_groups.new("Crop", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        group.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    given, left = group.nodes.new("NodeGroupInput"), group.nodes.new("NodeGroupOutput")
    delete, above = group.nodes.new("GeometryNodeDeleteGeometry"), group.nodes.new("FunctionNodeCompare")
    place, axes = group.nodes.new("GeometryNodeInputPosition"), group.nodes.new("ShaderNodeSeparateXYZ")
    above.operation = "GREATER_THAN"
    above.inputs[1].default_value = 0.0
    for source, target in (
        (place.outputs[0], axes.inputs[0]),
        (axes.outputs[0], above.inputs[0]),
        (given.outputs[0], delete.inputs["Geometry"]),
        (above.outputs[0], delete.inputs["Selection"]),
        (delete.outputs[0], left.inputs[0]),
    ):
        group.links.new(source, target)
    return group


def _choose(*models):
    """Selects point clouds, the last one active."""
    for thing in bpy.context.view_layer.objects:
        thing.select_set(thing in models)
    bpy.context.view_layer.objects.active = models[-1]


def _duplicate(model):
    twin = model.copy()
    twin.data = model.data.copy()
    bpy.context.collection.objects.link(twin)
    bpy.context.view_layer.update()
    return twin


class TestUntouched:
    """What nobody has edited comes out as it came in."""

    def test_every_field_is_the_files(self, load, tmp_path):
        model, original = load()
        for name in FIELDS:
            found = getattr(edited_splats(model, bpy.context), name)
            np.testing.assert_array_equal(found, getattr(original, name), err_msg=name)
        export = export_splats(model, tmp_path / "out.ply", bpy.context)
        assert (export.splats, export.warnings) == (200, ())
        _assert_same(GaussianSet.load(tmp_path / "out.ply"), original)

    @pytest.mark.parametrize(("system", "scale_length"), [("METRIC", 0.01), ("IMPERIAL", 1.0), ("NONE", 1.0)])
    def test_whatever_the_units_of_the_scene(self, load, system, scale_length):
        units = bpy.context.scene.unit_settings
        units.system, units.scale_length = system, scale_length
        model, original = load()
        _assert_same(edited_splats(model, bpy.context), original)
        units.scale_length = 3.0
        _assert_same(edited_splats(model, bpy.context), original)

    def test_a_model_of_photos_that_was_turned_upright(self, blender, photo_run):
        (photo_run / "initialize").mkdir()
        camera = '{"camera": {"world_to_camera": [[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 5]]}}'
        (photo_run / "initialize" / "photos.json").write_text(f'{{"photos": [{camera}]}}', "utf-8")
        model = import_splats(photo_run / "fused.ply", "model", bpy.context)
        assert abs(model.rotation_euler.x) + abs(model.rotation_euler.y) > 1
        _assert_same(edited_splats(model, bpy.context), GaussianSet.load(photo_run / "fused.ply"))

    def test_colours_that_were_not_imported_are_told(self, load, tmp_path):
        model, original = load(view_dependent=False)
        export = export_splats(model, tmp_path / "out.ply", bpy.context)
        assert "SH degree 1) were not imported" in export.warnings[0]
        back = GaussianSet.load(tmp_path / "out.ply")
        assert back.sh_degree == 0
        _assert_same(back, original.with_sh_coefficients(1))


@pytest.mark.parametrize(
    ("transform", "told"),
    [({"scale": (1.1,) * 3}, 1), ({"rotation_euler": (0, 0, 1)}, 1), ({"location": (5, 0, -2)}, 0), ({}, 0)],
)
def test_of_splats_that_blenders_own_apply_left_behind_it_is_told(load, tmp_path, transform, told):
    """Who imports the file cannot know it any more."""
    model, _ = load()
    _choose(model)
    for name, value in transform.items():
        setattr(model, name, value)
    bpy.ops.object.transform_apply()
    warnings = export_splats(model, tmp_path / "out.ply", bpy.context).warnings
    assert len(warnings) == told
    assert all("turned or scaled the points of model, but not the splats" in warning for warning in warnings)


class TestMovedAsAnObject:
    """Location, rotation and scale since the import, in mm of the model."""

    def test_moved_and_turned(self, load):
        model, original = load()
        turn = Euler((0.3, -0.2, 1.1))
        found = _edit(model, location=(5, 0, -2), rotation_euler=turn)
        affine = Affine(np.array(turn.to_matrix(), np.float64), np.array([5.0, 0, -2]))
        _assert_same(found, affine_transformed(original, affine), rtol=1e-4, atol=2e-5)

    def test_moved_in_a_scene_in_centimetres(self, load):
        bpy.context.scene.unit_settings.scale_length = 0.01
        model, original = load()
        assert model.scale.x == pytest.approx(0.1)
        found = _edit(model, location=(5, 0, 0))
        np.testing.assert_allclose(found.means, original.means + np.array([50, 0, 0]), atol=1e-4)
        np.testing.assert_array_equal(found.scales, original.scales)

    def test_scaled_unevenly_it_is_of_the_same_material(self, load):
        model, original = load()
        model.scale.x *= 8
        found = edited_splats(model, bpy.context)
        stretch = np.diag([8.0, 1, 1])
        np.testing.assert_allclose(
            found.covariances(), stretch @ original.covariances() @ stretch, rtol=1e-3, atol=1e-4
        )
        np.testing.assert_array_equal(found.density, original.density)
        kept = edited_splats(model, bpy.context, kept=Kept.LINE_INTEGRALS)
        np.testing.assert_allclose(kept.density, original.density / 2, rtol=1e-6)

    def test_sheared_by_a_parent(self, load):
        model, original = load()
        parent = bpy.data.objects.new("parent", None)
        bpy.context.collection.objects.link(parent)
        parent.scale = (2, 1, 1)
        model.parent = parent
        model.rotation_euler.z = math.radians(30)
        found = edited_splats(model, bpy.context)
        linear = np.diag([2.0, 1, 1]) @ np.array(Matrix.Rotation(math.radians(30), 3, "Z"))
        expected = affine_transformed(original, Affine(linear, np.zeros(3)), Kept.MATERIAL)
        _assert_same(found, expected, rtol=1e-4, atol=2e-5)

    def test_while_it_was_hidden(self, load):
        model, original = load()
        model.hide_viewport, model.location = True, (5, 0, 0)
        found = edited_splats(model, bpy.context)
        np.testing.assert_allclose(found.means, original.means + np.float32([5, 0, 0]), atol=1e-5)

    def test_scaled_to_nothing(self, load):
        model, _ = load()
        with pytest.raises(SettingError, match="squeezes it flat"):
            _edit(model, scale=(1, 0, 1))


class TestDeleted:
    """Points that were deleted are not in the file, and the others keep all they have."""

    def test_in_edit_mode(self, load):
        model, original = load()
        _choose(model)
        try:
            bpy.ops.object.mode_set(mode="EDIT")
        except (RuntimeError, TypeError):
            pytest.skip("this Blender has no edit mode of point clouds")
        bpy.ops.pointcloud.select_all(action="DESELECT")
        bpy.ops.pointcloud.select_random(probability=0.3)
        bpy.ops.pointcloud.delete()
        bpy.ops.object.mode_set(mode="OBJECT")
        found = edited_splats(model, bpy.context)
        assert 100 < len(found) < 190
        kept = np.isin(original.means[:, 0], found.means[:, 0])
        _assert_same(found, original.select(kept), rtol=0, atol=0)

    @pytest.mark.parametrize("applied", [False, True])
    def test_by_geometry_nodes(self, load, applied):
        model, original = load()
        model.modifiers.new("Crop", "NODES").node_group = _keep_negative_x()
        _choose(model)
        bpy.ops.object.modifier_move_to_index(modifier="Crop", index=0)
        if applied:
            bpy.ops.object.modifier_apply(modifier="Crop")
            assert [modifier.name for modifier in model.modifiers] == ["InsideOut Splats"]
        _assert_same(edited_splats(model, bpy.context), original.select(original.means[:, 0] <= 0), rtol=0, atol=0)

    def test_by_geometry_nodes_behind_the_display(self, load):
        model, original = load()
        model.modifiers.new("Crop", "NODES").node_group = _keep_negative_x()
        assert len(edited_splats(model, bpy.context)) == (original.means[:, 0] <= 0).sum()

    def test_as_a_mesh(self, load):
        model, original = load()
        model.modifiers.clear()
        _choose(model)
        bpy.ops.object.convert(target="MESH")
        assert bpy.context.object.type == "MESH"
        bpy.ops.object.convert(target="POINTCLOUD")
        _assert_same(edited_splats(bpy.context.object, bpy.context), original, rtol=0, atol=0)

    def test_all_of_them(self, load):
        model, _ = load()
        group = _keep_negative_x()
        model.modifiers.new("Crop", "NODES").node_group = group
        group.nodes["Compare"].inputs[1].default_value = -1e6
        with pytest.raises(DamagedSplatsError, match="model: has no splats left"):
            edited_splats(model, bpy.context)


class TestJoined:
    """Ctrl+J of two models."""

    def test_that_stand_in_one_place(self, load, tmp_path):
        model, original = load()
        twin = _duplicate(model)
        _choose(twin, model)
        bpy.ops.object.join()
        export = export_splats(model, tmp_path / "out.ply", bpy.context)
        assert export.splats == 400
        assert "200 splats more than were imported" in export.warnings[0]
        _assert_same(edited_splats(model, bpy.context), GaussianSet.concatenate([original, original]), rtol=0, atol=0)

    def test_that_were_turned_and_applied_before(self, load):
        model, original = load()
        twin = _duplicate(model)
        twin.location, twin.rotation_euler = (30, 0, 0), (0, 0, math.radians(90))
        bpy.context.view_layer.update()
        moved = edited_splats(twin, bpy.context)
        apply_transform(twin)
        _choose(twin, model)
        bpy.ops.object.join()
        _assert_same(edited_splats(model, bpy.context), GaussianSet.concatenate([original, moved]), atol=2e-5)

    def test_with_points_that_are_no_splats(self, load):
        model, _ = load()
        bpy.ops.mesh.primitive_cube_add()
        bpy.ops.object.convert(target="POINTCLOUD")
        _choose(bpy.context.object, model)
        bpy.ops.object.join()
        with pytest.raises(DamagedSplatsError, match="'scale' of 8 points is 0"):
            edited_splats(model, bpy.context)


class TestVisibleOnly:
    """Hidden background and what the section hides stay out."""

    def test_the_background(self, blender, photo_run):
        model = import_splats(photo_run / "fused.ply", "model", bpy.context)
        original = GaussianSet.load(photo_run / "fused.ply")
        assert len(edited_splats(model, bpy.context)) == 1300
        _assert_same(edited_splats(model, bpy.context, visible_only=True), original.select(slice(1000)), rtol=0, atol=0)
        bpy.context.scene.insideout.hide_background = False
        assert len(edited_splats(model, bpy.context, visible_only=True)) == 1300

    def test_both_sides_of_a_cut_are_the_whole(self, load):
        model, original = load()
        bpy.ops.insideout.section_add()
        settings = bpy.context.scene.insideout
        settings.sections[0].object.rotation_euler = (0, math.radians(90), 0)
        settings.sections[0].object.location = (2, 0, 0)
        bpy.context.view_layer.update()
        beyond = original.means[:, 0] > 2
        assert 0 < beyond.sum() < 200
        _assert_same(edited_splats(model, bpy.context, visible_only=True), original.select(~beyond), rtol=0, atol=0)
        settings.sections[0].flip = True
        _assert_same(edited_splats(model, bpy.context, visible_only=True), original.select(beyond), rtol=0, atol=0)
        assert len(edited_splats(model, bpy.context)) == 200

    @pytest.mark.parametrize("slab", [0.0, 6.0])
    def test_sides_that_are_pulled_apart_go_out_together(self, load, slab):
        model, original = load()
        bpy.ops.insideout.section_add()
        section = bpy.context.scene.insideout.sections[0]
        section.object.rotation_euler, section.object.location = (0, math.radians(90), 0), (2, 0, 0)
        section.apart_mm, section.slab_mm = 20.0, slab
        bpy.context.view_layer.update()
        across = original.means[:, 0]
        kept = original.select(across > 2 - slab if slab else slice(None))
        found = edited_splats(model, bpy.context, visible_only=True)
        # One side comes after the other.
        _assert_same(*(each.select(np.argsort(each.means[:, 0])) for each in (found, kept)), rtol=0, atol=0)
        assert section.apart_mm == 20.0
        assert modifier_input(cut_modifiers(model)[0], "Apart") == 20.0

    @pytest.mark.parametrize("hides_inside", [True, False])
    def test_at_the_edges_of_boxes_no_splat_is_there_twice(self, load, hides_inside):
        """Beyond two or three faces of a box it is shown in as many parts."""
        model, original = load()
        beyond = np.ones(200, bool)
        for place, size in (((3, 2, -1), (9, 8, 12)), ((-12, -9, 4), (6, 7, 9))):
            bpy.ops.insideout.section_add_box()
            section = bpy.context.scene.insideout.sections[-1]
            section.flip = hides_inside or place[0] < 0
            section.object.matrix_world = Matrix.LocRotScale(place, None, size)
            inside = (np.abs(original.means - np.float32(place)) < size).all(axis=1)
            beyond &= ~inside if section.flip else inside
        bpy.context.view_layer.update()
        assert 0 < beyond.sum() < 200
        found = edited_splats(model, bpy.context, visible_only=True)
        in_order, left = np.argsort(found.means[:, 0]), np.flatnonzero(beyond)
        expected = original.select(left[np.argsort(original.means[left, 0])])
        _assert_same(found.select(in_order), expected, rtol=0, atol=0)

    def test_what_is_peeled_off_is_left_out(self, load):
        model, original = load()
        settings = bpy.context.scene.insideout
        settings.modalities = {"XRAY"}
        xray = original.select(original.modality == 1)
        _assert_same(edited_splats(model, bpy.context, visible_only=True), xray, rtol=0, atol=0)
        settings.peel_density_from = float(np.median(xray.density))
        assert 0 < len(edited_splats(model, bpy.context, visible_only=True)) < len(xray)
        assert len(edited_splats(model, bpy.context)) == 200

    def test_colours_that_stand_for_something_else_are_not_in_the_file(self, load):
        model, original = load()
        bpy.context.scene.insideout.color_by = "DENSITY"
        _assert_same(edited_splats(model, bpy.context), original, rtol=0, atol=0)

    def test_faint_splats_stay_for_they_have_density(self, blender, tmp_path):
        faint = GaussianSet.create(np.eye(3), 1.0, opacities=0.01, density=0.02)
        faint.save(tmp_path / "faint.ply")
        model = import_splats(tmp_path / "faint.ply", "model", bpy.context)
        assert len(edited_splats(model, bpy.context, visible_only=True)) == 3

    def test_the_scene_stays_as_it_is(self, load):
        model, _ = load()
        objects, shown = sorted(bpy.data.objects.keys()), display_modifier(model)
        before = {name: modifier_input(shown, name) for name in ("Ellipsoids", "Minimum Opacity", "Size")}
        edited_splats(model, bpy.context, visible_only=True)
        assert sorted(bpy.data.objects.keys()) == objects
        assert len(bpy.data.pointclouds) == 1
        assert {name: modifier_input(shown, name) for name in before} == before
        assert bpy.context.scene.insideout.model == model

    def test_a_model_that_is_hidden_itself(self, load):
        model, _ = load()
        model.hide_viewport = True
        assert len(edited_splats(model, bpy.context, visible_only=True)) == 200


class TestDamaged:
    """What makes points splats is missing, or makes no sense: the error names it."""

    @pytest.mark.parametrize("name", ["scale", "rotation", "radiance:base", "density", "modality", "radiance:sh_1"])
    def test_an_attribute_that_is_missing(self, load, name):
        model, _ = load()
        model.data.attributes.remove(model.data.attributes[name])
        assert model_to_export(bpy.context) == model
        with pytest.raises(DamagedSplatsError, match=f"lost the attribute '{name}'"):
            edited_splats(model, bpy.context)

    def test_an_attribute_of_another_type(self, load):
        model, _ = load()
        model.data.attributes.remove(model.data.attributes["rotation"])
        model.data.attributes.new("rotation", "FLOAT_VECTOR", "POINT")
        with pytest.raises(DamagedSplatsError, match=r"'rotation' is of the type FLOAT_VECTOR .* have QUATERNION"):
            edited_splats(model, bpy.context)

    @pytest.mark.parametrize(
        ("name", "field", "width"), [("position", "vector", 3), ("density", "value", 1), ("radiance:base", "color", 4)]
    )
    def test_values_that_are_no_numbers(self, load, name, field, width):
        model, _ = load()
        values = np.zeros((200, width), np.float32)
        values[:7] = np.nan
        model.data.attributes[name].data.foreach_set(field, values.ravel())
        with pytest.raises(DamagedSplatsError, match=f"'{name}' of 7 splats is no number"):
            edited_splats(model, bpy.context)


def test_a_display_whose_node_group_was_renamed_is_no_edit(load):
    model, original = load()
    display_modifier(model).node_group.name = "My look"
    assert not is_edited_by_modifiers(model)
    _assert_same(edited_splats(model, bpy.context, visible_only=True), original)


def test_the_active_model_goes_out_or_else_the_shown_one(load, random_set):
    shown, _ = load()
    other = create_splats(random_set, "other", bpy.context)
    bpy.ops.object.empty_add()
    assert model_to_export(bpy.context) == shown
    bpy.context.view_layer.objects.active = other
    assert model_to_export(bpy.context) == other


def test_a_cloud_that_was_not_imported_counts_as_it_stands(blender, random_set):
    other = create_splats(random_set, "other", bpy.context)
    np.testing.assert_allclose(
        _edit(other, location=(1, 0, 0)).means, random_set.means + np.array([1, 0, 0]), atol=1e-5
    )


def test_the_file_says_where_the_model_is_from(load, tmp_path):
    model, _ = load()
    export_splats(model, tmp_path / "out.ply", bpy.context)
    comments = read_comments(tmp_path / "out.ply")
    assert 'insideout file.name = "fused.ply"' in comments
    assert 'insideout unit = "mm"' in comments
    assert any(comment.startswith("insideout exported.date = ") for comment in comments)


def test_a_copy_of_our_nodes_that_the_user_has_made_his_own_is_an_edit(load):
    model, _ = load()
    own = display_modifier(model).node_group.copy()
    own.name = "My crop"
    model.modifiers.new("mine", "NODES").node_group = own
    assert is_edited_by_modifiers(model)
