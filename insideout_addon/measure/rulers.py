"""Points that the user places, and what they measure drawn into the scene as a line with its figure."""

from __future__ import annotations

import math
from collections.abc import Sequence

import bpy
import numpy as np
from mathutils import Euler, Matrix, Quaternion, Vector

from ...core.errors import SettingError
from ..scene.hidden_for_now import hide_for_now, is_hidden_for_now
from ..scene.importing import lengths_are_arbitrary
from ..scene.section import model_box, shown_planes
from ..scene.splats import is_splats, read_density
from .drawing import cased_material, cased_text, plain_object
from .points import Measure, measure_points

POINT, RULER = "InsideOut Point", "InsideOut Measure"
# On a point, which may get another name.
_POINT_KEY = "insideout_point"
# On a ruler: what it says, the names of its points a line each, and figures (mm, degrees, mm²) as far as it has them.
TEXT_KEY, POINTS_KEY = "insideout_measure", "insideout_points"
LENGTH_KEY, ANGLE_KEY, AREA_KEY = "insideout_length", "insideout_angle_deg", "insideout_area"
# In parts of the model's longest side.
_POINT_SIZE, _LINE, _LETTERS = 0.012, 0.005, 0.036
# How far from a section's plane points may be that lie in it, in the same parts.
_IN_PLANE = 0.01
_FRONT = Euler((math.pi / 2, 0.0, 0.0)).to_quaternion()
_AROUND = Euler((0.0, math.pi, 0.0)).to_quaternion()


def model_extent(model: bpy.types.Object) -> float:
    """The longest side of a model's box, mm."""
    box = model_box(read_density(model))
    return float((box[1] - box[0]).max())


def place_in_model(model: bpy.types.Object, place: Sequence[float]) -> Vector:
    """A place in the world in the model's frame, mm.

    Raises:
        SettingError: the model is scaled to nothing.
    """
    try:
        return model.matrix_world.inverted() @ Vector(place)
    except ValueError as error:
        raise SettingError("{model} is scaled to nothing; give it a size again.", model=model.name) from error


def add_point(model: bpy.types.Object, place_mm: Sequence[float], context: bpy.types.Context) -> bpy.types.Object:
    """A point that goes with the model, at a place in its frame, mm."""
    size = _POINT_SIZE * model_extent(model)
    point = plain_object(POINT, None, model, context)
    point.empty_display_type = "PLAIN_AXES"
    point.empty_display_size = size
    point.location = place_mm
    point.show_in_front = True
    point[_POINT_KEY] = True
    return point


def selected_points(context: bpy.types.Context) -> list[bpy.types.Object]:
    """The selected points by name: Blender numbers them in the order in which they are made. Other empties are none."""
    return sorted(filter(is_point, context.selected_objects), key=lambda thing: thing.name)


def measured_model(points: Sequence[bpy.types.Object], shown: bpy.types.Object) -> bpy.types.Object:
    """The model in whose frame points are measured: the one that they were put on, else the one that is shown.

    Raises:
        SettingError: they are of several models, and one of these has lengths in no unit.
    """
    models = list(dict.fromkeys(point.parent for point in points if is_splats(point.parent)))
    if len(models) == 1:
        return models[0]
    if any(map(lengths_are_arbitrary, models)):
        raise SettingError("The points are on several models, not all of them in mm; select points of one of them.")
    return shown


def is_point(thing: bpy.types.Object) -> bool:
    """Whether an object is a point to measure from."""
    # Those of older files are known by their names.
    return thing.type == "EMPTY" and (_POINT_KEY in thing or thing.name.startswith(POINT))


def add_ruler(
    model: bpy.types.Object, points: Sequence[bpy.types.Object], context: bpy.types.Context
) -> tuple[bpy.types.Object, Measure]:
    """Measures points in the model's frame and draws that; what the same points measured before is replaced.

    Raises:
        SettingError: fewer than two points, or the model is scaled to nothing.
    """
    context.view_layer.update()
    places = np.array([place_in_model(model, point.matrix_world.translation) for point in points])
    measure = measure_points(places)
    names = _names(points)
    before = [ruler for ruler in rulers(context.scene, model) if ruler[POINTS_KEY] == names]
    ruler = plain_object(RULER, bpy.data.curves.new(RULER, "CURVE"), model, context)
    ruler[POINTS_KEY] = names
    try:
        _write(ruler, measure, places, context)
    except BaseException:
        remove_ruler(ruler)
        raise
    # Not before the new one is there: where it cannot be made the old one stays.
    for other in before:
        name = other.name
        remove_ruler(other)
        ruler.name = name
    return ruler, measure


