"""An import sets a new scene's views up; where the user has made something it leaves units, colours and views alone."""

from __future__ import annotations

import bpy  # isort: split

import bmesh
import numpy as np
import pytest
from mathutils import Matrix

from insideout.insideout_addon.physics.world import new_floor
from insideout.insideout_addon.scene.importing import import_splats
from insideout.insideout_addon.scene.startup import is_startup_cube


@pytest.fixture
def startup(blender):
    """Blender's startup file with its cube, camera and light, and a window."""
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    assert "Cube" in bpy.data.objects
    assert _views(bpy.context.scene)
    return bpy.context.scene


def _views(scene):
    windows = [window for window in bpy.context.window_manager.windows if window.scene == scene]
    return [area.spaces.active for window in windows for area in window.screen.areas if area.type == "VIEW_3D"]


def _chosen(scene):
    units = scene.unit_settings
    views = [
        (view.clip_start, view.clip_end, view.shading.type, view.region_3d.view_distance) for view in _views(scene)
    ]
    return units.scale_length, units.length_unit, scene.view_settings.view_transform, views


def _import(tmp_path, splats):
    splats.save(tmp_path / "fused.ply")
    return import_splats(tmp_path / "fused.ply", "model", bpy.context)


def test_a_new_file_is_set_up_for_the_model(startup, tmp_path, random_set):
    _import(tmp_path, random_set)
    scale_length, _, transform, views = _chosen(startup)
    assert scale_length == pytest.approx(0.001)
    assert transform == "Standard"
    assert {view[2] for view in views} == {"MATERIAL"}


@pytest.mark.parametrize(
    ("group", "made"),
    [("mesh", "primitive_cube_add"), ("curve", "primitive_bezier_circle_add"), ("object", "text_add")],
)
def test_what_the_user_made_keeps_its_units_colours_and_views(startup, tmp_path, random_set, group, made):
    getattr(getattr(bpy.ops, group), made)()
    before = _chosen(startup)
    splats = _import(tmp_path, random_set)
    assert _chosen(startup) == before
    assert splats.matrix_world.to_scale().x == pytest.approx(0.001), "life-size in metres"


def test_a_moved_startup_cube_is_the_users(startup, tmp_path, random_set):
    bpy.data.objects["Cube"].location.x = 3
    bpy.context.view_layer.update()
    before = _chosen(startup)
    _import(tmp_path, random_set)
    assert _chosen(startup) == before


def _resized(cube):
    cube.data.transform(Matrix.Scale(0.5, 4))


def _rounded(cube):
    cube.modifiers.new("Bevel", "BEVEL")


def _painted(cube):
    cube.data.materials[0] = bpy.data.materials.new("Gold")


def _in_edit_mode(cube):
    bpy.context.view_layer.objects.active = cube
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="SELECT")
    form = bmesh.from_edit_mesh(cube.data)
    form.verts.ensure_lookup_table()
    form.verts[0].co.x += 1
    bmesh.update_edit_mesh(cube.data)


@pytest.mark.parametrize("change", [_resized, _rounded, _painted, _in_edit_mode])
def test_a_startup_cube_that_somebody_worked_on_is_theirs(startup, tmp_path, random_set, change):
    cube = bpy.data.objects["Cube"]
    assert is_startup_cube(cube)
    change(cube)
    bpy.context.view_layer.update()
    before = _chosen(startup)
    assert not is_startup_cube(cube)
    if cube.mode == "OBJECT":
        _import(tmp_path, random_set)
        assert _chosen(startup) == before
        assert not cube.hide_get()
        assert not cube.hide_render


def test_views_of_another_scene_stay(startup, tmp_path, random_set):
    before = _chosen(startup)[-1]
    other = bpy.data.scenes.new("Other")
    random_set.save(tmp_path / "fused.ply")
    with bpy.context.temp_override(scene=other, view_layer=other.view_layers[0], collection=other.collection):
        import_splats(tmp_path / "fused.ply", "model", bpy.context)
    assert other.insideout.model is not None
    assert _chosen(startup)[-1] == before


def test_a_view_of_the_whole_floor_still_shows_what_fell_on_it(startup, tmp_path, random_set):
    """Home looks at a floor sixteen times as wide as the model from far away."""
    splats = _import(tmp_path, random_set)
    corners = np.array(splats.bound_box)
    floor = new_floor(splats, startup, np.array([corners.min(axis=0), corners.max(axis=0)]), drop_mm=50.0)
    for view in _views(startup):
        assert view.clip_end > 3 * np.linalg.norm(floor.dimensions)


def test_a_set_of_instances_is_the_user_s(startup, tmp_path, random_set):
    """Dragged in from the asset browser, or linked: an empty that shows a collection."""
    table = bpy.data.collections.new("table")
    table.objects.link(bpy.data.objects.new("top", bpy.data.meshes.new("top")))
    instance = bpy.data.objects.new("table", None)
    instance.instance_type, instance.instance_collection = "COLLECTION", table
    startup.collection.objects.link(instance)
    before = _chosen(startup)
    _import(tmp_path, random_set)
    assert _chosen(startup) == before


def test_a_sun_is_as_bright_as_before(startup, tmp_path, random_set):
    """A lamp is set further off, and brighter for it; a sun's light does not get weaker on the way."""
    bpy.data.lights["Light"].type = "SUN"
    bpy.data.lights["Light"].energy = 3.0
    _import(tmp_path, random_set)
    assert bpy.data.lights["Light"].energy == 3.0


def test_a_model_that_another_scene_shows_too_stays_there(startup, tmp_path, random_set):
    first = _import(tmp_path, random_set)
    bpy.data.scenes.new("Other").collection.objects.link(first)
    again = _import(tmp_path, random_set)
    assert again != first
    assert not first.hide_viewport
    assert not first.hide_render
    assert first.name not in startup.objects, "here it would cover what is cut open"


def test_a_further_model_stands_in_the_unit_and_colours_of_the_first(startup, tmp_path, random_set):
    """Though nothing of the user's is left beside which the first one was imported."""
    cube = bpy.data.objects["Cube"]
    cube.location.x = 3
    bpy.context.view_layer.update()
    first = _import(tmp_path, random_set)
    bpy.data.objects.remove(cube)
    second = _import(tmp_path, random_set)
    assert startup.unit_settings.scale_length == 1.0
    assert second.scale.x == pytest.approx(first.scale.x)
    assert second.scale.x == pytest.approx(0.001)
    assert startup.view_settings.view_transform == "AgX"
