"""Importing a run's splats."""

from __future__ import annotations

import bpy
import pytest

from insideout.core.errors import GaussianFileError
from insideout.core.gaussians import GaussianSet
from insideout.insideout_addon.scene.display import display_modifier
from insideout.insideout_addon.scene.importing import available_sets, find_set, import_splats
from insideout.insideout_addon.scene.node_tree import modifier_input


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


def test_the_model_is_shown_selected_and_in_millimetres(blender, tmp_path, random_set):
    random_set.save(tmp_path / "fused.ply")
    splats = import_splats(tmp_path / "fused.ply", "model", bpy.context)
    assert bpy.context.scene.insideout.model == splats
    assert bpy.context.view_layer.objects.active == splats
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