def remeasure(ruler: bpy.types.Object, context: bpy.types.Context) -> Measure:
    """Measures a line anew where it is in its model, whose frame is another one after a transform was applied."""
    frame = np.array(ruler.matrix_parent_inverse @ ruler.matrix_basis, np.float64)
    places = _corners(ruler.data) @ frame[:3].T
    measure = measure_points(places)
    ruler.matrix_parent_inverse.identity()
    ruler.matrix_basis.identity()
    _remove(ruler.children_recursive)
    with context.temp_override(collection=ruler.users_collection[0]):
        _write(ruler, measure, places, bpy.context)
    if is_hidden_for_now(ruler):
        hide_for_now(ruler.children_recursive)
    return measure


def rulers(scene: bpy.types.Scene, model: bpy.types.Object | None = None) -> list[bpy.types.Object]:
    """What was measured in a scene, by name, or that of one of its models."""
    found = [thing for thing in scene.objects if TEXT_KEY in thing]
    return found if model is None else [ruler for ruler in found if ruler.parent == model]


def is_measured(points: Sequence[bpy.types.Object], scene: bpy.types.Scene) -> bool:
    """Whether these points, and no others, have been measured together."""
    return any(ruler[POINTS_KEY] == _names(points) for ruler in rulers(scene))


def remove_ruler(ruler: bpy.types.Object) -> None:
    """Deletes a line and its figure."""
    _remove([*ruler.children_recursive, ruler])


def _remove(parts: Sequence[bpy.types.Object]) -> None:
    bpy.data.batch_remove([part.data for part in parts if part.data is not None])


def _names(points: Sequence[bpy.types.Object]) -> str:
    return "\n".join(point.name for point in points)


def _draw_line(curve: bpy.types.Curve, places: np.ndarray, radius: float) -> None:
    """Between two places a line; of more (n, 3) each side by itself: where lines bend Blender draws them thinner."""
    curve.dimensions, curve.use_fill_caps, curve.bevel_depth = "3D", True, radius
    curve.materials.clear()
    curve.materials.append(cased_material())
    curve.splines.clear()
    corners = np.column_stack([places, np.ones(len(places))])
    sides = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
    for side in sides[: 1 if len(places) == 2 else None]:
        spline = curve.splines.new("POLY")
        spline.points.add(1)
        spline.points.foreach_set("co", side.ravel())
        spline.use_smooth = True
    curve.update_tag()


def _corners(curve: bpy.types.Curve) -> np.ndarray:
    """(n, 4) the points of a ruler, homogeneous; older files have all of them in one spline."""
    several = len(curve.splines) > 1
    points = [spline.points[0] for spline in curve.splines] if several else curve.splines[0].points
    return np.array([point.co for point in points], np.float64)


def _write(ruler: bpy.types.Object, measure: Measure, places: np.ndarray, context: bpy.types.Context) -> None:
    """Gives a ruler its line through places (n, 3) in the model's frame, its figures and their labels."""
    model = ruler.parent
    extent, unit = model_extent(model), "" if lengths_are_arbitrary(model) else "mm"
    _draw_line(ruler.data, places, _LINE * extent)
    ruler[TEXT_KEY] = measure.text(unit)
    for key, figure in ((LENGTH_KEY, measure.length), (ANGLE_KEY, measure.angle_deg), (AREA_KEY, measure.area)):
        if figure is not None:
            ruler[key] = figure
    turn = (model.matrix_world.to_quaternion().inverted() @ _upright(model, places, context)).to_matrix()
    if model.matrix_world.is_negative:
        # Letters in a mirrored frame are mirrored themselves, to be read in the world.
        turn *= -1.0
    for place, text in measure.labels(places, unit):
        _add_label(ruler, place, text, _LETTERS * extent, turn, context)


def _add_label(
    ruler: bpy.types.Object, place: np.ndarray, text: str, size: float, turn: Matrix, context: bpy.types.Context
) -> None:
    """A figure beside a place, turned in the model's frame."""
    letters = bpy.data.curves.new(RULER, "FONT")
    letters.body = text
    letters.size = size
    beside = Vector((0.6, 0.3, 1.0)) * size
    cased_text(RULER, letters, ruler, Matrix.Translation(Vector(place) + turn @ beside) @ turn.to_4x4(), context)


def _upright(model: bpy.types.Object, places: np.ndarray, context: bpy.types.Context) -> Quaternion:
    """How lettering at places (n, 3) in the model's frame is turned in the world.

    In a section it lies as the section's picture does, for parts of what is not parallel would be under it. Else it is
    upright for who looks now, or from the front without a window.
    """
    in_world = np.column_stack([places, np.ones(len(places))]) @ np.array(model.matrix_world).T
    # Of a mirrored model scales are negative.
    near = _IN_PLANE * model_extent(model) * max(map(abs, model.matrix_world.to_scale()))
    for section in shown_planes(context.scene):
        normal = np.array(section.object.matrix_world.col[2].xyz.normalized())
        if np.abs((in_world[:, :3] - np.array(section.object.matrix_world.translation)) @ normal).max() < near:
            turn = section.object.matrix_world.to_quaternion()
            # From the other side right is left.
            return turn @ _AROUND if section.flip else turn
    view = getattr(context, "region_data", None)
    return _FRONT if view is None else view.view_rotation
