"""What was measured of a model and drawn into the scene, all together."""

from __future__ import annotations

import bpy

from ..scene.contour_files import NAME as CONTOURS
from ..scene.weighing import is_center_marker
from .drawing import parts_of
from .rulers import TEXT_KEY, is_point
from .thickness_map import FIGURE_KEY

_OURS = "InsideOut"


def marks_on(model: bpy.types.Object) -> list[bpy.types.Object]:
    """A model's points, lines, maps of wall thickness, contours and centre of mass, with their lettering.

    What else a user has parented to the model, or to one of them, is the user's.
    """
    marks = [child for child in model.children if _is_mark(child)]
    return [*marks, *(part for mark in marks for part in _parts(mark))]


def _parts(mark: bpy.types.Object) -> list[bpy.types.Object]:
    """Those of older files are known by their names."""
    known = parts_of(mark)
    return [part for part in mark.children_recursive if part in known or part.name.startswith(_OURS)]


def _is_mark(thing: bpy.types.Object) -> bool:
    drawn = TEXT_KEY in thing or f"{FIGURE_KEY}least_mm" in thing or thing.name.startswith(CONTOURS)
    return drawn or is_point(thing) or is_center_marker(thing)
