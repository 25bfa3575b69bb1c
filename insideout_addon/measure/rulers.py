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
from ..scene.standing import place_in_world
from .drawing import cased_material, cased_text, parts_of, place_in_parent, plain_object, remove_drawn
from .points import Measure, measure_points

POINT, RULER = "InsideOut Point", "InsideOut Measure"
# On a point, which may get another name, and whose name another may get: its number; in older files it has none.
_POINT_KEY = "insideout_point"
# On a ruler: what it says, the names of its points a line each, and figures (mm, degrees, mm²) as far as it has them.
TEXT_KEY, POINTS_KEY = "insideout_measure", "insideout_points"
# And the numbers of its points, 0 of one without.
_NUMBERS_KEY = "insideout_point_numbers"
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
        return place_in_world(model).inverted() @ Vector(place)
    except ValueError as error:
        raise SettingError("{model} is scaled to nothing; give it a size again.", model=model.name) from error


def add_point(model: bpy.types.Object, place_mm: Sequence[float], context: bpy.types.Context) -> bpy.types.Object:
    """A point that goes with the model, at a place in its frame, mm."""
    size = _POINT_SIZE * model_extent(model)
    number = _next_number()
    point = plain_object(POINT, None, model, context)
    point.empty_display_type = "PLAIN_AXES"
    point.empty_display_size = size
    point.location = place_mm
    point.show_in_front = True
    point[_POINT_KEY] = number
    return point


def selected_points(context: bpy.types.Context) -> list[bpy.types.Object]:
    """The selected points in the order in which they were made; those of older files come first, by name."""
    return sorted(filter(is_point, context.selected_objects), key=lambda point: (_number(point), point.name))


def tell_copies_apart(scene: bpy.types.Scene) -> None:
    """Gives points that the user has made by duplicating others numbers of their own."""
    known: set[int] = set()
    # Copies are made after what they are of.
    for point in sorted(filter(is_point, scene.objects), key=lambda point: point.session_uid):
        if _number(point) in known and point.is_editable:
            point[_POINT_KEY] = _next_number()
        known |= {_number(point)} - {0}


def _number(point: bpy.types.Object) -> int:
    """0 of a point of an older file, which has True there."""
    number = point.get(_POINT_KEY)
    return number if type(number) is int else 0


def _next_number() -> int:
    """One that no point has, and none had of which something is still measured."""
    used = {0}
    for thing in bpy.data.objects:
        used |= {_number(thing), *thing.get(_NUMBERS_KEY, ())}
    return max(used) + 1


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
    places = np.array([place_in_model(model, place_in_world(point).translation) for point in points])
    measure = measure_points(places)
    before = [ruler for ruler in rulers(context.scene, model) if _is_of(ruler, points)]
    ruler = plain_object(RULER, bpy.data.curves.new(RULER, "CURVE"), model, context)
    ruler[POINTS_KEY] = "\n".join(point.name for point in points)
    ruler[_NUMBERS_KEY] = [_number(point) for point in points]
    try:
        _write(ruler, measure, places, context)
    except BaseException:
        remove_ruler(ruler)
        raise
    # Not before the new one is there: where it cannot be made the old one stays.
    for other in before:
        name = other.name
        remove_ruler(other, ruler)
        ruler.name = name
    return ruler, measure


def remeasure(ruler: bpy.types.Object, context: bpy.types.Context) -> Measure:
    """Measures a line anew where it is in its model, whose frame is another one after a transform was applied."""
    frame = place_in_parent(ruler)
    places = _corners(ruler.data) @ np.array(frame, np.float64)[:3].T
    measure = measure_points(places)
    remove_drawn(parts_of(ruler), ruler)
    ruler.matrix_parent_inverse.identity()
    ruler.matrix_basis.identity()
    for child in ruler.children:
        # The user's; it stays where it is.
        child.matrix_parent_inverse = frame @ child.matrix_parent_inverse
    with context.temp_override(collection=ruler.users_collection[0]):
        _write(ruler, measure, places, bpy.context)
    if is_hidden_for_now(ruler):
        hide_for_now(parts_of(ruler))
    return measure


def rulers(scene: bpy.types.Scene, model: bpy.types.Object | None = None) -> list[bpy.types.Object]:
    """What was measured in a scene, by name, or that of one of its models."""
    found = [thing for thing in scene.objects if TEXT_KEY in thing]
    return found if model is None else [ruler for ruler in found if ruler.parent == model]


def is_measured(points: Sequence[bpy.types.Object], scene: bpy.types.Scene) -> bool:
    """Whether these points, and no others, have been measured together."""
    return any(_is_of(ruler, points) for ruler in rulers(scene))


def _is_of(ruler: bpy.types.Object, points: Sequence[bpy.types.Object]) -> bool:
    """Whether a ruler is of these points, in this order; points without a number are known by their names."""
    names = ruler[POINTS_KEY].split("\n")
    known = zip(ruler.get(_NUMBERS_KEY, [0] * len(names)), names, strict=False)
    return [number or name for number, name in known] == [_number(point) or point.name for point in points]


def remove_ruler(ruler: bpy.types.Object, heir: bpy.types.Object | None = None) -> None:
    """Deletes a line and its figure.

    Args:
        heir: what takes its place, in the model's frame, and gets what a user has parented to it; the model if None.
    """
    remove_drawn([*parts_of(ruler), ruler], heir or ruler.parent)


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
    frame = place_in_world(model)
    turn = (frame.to_quaternion().inverted() @ _upright(model, places, context)).to_matrix()
    if frame.is_negative:
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
    frame = place_in_world(model)
    in_world = np.column_stack([places, np.ones(len(places))]) @ np.array(frame).T
    # Of a mirrored model scales are negative.
    near = _IN_PLANE * model_extent(model) * max(map(abs, frame.to_scale()))
    for section in shown_planes(context.scene):
        plane = place_in_world(section.object)
        normal = np.array(plane.col[2].xyz.normalized())
        if np.abs((in_world[:, :3] - np.array(plane.translation)) @ normal).max() < near:
            turn = plane.to_quaternion()
            # From the other side right is left.
            return turn @ _AROUND if section.flip else turn
    view = getattr(context, "region_data", None)
    return _FRONT if view is None else view.view_rotation
