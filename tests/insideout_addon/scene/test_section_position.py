"""Where a section plane lies, in mm: read, set, turned along the model's axes, the same as on a sheet."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from mathutils import Euler, Matrix, Vector

from insideout.core.gaussians import GaussianSet
from insideout.core.views import Plane
from insideout.insideout_addon.measure.sheet import axis_series
from insideout.insideout_addon.scene.lettering import lettering
from insideout.insideout_addon.scene.placement import apply_transform
from insideout.insideout_addon.scene.section import (
    move_plane,
    place_plane,
    plane_position,
    sample_section,
    section_as_seen,
)
from insideout.insideout_addon.scene.section_position import Position

MIDDLE = Vector((3, -2, 1))


@pytest.fixture
def cut(blender, tmp_path, one_ball):
    """A ball at `MIDDLE` between two markers, imported, with a section plane half way in."""
    markers = GaussianSet.create([[-17, -22, -19], [23, 18, 21]], 0.01)
    GaussianSet.concatenate([one_ball, markers]).save(tmp_path / "ball.ply")

    def bring():
        bpy.ops.insideout.import_run(filepath=str(tmp_path / "ball.ply"))
        bpy.ops.insideout.section_add()
        return bpy.context.scene.insideout

    return bring


def _place(plane, normal, point, model=None):
    """A plane at right angles to `normal` through `point`, both in the model's frame."""
    frame = Matrix() if model is None else model.matrix_world
    turn = Vector(normal).to_track_quat("Z", "Y").to_matrix().to_4x4()
    plane.matrix_world = frame @ Matrix.Translation(point) @ turn
    bpy.context.view_layer.update()


@pytest.mark.parametrize(
    ("normal", "axis", "mm"),
    [
        ((1, 0, 0), "x", 3.0),
        ((-1, 0, 0), "x", 3.0),
        ((0, -1, 0), "y", -2.0),
        ((0, 0, 1), "z", 1.0),
        ((0, 0, -2), "z", 1.0),
        ((0, 3, 4), "", -0.4),
        ((0, -3, -4), "", -0.4),
        ((0.01, 0, 1), "", 1.03),
    ],
)
def test_it_is_the_coordinate_or_the_distance_along_the_normal(cut, normal, axis, mm):
    """Whichever side is hidden."""
    section = cut().sections[0]
    _place(section.object, normal, MIDDLE)
    assert section.position_mm == pytest.approx(mm, abs=2e-4)
    assert plane_position(section).axis == axis
    section.flip = True
    assert section.position_mm == pytest.approx(mm, abs=2e-4)


def test_at_45_degrees_rounding_does_not_turn_its_sign(cut):
    section, found = cut().sections[0], set()
    for wobble in (-1e-5, 0.0, 1e-5):
        _place(section.object, (-1 + wobble, 1, 0), MIDDLE)
        found.add(round(section.position_mm, 2))
    assert found == {round(-5 / 2**0.5, 2)}


def test_it_follows_a_plane_that_is_moved_by_hand(cut):
    section = cut().sections[0]
    before = section.position_mm
    section.object.location += Vector((0, 7, 0))
    bpy.context.view_layer.update()
    assert section.position_mm == pytest.approx(before + 7, abs=1e-4)
    section.object.location += Vector((5, 0, 3))
    bpy.context.view_layer.update()
    assert section.position_mm == pytest.approx(before + 7, abs=1e-4), "in its plane it may go anywhere"


@pytest.mark.parametrize("normal", [(0, -1, 0), (1, 2, -2)])
def test_set_it_moves_the_plane_along_its_normal_alone(cut, normal):
    section = cut().sections[0]
    _place(section.object, normal, MIDDLE)
    before = section.object.matrix_world.copy()
    section.position_mm = 6.5
    bpy.context.view_layer.update()
    assert section.position_mm == pytest.approx(6.5, abs=1e-4)
    after = section.object.matrix_world
    np.testing.assert_allclose(after.to_3x3(), before.to_3x3(), atol=1e-5)
    way = after.translation - before.translation
    assert way.cross(Vector(normal)).length == pytest.approx(0, abs=1e-3)
    assert way.length > 1


