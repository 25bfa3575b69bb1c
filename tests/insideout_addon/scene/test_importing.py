"""Importing a run's splats."""

from __future__ import annotations

from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from insideout.core.errors import GaussianFileError
from insideout.core.gaussians import GaussianSet
from insideout.insideout_addon.scene.display import display_modifier
from insideout.insideout_addon.scene.importing import available_sets, find_set, frame_box, import_splats
from insideout.insideout_addon.scene.node_tree import modifier_input
from insideout.insideout_addon.scene.section import sample_section


def test_the_furthest_stage_is_taken(tmp_path, random_set):
    random_set.save(tmp_path / "surface" / "xray.ply")
    assert find_set(tmp_path, "xray") == tmp_path / "surface" / "xray.ply"
    random_set.save(tmp_path / "internal" / "xray.ply")
    assert find_set(tmp_path, "xray") == tmp_path / "internal" / "xray.ply"
    random_set.save(tmp_path / "xray.ply")
    assert find_set(tmp_path, "xray") == tmp_path / "xray.ply"
    assert available_sets(tmp_path) == ["xray"]


def test_a_run_without_the_set_is_told(tmp_path):
    with pytest.raises(GaussianFileError, match="holds no fused splats"):
        find_set(tmp_path, "fused")


def test_the_model_is_shown_active_and_in_millimetres(blender, tmp_path, random_set):
    random_set.save(tmp_path / "fused.ply")
    splats = import_splats(tmp_path / "fused.ply", "model", bpy.context)
    assert bpy.context.scene.insideout.model == splats
    assert bpy.context.view_layer.objects.active == splats
    assert not any(thing.select_get() for thing in bpy.context.view_layer.objects), "outlines would cover the model"
    assert modifier_input(display_modifier(splats), "Ellipsoids")
    assert bpy.context.scene.unit_settings.scale_length == pytest.approx(0.001)
    assert bpy.context.scene.unit_settings.length_unit == "MILLIMETERS"


def test_colours_are_shown_as_they_are(blender, tmp_path, random_set):
    random_set.save(tmp_path / "fused.ply")
    bpy.context.scene.view_settings.view_transform = "AgX"
    import_splats(tmp_path / "fused.ply", "model", bpy.context)
    assert bpy.context.scene.view_settings.view_transform == "Standard"


def test_units_the_user_chose_stay(blender, tmp_path, random_set):
    bpy.context.scene.unit_settings.scale_length = 0.01
    random_set.save(tmp_path / "fused.ply")
    import_splats(tmp_path / "fused.ply", "model", bpy.context)
    assert bpy.context.scene.unit_settings.scale_length == pytest.approx(0.01)


@pytest.mark.parametrize("content", ["", "not a ply"])
def test_a_bad_file_changes_nothing(blender, tmp_path, content):
    (tmp_path / "bad.ply").write_text(content, "utf-8")
    with pytest.raises(GaussianFileError, match=r"bad\.ply"):
        import_splats(tmp_path / "bad.ply", "model", bpy.context)
    assert len(bpy.data.objects) == 0


def test_an_empty_set_changes_nothing(blender, tmp_path):
    GaussianSet.empty().save(tmp_path / "none.ply")
    with pytest.raises(GaussianFileError, match="holds no splats"):
        import_splats(tmp_path / "none.ply", "model", bpy.context)
    assert len(bpy.data.objects) == 0


@pytest.mark.parametrize(
    ("system", "scale_length", "unit"), [("METRIC", 0.01, 0.1), ("IMPERIAL", 1.0, 0.001), ("NONE", 1.0, 1.0)]
)
def test_a_millimetre_is_one_in_every_system_of_units(blender, tmp_path, random_set, system, scale_length, unit):
    units = bpy.context.scene.unit_settings
    units.system, units.scale_length = system, scale_length
    random_set.save(tmp_path / "fused.ply")
    splats = import_splats(tmp_path / "fused.ply", "model", bpy.context)
    extent = float((random_set.means.max(axis=0) - random_set.means.min(axis=0)).max())
    assert splats.matrix_world.to_scale().x == pytest.approx(unit)
    bpy.ops.insideout.section_add()
    plane = bpy.context.scene.insideout.plane
    assert extent < plane.dimensions.x / unit < 1.5 * extent
    values, view = sample_section(bpy.context.scene, 64)
    assert extent < 64 * float((view.u**2).sum()) ** 0.5 < 1.5 * extent
    assert values.max() > 0


def test_a_new_model_is_cut_by_the_plane_that_is_there(blender, tmp_path, random_set):
    random_set.save(tmp_path / "fused.ply")
    import_splats(tmp_path / "fused.ply", "first", bpy.context)
    bpy.ops.insideout.section_add()
    second = import_splats(tmp_path / "fused.ply", "second", bpy.context)
    assert modifier_input(display_modifier(second), "Cut")


@pytest.mark.parametrize(
    ("location", "distance", "moved"),
    [((0, 0, 0), 18.0, True), ((12, 0, 0), 200.0, False), ((500, 0, 0), 200.0, True), ((0, 0, 0), 5000.0, True)],
)
def test_a_first_model_is_in_view(location, distance, moved):
    view = SimpleNamespace(view_location=location, view_distance=distance)
    frame_box(view, np.array([[-30.0, -40, -50], [50, 40, 50]]))
    if moved:
        np.testing.assert_allclose(view.view_location, [10, 0, 0])
        assert 150 < view.view_distance < 400
    else:
        assert (view.view_location, view.view_distance) == (location, distance)
