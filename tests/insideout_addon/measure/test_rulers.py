"""Measured lines and their figures as they are drawn: readable over whatever is behind them."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from mathutils import Matrix, Vector

from insideout.insideout_addon.measure.drawing import _CORE
from insideout.insideout_addon.measure.marks import marks_on
from insideout.insideout_addon.measure.rulers import add_point, add_ruler, remeasure, remove_ruler
from insideout.insideout_addon.scene.section import shown_plane
from insideout.insideout_addon.scene.sections import add_section_plane

PIXELS, ACROSS = 64, 4.0


@pytest.fixture
def model(blender, tmp_path, one_ball):
    one_ball.save(tmp_path / "ball.ply")
    bpy.ops.insideout.import_run(filepath=str(tmp_path / "ball.ply"))
    return bpy.context.scene.insideout.model


def test_lettering_that_was_renamed_is_still_a_mark_on_the_model(model):
    ruler = _measured(model, (0, 0, 0), (0, 0, 5))
    lettering = list(ruler.children_recursive)
    for number, part in enumerate(lettering):
        part.name = f"mine {number}"
    assert len(lettering) == 2
    assert set(lettering) <= set(marks_on(model))
    note = bpy.data.objects.new("Note", None)
    note.parent = ruler
    assert note not in marks_on(model)


def _measured(model, *places):
    points = [add_point(model, place, bpy.context) for place in places]
    ruler, _ = add_ruler(model, points, bpy.context)
    bpy.context.view_layer.update()
    return ruler


def _rendered(folder, ruler, tilt):
    """(64, 64, 3) a line along y before yellow, 4 of its radii across, by a camera that is tilted along it, degrees."""
    scene = bpy.context.scene
    for thing in scene.objects:
        thing.hide_render = thing != ruler
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(camera)
    camera.matrix_world = Matrix.Rotation(np.radians(tilt), 4, "X") @ Matrix.Translation((0, 0, 100))
    camera.data.type, camera.data.ortho_scale = "ORTHO", ACROSS * ruler.data.bevel_depth
    camera.data.clip_end = 1000
    world = scene.world = bpy.data.worlds.new("World")
    if world.node_tree is None:
        world.use_nodes = True
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (1, 1, 0, 1)
    scene.camera, scene.render.engine, scene.cycles.samples, scene.cycles.device = camera, "CYCLES", 4, "CPU"
    scene.view_settings.view_transform = "Standard"
    scene.render.resolution_x = scene.render.resolution_y = PIXELS
    scene.render.filepath = str(folder / "line.png")
    bpy.ops.render.render(write_still=True)
    return np.array(bpy.data.images.load(scene.render.filepath).pixels).reshape(PIXELS, PIXELS, 4)[..., :3]


@pytest.mark.parametrize(("turn", "tilt"), [(0, 0), (50, 0), (0, 60), (50, 65)])
def test_a_line_has_a_dark_rim_on_both_sides_from_wherever_it_is_seen(model, tmp_path, turn, tilt):
    """A rim that was told by the surface's tilt alone would be all there is of a line that is seen along it."""
    ruler = _measured(model, (0, -300, 0), (0, 300, 0))
    ruler.matrix_basis = Matrix.Rotation(np.radians(turn), 4, "Y")
    row = _rendered(tmp_path, ruler, tilt)[PIXELS // 2]
    light, dark = row.min(axis=1) > 0.9, row.max(axis=1) < 0.1
    across = np.flatnonzero(light)
    assert len(across) == pytest.approx(_CORE * 2 * PIXELS / ACROSS, abs=3)
    assert np.ptp(across) == len(across) - 1, "in one piece"
    rims = np.flatnonzero(dark)
    left, right = (rims < across[0]).sum(), (rims > across[-1]).sum()
    expected = (1 - _CORE) * PIXELS / ACROSS
    assert (left, right) == (pytest.approx(expected, abs=3), pytest.approx(expected, abs=3))


def test_sides_of_a_polygon_are_as_wide_as_a_single_line(model):
    """One bent spline would be thinner there."""
    ruler = _measured(model, (0, 0, 0), (30, 0, 0), (30, 2, 0))
    mesh = ruler.evaluated_get(bpy.context.evaluated_depsgraph_get()).to_mesh()
    vertices = np.array([vertex.co for vertex in mesh.vertices])
    ends = vertices[np.abs(vertices[:, 0]) < 1e-4]
    widths = np.linalg.norm(ends[:, 1:], axis=1)
    np.testing.assert_allclose(widths, ruler.data.bevel_depth, rtol=1e-3)


def test_a_figure_has_the_same_in_bolder_dark_letters_behind_it(model):
    ruler = _measured(model, (0, 0, 0), (3, 4, 0))
    (figure,) = ruler.children
    (casing,) = figure.children
    assert casing.data.body == figure.data.body == "5.00 mm"
    assert casing.data.bevel_depth > 0
    assert min(figure.data.materials[0].diffuse_color[:3]) > 0.9
    assert max(casing.data.materials[0].diffuse_color[:3]) < 0.1
    behind = figure.matrix_world.inverted() @ casing.matrix_world.translation
    assert behind.z + casing.data.bevel_depth < 0
    assert behind.xy.length < 1e-5


@pytest.mark.parametrize("scale", [(1, 1, 1), (-1, 1, 1), (-1, -1, -1)])
@pytest.mark.parametrize("flip", [False, True])
def test_figures_in_a_section_lie_as_its_picture_does(model, flip, scale):
    """Of a mirrored model, too."""
    model.scale = [side * unit for side, unit in zip(scale, model.scale, strict=True)]
    bpy.context.view_layer.update()
    plane = add_section_plane(model, bpy.context)
    plane.matrix_world = Matrix.LocRotScale((3, -2, 1), Matrix.Rotation(0.7, 3, (1, 2, 3)), None)
    bpy.context.scene.insideout.sections[0].flip = flip
    bpy.context.view_layer.update()
    in_model = model.matrix_world.inverted() @ plane.matrix_world
    (figure,) = _measured(model, *(in_model @ Vector(place) for place in ((0, 0, 0), (5, 3, 0)))).children
    turned = plane.matrix_world.to_3x3().inverted() @ figure.matrix_world.to_3x3()
    expected = Matrix.Diagonal((-1, 1, -1) if flip else (1, 1, 1))
    np.testing.assert_allclose(turned, expected, atol=1e-5)
    side = (plane.matrix_world.inverted() @ figure.children[0].matrix_world.translation).z
    assert side * (-1 if flip else 1) > 0, "above the picture"


def test_figures_that_cross_a_section_are_upright(model):
    plane = add_section_plane(model, bpy.context)
    plane.rotation_euler = (0.3, 0.2, 0.1)
    bpy.context.view_layer.update()
    assert shown_plane(bpy.context.scene) == plane
    (figure,) = _measured(model, (0, -5, 0), (3, 5, 4)).children
    np.testing.assert_allclose(figure.matrix_world.to_euler(), (np.pi / 2, 0, 0), atol=1e-5)


def test_nothing_of_a_line_stays_when_it_is_removed(model):
    before = {kind: len(getattr(bpy.data, kind)) for kind in ("objects", "curves")}
    ruler = _measured(model, (3, 0, 0), (0, 0, 0), (0, 4, 0))
    for point in [thing for thing in bpy.data.objects if thing.type == "EMPTY"]:
        bpy.data.objects.remove(point)
    remove_ruler(ruler)
    assert {kind: len(getattr(bpy.data, kind)) for kind in before} == before


def _below(parent):
    """A user's object, which has the data of its parent."""
    thing = bpy.data.objects.new("Mine", parent.data)
    bpy.context.scene.collection.objects.link(thing)
    thing.parent, thing.location = parent, (1, 2, 3)
    return thing


@pytest.mark.parametrize("tagged", [True, False])
def test_what_a_user_parented_to_a_line_stays_where_it_is(model, tagged):
    """Also in older files, whose parts are known by their names alone."""
    model.rotation_euler, model.scale = (0.4, 0.1, 0.3), (2, 2, 2)
    points = [add_point(model, place, bpy.context) for place in ((0, 0, 0), (3, 4, 0))]
    ruler, _ = add_ruler(model, points, bpy.context)
    ruler.location, ruler.rotation_euler = (1, 0, 2), (0.5, 0, 0)
    (figure,) = ruler.children
    (casing,) = figure.children
    for part in () if tagged else (figure, casing):
        del part["insideout_part"]
    points[0].parent = ruler
    mine = [_below(ruler), _below(figure), _below(casing), points[0]]
    bpy.context.view_layer.update()
    places = [thing.matrix_world.copy() for thing in mine]

    def are_there(parent):
        bpy.context.view_layer.update()
        assert [thing.parent for thing in mine] == [parent] * 4
        np.testing.assert_allclose([thing.matrix_world for thing in mine], places, rtol=1e-5, atol=1e-5)
        assert [thing.type for thing in mine] == ["CURVE", "FONT", "FONT", "EMPTY"]

    measure = remeasure(ruler, bpy.context)
    assert measure.length == pytest.approx(5)
    are_there(ruler)
    again, _ = add_ruler(model, points, bpy.context)
    are_there(again)
    remove_ruler(again)
    are_there(model)


def test_what_a_user_parented_to_the_end_of_a_line_stays_where_it_is(model):
    """No other line has that vertex."""
    ruler = _measured(model, (0, 0, 0), (3, 4, 0))
    mine = _below(ruler)
    mine.parent_type = "VERTEX"
    bpy.context.view_layer.update()
    place = mine.matrix_world.copy()
    remove_ruler(ruler)
    bpy.context.view_layer.update()
    assert mine.parent is None
    np.testing.assert_allclose(mine.matrix_world, place, rtol=1e-5, atol=1e-5)


def test_a_line_of_an_older_file_is_measured_again(model):
    """There all points of a polygon are in one spline."""
    ruler = _measured(model, (3, 0, 0), (0, 0, 0), (0, 4, 0))
    ruler.data.splines.clear()
    spline = ruler.data.splines.new("POLY")
    spline.points.add(2)
    spline.use_cyclic_u = True
    for point, place in zip(spline.points, ((3, 0, 0), (0, 0, 0), (0, 4, 0)), strict=True):
        point.co = (*place, 1)
    ruler.scale = (2, 2, 2)
    measure = remeasure(ruler, bpy.context)
    assert measure.area == pytest.approx(24.0, rel=1e-5)
    assert sorted(label.data.body for label in ruler.children) == ["24.00 mm²", "90.0°"]