@pytest.mark.parametrize("normal", [(1, 0, 0), (0, -1, 0), (0, 0, 1), (0, 3, -4)])
def test_a_plane_of_a_mirrored_model_hides_the_side_that_it_is_told_to(cut, normal):
    settings = cut()
    settings.model.scale.x *= -1
    bpy.context.view_layer.update()
    place_plane(bpy.context.scene, normal=normal)
    bpy.context.view_layer.update()
    plane = settings.sections[0].object
    hidden = (settings.model.matrix_world.inverted().to_3x3() @ plane.matrix_world.col[2].xyz).normalized()
    np.testing.assert_allclose(hidden, Vector(normal).normalized(), atol=1e-5)
    assert not plane.matrix_world.is_negative


def test_nothing_is_stored_of_it(cut):
    section = cut().sections[0]
    section.position_mm = 4.0
    assert not section.bl_rna.properties["position_mm"].is_animatable
    section.object.location.y = -1.0
    bpy.context.view_layer.update()
    assert section.position_mm == pytest.approx(-1.0, abs=1e-5)


def test_the_section_is_the_one_there(cut):
    settings = cut()
    settings.sections[0].position_mm = -2.0 + 5.0
    bpy.context.view_layer.update()
    values, view = sample_section(bpy.context.scene, 101)
    assert values.max() == pytest.approx(0.04 * np.exp(-0.5), rel=5e-3)
    np.testing.assert_allclose(view.points()[..., 1], 3.0, atol=1e-4)


@pytest.mark.parametrize("scale_length", [1.0, 0.01, 0.001])
@pytest.mark.parametrize("user", [Matrix(), Matrix.LocRotScale((40, 5, -9), Euler((0.4, -1.1, 2.0)), (3, 3, 3))])
def test_it_is_in_the_models_own_mm_whatever_unit_the_scene_has_and_wherever_the_model_stands(cut, scale_length, user):
    unit = bpy.context.scene.unit_settings
    unit.system, unit.scale_length = "METRIC", scale_length
    settings = cut()
    section, model = settings.sections[0], settings.model
    model.matrix_world = user @ model.matrix_world
    bpy.context.view_layer.update()
    _place(section.object, (0, -3, 4), MIDDLE, model)
    assert section.position_mm == pytest.approx(2.0, abs=1e-3)
    section.position_mm = -1.0
    bpy.context.view_layer.update()
    assert section.position_mm == pytest.approx(-1.0, abs=1e-3)
    place = model.matrix_world.inverted() @ section.object.matrix_world
    np.testing.assert_allclose(place.translation, MIDDLE - 3.0 * Vector((0, -0.6, 0.8)), atol=1e-3)


def test_of_a_model_scaled_unevenly_it_is_along_the_normal_in_the_models_frame(cut):
    settings = cut()
    settings.model.scale = (1, 1, 2)
    bpy.context.view_layer.update()
    section = settings.sections[0]
    section.object.matrix_world = Matrix.Translation((3, -2, 2)) @ Euler((0.5, 0, 0)).to_matrix().to_4x4()
    bpy.context.view_layer.update()
    section.position_mm = 5.0
    bpy.context.view_layer.update()
    assert section.position_mm == pytest.approx(5.0, abs=1e-3)


def test_after_apply_transform_it_is_in_the_frame_of_the_splats_as_they_are_now(cut):
    settings = cut()
    settings.model.location += Vector((0, 10, 0))
    bpy.context.view_layer.update()
    _place(settings.sections[0].object, (0, 1, 0), MIDDLE)
    assert settings.sections[0].position_mm == pytest.approx(-12.0, abs=1e-4)
    apply_transform(settings.model)
    bpy.context.view_layer.update()
    assert settings.sections[0].position_mm == pytest.approx(-2.0, abs=1e-4)


@pytest.mark.parametrize("axis", "XYZ")
def test_a_sheet_says_the_same_of_the_same_plane_and_shows_it_the_same_way_round(cut, axis):
    settings = cut()
    assert bpy.ops.insideout.section_face(axis=axis) == {"FINISHED"}
    bpy.context.view_layer.update()
    series = axis_series(np.array([[-17, -22, -19], [23, 18, 21]]), axis, 5)
    settings.sections[0].position_mm = series.positions[3]
    bpy.context.view_layer.update()
    _, view = sample_section(bpy.context.scene, 32)
    of_sheet = series.plane(series.positions[3], 1.0)
    assert Position.of(view).text == Position.of(of_sheet).text
    assert series.label(3).split()[1:3] == [axis.lower(), "="]
    told = float(series.label(3).split()[3].replace("−", "-"))
    assert told == pytest.approx(settings.sections[0].position_mm, abs=0.05)
    for way in ("u", "v"):
        ours, its = (np.asarray(getattr(plane, way)) for plane in (view, of_sheet))
        np.testing.assert_allclose(ours / np.linalg.norm(ours), its / np.linalg.norm(its), atol=1e-5)


