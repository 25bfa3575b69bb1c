"""Pictures of planes lie on the cut faces, also where other planes have pulled the model apart."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from mathutils import Euler, Matrix

from insideout.insideout_addon.scene import section_live, sections
from insideout.insideout_addon.scene.display import show_splats
from insideout.insideout_addon.scene.section import sample_section
from insideout.insideout_addon.scene.section_clip import hidden_pixels
from insideout.insideout_addon.scene.section_faces import Pull, divided
from insideout.insideout_addon.scene.splats import create_splats

SQUARE = np.array([(-1.0, -1), (1, -1), (1, 1), (-1, 1)])
UP = np.array([0.0, 0, 1])


def _area(corners):
    x, y = corners.T
    return 0.5 * abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))


def test_a_plane_that_crosses_divides_a_picture():
    right, left = divided(SQUARE, [Pull(np.array([1.0, 0, 0]), 0.5, UP)])
    assert right.corners[:, 0].min() == pytest.approx(0.5)
    assert left.corners[:, 0].max() == pytest.approx(0.5)
    np.testing.assert_array_equal([right.shift, left.shift], [UP, -UP])
    assert [_area(right.corners), _area(left.corners)] == pytest.approx([1.0, 3.0])


def test_a_plane_that_does_not_cross_moves_all_of_it():
    (face,) = divided(SQUARE, [Pull(UP, -0.2, 3 * UP)])
    np.testing.assert_array_equal(face.corners, SQUARE)
    np.testing.assert_array_equal(face.shift, 3 * UP)
    (face,) = divided(SQUARE, [Pull(np.array([1.0, 0, 0]), 7.0, UP)])
    np.testing.assert_array_equal(face.shift, -UP)


def test_two_planes_divide_it_in_four_that_are_all_of_it():
    slanted = np.array([0.6, 0.8, 0.3])
    faces = divided(SQUARE, [Pull(slanted, 0.1, UP), Pull(np.array([-0.8, 0.6, 0]), 0.0, 5 * UP)])
    assert sorted(face.shift[2] for face in faces) == [-6, -4, 4, 6]
    assert sum(_area(face.corners) for face in faces) == pytest.approx(4.0)


@pytest.fixture
def crossing(blender, random_set):
    """A model with two planes that cross; the second one pulls it 20 mm apart."""
    model = create_splats(random_set, "model", bpy.context)
    show_splats(model, True)
    bpy.context.scene.insideout.pixels = 48
    for _ in range(2):
        sections.add_section_plane(model, bpy.context)
    settings = bpy.context.scene.insideout
    settings.sections[1].apart_mm = 20.0
    return settings


def _corners(plane):
    """(faces, 4, 3) in the world, and (faces, 4, 2) places on the picture."""
    bpy.context.view_layer.update()
    places = np.array([plane.matrix_world @ vertex.co for vertex in plane.data.vertices])
    uv = np.array([loop.uv for loop in plane.data.uv_layers["UVMap"].data])
    return [(places[list(face.vertices)], uv[list(face.loop_indices)]) for face in plane.data.polygons]


def _check(settings):
    """Each part of the first picture is where its half of the model is."""
    picture, pulling = (entry.object for entry in settings.sections)
    size = picture["insideout_size_mm"]
    model, other = settings.model.matrix_world, pulling.matrix_world
    normal = np.array((model.inverted() @ other).to_3x3().inverted().transposed().col[2])
    normal /= np.linalg.norm(normal)
    origin = np.array(model.inverted() @ other.translation)
    sides = []
    for places, uv in _corners(picture):
        flat = [picture.matrix_world @ Matrix.Translation((*(size * (place - 0.5)), 0)).translation for place in uv]
        before = np.array([model.inverted() @ place for place in flat])
        now = np.array([model.inverted() @ Matrix.Translation(place).translation for place in places])
        side = np.sign((before.mean(axis=0) - origin) @ normal)
        assert ((before - origin) @ normal * side > -1e-3).all(), "no part reaches over the plane that pulls"
        np.testing.assert_allclose(now - before, np.tile(10 * side * normal, (len(now), 1)), atol=2e-3 * size)
        sides.append(side)
    return sides


def test_a_picture_is_moved_with_the_halves_that_it_is_on(crossing):
    section_live.live.refresh(bpy.context.scene)
    assert sorted(_check(crossing)) == [-1, 1]


@pytest.mark.parametrize("scale", [(1, 1, 1), (0.001, 0.001, 0.001), (2, 1, 0.5), (-1, 1, 1)])
def test_however_the_model_is_scaled_and_the_planes_are_turned(crossing, scale):
    crossing.model.scale = scale
    for entry, turn in zip(crossing.sections, ((1.2, 0.4, 0), (0.3, 0.7, 0.2)), strict=True):
        entry.object.rotation_euler = Euler(turn)
        entry.object.scale = (scale[1],) * 3
    bpy.context.view_layer.update()
    section_live.live.refresh(bpy.context.scene)
    assert set(_check(crossing)) <= {-1, 1}


def test_it_follows_the_plane_that_pulls(crossing):
    scene = bpy.context.scene
    section_live.live.refresh(scene)
    crossing.sections[1].object.location.x += 3
    bpy.context.view_layer.update()
    section_live.live.refresh(scene)
    _check(crossing)


def test_it_is_one_again_when_the_halves_are_together(crossing):
    picture = crossing.sections[0].object
    assert len(picture.data.polygons) == 2
    crossing.sections[1].apart_mm = 0.0
    assert len(picture.data.polygons) == 1
    crossing.sections[1].apart_mm = 20.0
    assert len(picture.data.polygons) == 2
    crossing.sections[1].cut = False
    assert len(picture.data.polygons) == 1


def test_both_pull(crossing):
    """Each picture has two faces, each in two parts."""
    crossing.sections[0].apart_mm = 6.0
    assert [len(entry.object.data.polygons) for entry in crossing.sections] == [4, 4]


def test_the_picture_hides_what_a_slab_of_the_other_hides(crossing):
    scene, picture = bpy.context.scene, crossing.sections[0]
    _, view = sample_section(scene, plane=picture.object)
    assert not hidden_pixels(scene, picture, view).any()
    crossing.sections[1].slab_mm = 5.0
    hidden = hidden_pixels(scene, picture, view).mean()
    assert 0.2 < hidden < 0.5, "what is deeper than the slab on one side; all is seen on the other"
