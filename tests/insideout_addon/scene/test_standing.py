"""Where objects stand that no window shows: Blender forgets that with each file that it opens."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from mathutils import Euler, Matrix

from insideout.core.gaussians import GaussianSet
from insideout.insideout_addon.measure.rulers import place_in_model
from insideout.insideout_addon.scene import section_box, section_clip
from insideout.insideout_addon.scene.placement import moved_since_import
from insideout.insideout_addon.scene.section import place_plane, sample_section
from insideout.insideout_addon.scene.section_live import live
from insideout.insideout_addon.scene.sections import add_section_box, add_section_plane
from insideout.insideout_addon.scene.standing import place_in_world, put_in_world

PLACE = Matrix.LocRotScale((40, 5, -9), Euler((0.4, -1.1, 2.0)), (3, 3, 3))


def _settings():
    return bpy.context.scene.insideout


@pytest.fixture
def cut(blender, tmp_path, one_ball):
    """A ball in a cube of markers, 40 mm wide, imported, with a section plane that shows it at x = 5 mm."""
    markers = GaussianSet.create([[-20, -20, -20], [20, 20, 20]], 0.01)
    GaussianSet.concatenate([one_ball, markers]).save(tmp_path / "ball.ply")

    def bring(scale_length=0.001):
        units = bpy.context.scene.unit_settings
        units.system, units.scale_length = "METRIC", scale_length
        bpy.ops.insideout.import_run(filepath=str(tmp_path / "ball.ply"))
        model = _settings().model
        add_section_plane(model, bpy.context)
        place_plane(bpy.context.scene, (5, 0, 0), (1, 0, 0))
        bpy.context.view_layer.update()
        return model

    return bring


@pytest.fixture
def reopen(tmp_path):
    def again():
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
        return _settings()

    return again


def _hide(*things):
    """With their parts: what is shown below them lets Blender work out where they are."""
    for thing in things:
        for each in (thing, *thing.children_recursive):
            each.hide_viewport = True


@pytest.mark.parametrize("scale_length", [0.01, 0.001])
def test_a_plane_and_a_model_that_are_hidden_are_where_they_were_in_the_file(cut, reopen, scale_length):
    model = cut(scale_length)
    model.matrix_world = PLACE @ model.matrix_world
    _settings().sections[0].object.matrix_world = PLACE @ _settings().sections[0].object.matrix_world
    bpy.context.view_layer.update()
    before, view = sample_section(bpy.context.scene, 64)
    _hide(model, _settings().sections[0].object)
    section = reopen().sections[0]
    assert section.position_mm == pytest.approx(5.0, abs=1e-3)
    after, again = sample_section(bpy.context.scene, 64)
    np.testing.assert_allclose(again.points(), view.points(), atol=1e-3)
    np.testing.assert_allclose(after, before, atol=1e-3 * before.max())


def test_a_hidden_plane_keeps_its_turn_when_it_is_moved(cut, reopen):
    plane = (cut(), _settings().sections[0].object)[1]
    turn = plane.matrix_basis.to_quaternion()
    _hide(_settings().model, plane)
    section = reopen().sections[0]
    section.position_mm = -3.0
    section.object.hide_viewport = _settings().model.hide_viewport = False
    bpy.context.view_layer.update()
    assert section.position_mm == pytest.approx(-3.0, abs=1e-3)
    assert section.object.matrix_world.to_quaternion().rotation_difference(turn).angle < 1e-4


def test_a_hidden_plane_that_is_turned_to_an_axis_keeps_its_place_and_size(cut, reopen):
    model = cut(scale_length=0.01)
    _hide(model, _settings().sections[0].object)
    section = reopen().sections[0]
    place_plane(bpy.context.scene, normal=(0, 0, 1))
    section.object.hide_viewport = _settings().model.hide_viewport = False
    bpy.context.view_layer.update()
    place = _settings().model.matrix_world.inverted() @ section.object.matrix_world
    np.testing.assert_allclose(place.translation, (5, 0, 0), atol=1e-3)
    np.testing.assert_allclose(place.to_scale(), 1.0, rtol=1e-4)


def test_a_hidden_model_in_centimetres_is_sampled_in_its_own_mm_where_its_plane_is_moved(cut, reopen, drawn):
    _hide(cut(scale_length=0.01))
    section = reopen().sections[0]
    section.object.location.x -= 0.5
    bpy.context.view_layer.update()
    assert section.position_mm == pytest.approx(0.0, abs=1e-3)
    live.refresh(bpy.context.scene)
    colors = drawn(section.object)
    # The ball, but not the air around it.
    assert 0.002 < (colors[..., 3] > 0.5).mean() < 0.5


def test_a_hidden_box_and_what_it_hides_are_where_they_were(cut, reopen):
    model = cut(scale_length=0.01)
    box = add_section_box(model, bpy.context)
    bpy.context.view_layer.update()
    before = section_box.box_views(box, model, 32)
    clip = section_clip.place_in_model(_settings().sections[1], model, None)
    _hide(model, *(section.object for section in _settings().sections))
    section = reopen().sections[1]
    after = section_box.box_views(section.object, _settings().model, 32)
    for one, other in zip(before, after, strict=True):
        np.testing.assert_allclose(other.points(), one.points(), atol=1e-3)
    np.testing.assert_allclose(section_clip.place_in_model(section, _settings().model, None), clip, atol=1e-4)


def test_places_in_a_hidden_model_are_measured_where_it_stands(cut, reopen):
    _hide(cut(scale_length=0.01))
    np.testing.assert_allclose(place_in_model(reopen().model, (0.4, 0, 0.2)), (4, 0, 2), atol=1e-4)


def test_what_a_parent_that_is_gone_has_left_behind_does_not_place_a_hidden_model(cut):
    """Alt+P keeps it there, and Blender heeds it only with a parent."""
    model = cut()
    before = moved_since_import(model)
    model.matrix_parent_inverse = Matrix.Translation((100, 0, 0))
    bpy.context.view_layer.update()
    shown = place_in_world(model)
    _hide(model)
    bpy.context.view_layer.update()
    np.testing.assert_allclose(place_in_world(model), shown, atol=1e-5)
    np.testing.assert_allclose(moved_since_import(model).translation, before.translation, atol=1e-5)


def test_below_parents_that_are_hidden_too_it_is_where_these_put_it(blender, reopen):
    things = [bpy.data.objects.new(name, None) for name in ("grandparent", "parent", "child")]
    for parent, thing in zip([None, *things], things, strict=False):
        bpy.context.scene.collection.objects.link(thing)
        thing.parent, thing.location, thing.rotation_euler.z = parent, (1, 2, 3), 0.7
    bpy.context.view_layer.update()
    expected = things[2].matrix_world.copy()
    _hide(*things)
    reopen()
    child = bpy.data.objects["child"]
    np.testing.assert_allclose(place_in_world(child), expected, atol=1e-5)
    put_in_world(child, PLACE)
    np.testing.assert_allclose(place_in_world(child), PLACE, atol=1e-4)
    for thing in bpy.data.objects:
        thing.hide_viewport = False
    bpy.context.view_layer.update()
    np.testing.assert_allclose(child.matrix_world, PLACE, atol=1e-4)


def test_what_physics_or_constraints_place_is_where_blender_shows_it(blender):
    target, thing = (bpy.data.objects.new(name, None) for name in ("target", "thing"))
    for one in (target, thing):
        bpy.context.scene.collection.objects.link(one)
    target.location = (4, 5, 6)
    thing.constraints.new("COPY_LOCATION").target = target
    bpy.context.view_layer.update()
    np.testing.assert_allclose(place_in_world(thing).translation, (4, 5, 6))