@pytest.mark.parametrize("axis", "XYZ")
def test_where_it_is_flipped_it_is_seen_as_on_sheets_too(cut, axis):
    settings = cut()
    settings.sections[0].flip = True
    bpy.ops.insideout.section_face(axis=axis)
    bpy.context.view_layer.update()
    _, view = section_as_seen(bpy.context.scene, 32)
    of_sheet = axis_series(np.array([[-17, -22, -19], [23, 18, 21]]), axis, 5).plane(0.0, 1.0)
    for way in ("u", "v"):
        ours, its = (np.asarray(getattr(plane, way)) for plane in (view, of_sheet))
        np.testing.assert_allclose(ours / np.linalg.norm(ours), its / np.linalg.norm(its), atol=1e-5)


def test_a_plane_that_is_turned_to_an_axis_stays_where_its_middle_is(cut):
    section = cut().sections[0]
    section.object.scale = (2, 1, 1)
    _place(section.object, (0.3, -1, 0.5), MIDDLE)
    bpy.ops.insideout.section_face(axis="Z")
    bpy.context.view_layer.update()
    np.testing.assert_allclose(section.object.matrix_world.translation, MIDDLE, atol=1e-5)
    assert section.position_mm == pytest.approx(1.0, abs=1e-4)


def test_the_axes_are_those_of_the_model(cut):
    settings = cut()
    settings.model.rotation_euler = (0.5, 1.0, 0.2)
    bpy.context.view_layer.update()
    bpy.ops.insideout.section_face(axis="X")
    bpy.context.view_layer.update()
    hidden = settings.sections[0].object.matrix_world.to_3x3().col[2]
    np.testing.assert_allclose(hidden, settings.model.matrix_world.to_3x3().col[0], atol=1e-5)


def test_without_a_plane_or_a_model_it_is_nothing_and_moves_nothing(cut):
    settings = cut()
    section, plane = settings.sections[0], settings.sections[0].object
    before = plane.matrix_world.copy()

    def nothing():
        section.position_mm = 9.0
        return section.position_mm == 0.0 and plane.matrix_world == before and plane_position(section) is None

    model = settings.model
    model.scale = (0, 0, 0)
    bpy.context.view_layer.update()
    assert nothing(), "scaled to nothing"
    with pytest.raises(RuntimeError, match="is scaled to nothing"):
        bpy.ops.insideout.section_face(axis="X")
    settings.model = None
    assert nothing(), "no model"
    assert not bpy.ops.insideout.section_face.poll()
    model.scale = (1, 1, 1)
    settings.model = model
    bpy.context.view_layer.update()
    bpy.data.objects.remove(plane)
    move_plane(section, 9.0)
    assert section.position_mm == 0.0
    assert not bpy.ops.insideout.section_face.poll()


def test_a_box_has_no_position(cut):
    settings = cut()
    bpy.ops.insideout.section_add_box()
    assert settings.sections[1].position_mm == 0.0


def test_a_script_that_places_the_plane_reads_what_it_asked_for(cut):
    settings = cut()
    place_plane(bpy.context.scene, position=(0, 12, 0), normal=(0, 1, 0))
    assert settings.sections[0].position_mm == pytest.approx(12.0, abs=1e-4)


def test_on_a_small_plane_a_position_has_more_decimals():
    plane = Plane(np.array([0, 0, 0.01234]), np.array([0.01, 0, 0]), np.array([0, 0.01, 0]), 10, 10)
    assert Position.of(plane).text == "z = 0.0123 mm"


@pytest.mark.parametrize(
    ("normal", "middle", "text"),
    [
        ((0, 0, 1), (5, 6, -0.001), "z = 0.00 mm"),
        ((0, 1, 0), (5, -12.346, 1), "y = -12.35 mm"),
        ((0.6, 0, 0.8), (10, 1, 0), "6.00 mm along (0.60, 0.00, 0.80)"),
    ],
)
def test_what_stands_in_pictures_can_be_written_whole(normal, middle, text):
    turn = np.array(Vector(normal).to_track_quat("Z", "Y").to_matrix())
    u, v = 0.5 * turn[:, 0], -0.5 * turn[:, 1]
    position = Position.of(Plane(np.array(middle) - 16 * u - 8 * v, u, v, 32, 16))
    assert position.text == text
    assert all(lettering(letter).any() for letter in text.replace(" ", ""))
