"""Wall thickness drawn into the scene: the contours as tubes in the colour of the thickness, with a legend in mm."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict

import bpy
import numpy as np
from mathutils import Matrix

from ...core.affine import Affine
from ...core.colormap import COLOR_MAPS
from ...core.srgb import srgb_to_linear
from ...core.views import Plane
from ..scene.following import bends_alike, taken_away
from ..scene.section import SIZE_KEY, plane_position, shown_plane, shown_planes
from ..scene.section_image import Contour, Window, size_mm, ticks
from ..scene.section_position import Position
from ..scene.splats import some_splats
from .drawing import add_part, cased_text, parts_of, plain_object, remove_drawn, vertex_color_material
from .of_scene import Walls
from .thickness import ThicknessFigures

NAME = "InsideOut Thickness"
# On the map's object: each of `ThicknessFigures` after this.
FIGURE_KEY = "insideout_thickness_"
# Where and of what they are: the plane's `Position` (mm, normal, size), the setting Contour, the splats' `some_splats`.
_POSITION_KEY, _LEVEL_KEY, _SPLATS_KEY = "insideout_position", "insideout_level", "insideout_splats"
# Where a soft body had taken these, mm, three numbers each.
_BENT_KEY = "insideout_bent"
# Planes that differ by less are the same: cosines, and parts of the plane's size.
_SAME_WAY, _SAME_PLACE = 1e-4, 1e-5
# Soft bodies that are this near are bent alike, in parts of the plane's size: a simulation is not the same each time.
_SAME_BENDING = 1e-4
# Splats are where a transform has taken them, to rounding, in parts of how far they are from the origin.
_ROUNDING = 1e-6
# Of splats that are not those that were measured: `some_splats` never begin so.
_OTHERS = [-1.0]
# On its vertices.
VALUE, COLOR = "thickness_mm", "thickness_color"
# Thin is bright.
THIN_TO_THICK = COLOR_MAPS["viridis"][::-1]
_NO_WALL = np.array([0.45, 0.45, 0.45])
_CORNERS = 6
# In parts of the section's longer side.
_TUBE, _GAP, _WIDTH, _HEIGHT, _LETTERS = 0.0035, 0.09, 0.025, 0.45, 0.03
_LEGEND_STEPS = 64


def thickness_colors(thickness: np.ndarray, low: float, high: float) -> np.ndarray:
    """(..., 3) sRGB 0..1 of thicknesses (...,): thin is bright, thick is dark, what has no wall behind it grey."""
    place = np.clip((thickness - low) / max(high - low, 1e-12), 0, 1) * (len(THIN_TO_THICK) - 1)
    steps = np.arange(len(THIN_TO_THICK))
    known = np.isfinite(place)[..., None]
    colors = np.stack([np.interp(np.nan_to_num(place), steps, THIN_TO_THICK[:, c]) for c in range(3)], axis=-1)
    return np.where(known, colors, _NO_WALL)


def create_thickness_map(walls: Walls, model: bpy.types.Object, context: bpy.types.Context) -> bpy.types.Object:
    """A mesh that goes with the model, with its legend; the one of an earlier call is replaced.

    Colours span from the least thickness to the 95th percentile, or to the most where that is near.
    """
    contours, figures, plane = walls.contours, walls.figures, walls.plane
    before = thickness_maps(context.scene, model)
    low, high = color_span(figures)
    size = max(size_mm(plane))
    normal = -plane.normal
    tubes = [
        _tube(contour.model_mm, contour.area_mm2 > 0, normal, _TUBE * size, line)
        for contour, line in zip(contours, walls.thickness, strict=True)
    ]
    drawn = plain_object(NAME, _mesh(tubes, low, high), model, context)
    for name, value in asdict(figures).items():
        drawn[FIGURE_KEY + name] = value
    drawn[_LEVEL_KEY] = walls.level
    _keep_place(drawn, Position.of(plane))
    drawn[_SPLATS_KEY] = some_splats(model)
    drawn[_BENT_KEY] = taken_away(model).ravel().tolist()
    _add_legend(drawn, contours, plane, figures, context)
    # Not before the new one is there: where it cannot be made the old one stays.
    for other in before:
        name = other.name
        remove_thickness_map(other, drawn)
        drawn.name = name
    return drawn


def color_span(figures: ThicknessFigures) -> tuple[float, float]:
    """Thicknesses, mm, shown brightest and darkest."""
    low, high = figures.least_mm, figures.p95_mm
    if figures.most_mm < 1.5 * high:
        high = figures.most_mm
    # Walls of one thickness get one colour, not the noise of the last digit.
    return low, max(high, 1.02 * low)


def _legend_ticks(figures: ThicknessFigures) -> list[tuple[float, str]]:
    """As `ticks`; where thicker walls have the darkest colour too, its text says so. None is thinner than the least."""
    low, high = color_span(figures)
    *below, (place, text) = ticks(Window(low, high))
    return [*below, (place, f"≥ {text}" if figures.most_mm > high else text)]


def thickness_maps(scene: bpy.types.Scene, model: bpy.types.Object | None = None) -> list[bpy.types.Object]:
    """The maps of a scene, or those of one of its models."""
    maps = [thing for thing in scene.objects if FIGURE_KEY + "least_mm" in thing]
    return maps if model is None else [drawn for drawn in maps if drawn.parent == model]


def measured_at(drawn: bpy.types.Object) -> Position | None:
    """Where the plane was whose walls a map shows; None of maps in older files."""
    if _POSITION_KEY not in drawn:
        return None
    mm, *normal, size = drawn[_POSITION_KEY]
    normal = np.array(normal)
    return Position.through(mm * normal, normal, size)


def is_out_of_date(drawn: bpy.types.Object, scene: bpy.types.Scene) -> bool:
    """Whether the scene's plane, Contour or the splats have changed since, or a soft body bends otherwise.

    Of maps in older files it is not known.
    """
    then, plane = measured_at(drawn), shown_plane(scene)
    if then is None or plane is None:
        return False
    now = next(plane_position(section) for section in shown_planes(scene) if section.object == plane)
    if now is None or not math.isclose(drawn[_LEVEL_KEY], scene.insideout.level, rel_tol=1e-6):
        return True
    same_place = abs(now.mm - then.mm) <= _SAME_PLACE * (float(plane[SIZE_KEY]) + abs(now.mm))
    return not (
        same_place
        and np.allclose(now.normal, then.normal, atol=_SAME_WAY)
        and np.array_equal(drawn[_SPLATS_KEY], some_splats(drawn.parent), equal_nan=True)
        # Maps in older files kept nothing of how a soft body was bent.
        and (_BENT_KEY not in drawn or bends_alike(drawn.parent, drawn[_BENT_KEY], _SAME_BENDING * then.size))
    )


def move_figures(drawn: bpy.types.Object, moved: Affine) -> None:
    """Lets a map's figures be of where its model's splats have been moved and turned to.

    A map that was out of date before stays so.
    """
    thinnest, then = f"{FIGURE_KEY}thinnest_mm", measured_at(drawn)
    drawn[thinnest] = moved.apply(np.array(drawn[thinnest])).tolist()
    if then is not None:
        place, normal = moved.apply(then.mm * then.normal), moved.polar()[0] @ then.normal
        _keep_place(drawn, Position.through(place, normal, then.size))
        now = some_splats(drawn.parent)
        drawn[_SPLATS_KEY] = now if _are_moved(drawn[_SPLATS_KEY], now, moved) else _OTHERS


def _keep_place(drawn: bpy.types.Object, position: Position) -> None:
    drawn[_POSITION_KEY] = [position.mm, *position.normal.tolist(), position.size]


def _are_moved(before: Sequence[float], now: Sequence[float], moved: Affine) -> bool:
    """Whether `some_splats` are the same, before and after all were moved."""
    if len(before) != len(now) or before[0] != now[0]:
        return False
    then, here = (np.array(each[1:], np.float64).reshape(-1, 4) for each in (before, now))
    expected = moved.apply(then[:, :3])
    most = _ROUNDING * (np.linalg.norm(expected, axis=1) + np.linalg.norm(moved.translation))
    places = np.isclose(here[:, :3], expected, rtol=0.0, atol=most[:, None], equal_nan=True)
    return bool(places.all() and np.allclose(here[:, 3], then[:, 3], atol=0.0, equal_nan=True))


def shown_figures(drawn: bpy.types.Object) -> ThicknessFigures:
    """The figures of a map."""
    values = {name: drawn[FIGURE_KEY + name] for name in ThicknessFigures.__dataclass_fields__}
    return ThicknessFigures(**{**values, "thinnest_mm": tuple(values["thinnest_mm"])})


def remove_thickness_map(drawn: bpy.types.Object, heir: bpy.types.Object | None = None) -> None:
    """Deletes a map with its legend.

    Args:
        heir: what takes its place, in the model's frame, and gets what a user has parented to it; the model if None.
    """
    remove_drawn([*parts_of(drawn), drawn], heir or drawn.parent)


_Tube = tuple[np.ndarray, np.ndarray, np.ndarray]


def _tube(line: np.ndarray, closed: bool, normal: np.ndarray, radius: float, thickness: np.ndarray) -> _Tube:
    """Vertices (n·6, 3), faces (m, 4) and thickness of each vertex of a tube along a line (n, 3) in a plane."""
    if closed:
        line, thickness = line[:-1], thickness[:-1]
    count = len(line)
    before, after = np.roll(line, 1, axis=0), np.roll(line, -1, axis=0)
    if not closed:
        before[0], after[-1] = line[0], line[-1]
    along = after - before
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    aside = np.cross(normal, along)
    angles = np.arange(_CORNERS) * (2 * np.pi / _CORNERS)
    around = np.cos(angles)[:, None] * normal + np.sin(angles)[:, None] * aside[:, None, :]
    vertices = (line[:, None, :] + radius * around).reshape(-1, 3)
    first = np.arange(count if closed else count - 1)[:, None]
    corner, next_corner = np.arange(_CORNERS), (np.arange(_CORNERS) + 1) % _CORNERS
    here, there = first * _CORNERS, (first + 1) % count * _CORNERS
    faces = np.stack([here + corner, here + next_corner, there + next_corner, there + corner], axis=-1).reshape(-1, 4)
    return vertices, faces, np.repeat(thickness, _CORNERS)


def _mesh(tubes: Sequence[_Tube], low: float, high: float) -> bpy.types.Mesh:
    starts = np.cumsum([0, *(len(vertices) for vertices, _, _ in tubes)])
    vertices = np.concatenate([part for part, _, _ in tubes])
    faces = np.concatenate([part + start for (_, part, _), start in zip(tubes, starts[:-1], strict=True)])
    thickness = np.concatenate([part for _, _, part in tubes])
    mesh = bpy.data.meshes.new(NAME)
    mesh.from_pydata(vertices.tolist(), [], faces.tolist())
    _color(mesh, thickness_colors(thickness, low, high))
    # Blender shows what is no number as 0 too.
    mesh.attributes.new(VALUE, "FLOAT", "POINT").data.foreach_set("value", np.nan_to_num(thickness).astype(np.float32))
    return mesh


def _color(mesh: bpy.types.Mesh, srgb: np.ndarray) -> None:
    rgba = np.column_stack([srgb_to_linear(srgb), np.ones(len(srgb))])
    mesh.attributes.new(COLOR, "FLOAT_COLOR", "POINT").data.foreach_set("color", rgba.astype(np.float32).ravel())
    mesh.materials.append(vertex_color_material(NAME, COLOR))


def _add_legend(
    drawn: bpy.types.Object,
    contours: Sequence[Contour],
    plane: Plane,
    figures: ThicknessFigures,
    context: bpy.types.Context,
) -> None:
    """A strip with numbers left of the contours, for the section's own colour bar is on their right."""
    points = np.concatenate([contour.section_mm for contour in contours])
    size = max(size_mm(plane))
    u, v = (np.asarray(way, np.float64) / np.linalg.norm(way) for way in (plane.u, plane.v))
    middle = 0.5 * (points[:, 1].min() + points[:, 1].max())
    left, bottom = points[:, 0].min() - (_GAP + _WIDTH) * size, middle + 0.5 * _HEIGHT * size
    corner = np.asarray(plane.origin, np.float64) + left * u + bottom * v
    place = np.eye(4)
    place[:3] = np.column_stack([u, -v, np.cross(u, -v), corner])
    frame = Matrix(place.tolist())
    add_part(f"{NAME} Legend", _strip(size, *color_span(figures)), drawn, frame, context)
    texts = [(part * _HEIGHT, text) for part, text in _legend_ticks(figures)]
    for up, text in [*texts, (_HEIGHT + 1.6 * _LETTERS, "mm")]:
        letters = bpy.data.curves.new(f"{NAME} Legend", "FONT")
        letters.body, letters.size, letters.align_x, letters.align_y = text, _LETTERS * size, "RIGHT", "CENTER"
        # Above the section's picture, with what is dark behind it.
        beside = Matrix.Translation((-0.4 * _LETTERS * size, up * size, 0.25 * _LETTERS * size))
        cased_text(f"{NAME} Legend", letters, drawn, frame @ beside, context)


def _strip(size: float, low: float, high: float) -> bpy.types.Mesh:
    """Thin at the bottom, thick on top."""
    heights = np.linspace(0.0, _HEIGHT * size, _LEGEND_STEPS)
    vertices = [(x, y, 0.0) for y in heights for x in (0.0, _WIDTH * size)]
    faces = [(2 * i, 2 * i + 1, 2 * i + 3, 2 * i + 2) for i in range(_LEGEND_STEPS - 1)]
    mesh = bpy.data.meshes.new(f"{NAME} Legend")
    mesh.from_pydata(vertices, [], faces)
    shades = np.repeat(np.linspace(low, high, _LEGEND_STEPS), 2)
    _color(mesh, thickness_colors(shades, low, high))
    return mesh
