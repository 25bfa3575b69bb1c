"""What other sections hide of a plane's picture, so that it ends where the model does."""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix

from ...core.views import Plane
from .section import shown_sections
from .splats import shown_model
from .standing import place_in_world


def other_cuts(scene: bpy.types.Scene, section: bpy.types.PropertyGroup) -> list[bpy.types.PropertyGroup]:
    """The other sections that cut the model: they hide a part of a section's picture, or pull it apart."""
    return [other for other in shown_sections(scene) if other.object != section.object and other.cut]


def place_in_model(
    section: bpy.types.PropertyGroup, model: bpy.types.Object, depsgraph: bpy.types.Depsgraph | None
) -> Matrix:
    """From the frame of a section's plane or box to that of the model (mm).

    Args:
        depsgraph: whose places count, while one is rendered; else what the viewport shows.
    """
    things = (section.object, model)
    moved, still = things if depsgraph is None else (thing.evaluated_get(depsgraph) for thing in things)
    return place_in_world(still).inverted_safe() @ place_in_world(moved)


def face_normal(matrix: np.ndarray, axis: int) -> np.ndarray:
    """(3,) the unit normal of a section's face across one of its axes, on the side where the axis points.

    Args:
        matrix: as `place_in_model` has it; where the model is scaled unevenly its axes are not at right angles.
    """
    normal = np.cross(matrix[:3, (axis + 1) % 3], matrix[:3, (axis + 2) % 3])
    normal *= -1 if normal @ matrix[:3, axis] < 0 else 1
    return normal / max(np.linalg.norm(normal), 1e-300)


def hidden_pixels(
    scene: bpy.types.Scene,
    section: bpy.types.PropertyGroup,
    view: Plane,
    depsgraph: bpy.types.Depsgraph | None = None,
) -> np.ndarray:
    """(height, width) bool: where on a plane other sections hide the model.

    Args:
        view: the plane's pixels in the model's frame (mm).
        depsgraph: as in `place_in_model`.
    """
    model = shown_model(scene)
    hidden = np.zeros((view.height, view.width), bool)
    for other in other_cuts(scene, section):
        matrix = np.array(place_in_model(other, model, depsgraph), np.float64)
        hide = _outside_box if other.shape == "BOX" else _beyond_plane
        hidden |= hide(other, matrix, view)
    return hidden


def _beyond_plane(section: bpy.types.PropertyGroup, matrix: np.ndarray, view: Plane) -> np.ndarray:
    distance = _along(face_normal(matrix, 2), matrix[:3, 3], view) * (-1 if section.flip else 1)
    # A plane that pulls the model apart shows both sides.
    hidden = (distance > 0) & (section.apart_mm == 0)
    if section.slab_mm > 0:
        hidden |= distance < -section.slab_mm
    return hidden


def _outside_box(section: bpy.types.PropertyGroup, matrix: np.ndarray, view: Plane) -> np.ndarray:
    inside = np.ones((view.height, view.width), bool)
    for axis in range(3):
        normal = face_normal(matrix, axis)
        inside &= np.abs(_along(normal, matrix[:3, 3], view)) <= abs(normal @ matrix[:3, axis])
    return inside if section.flip else ~inside


def _along(direction: np.ndarray, origin: np.ndarray, view: Plane) -> np.ndarray:
    """(height, width) of (pixel's centre - origin) · direction, without making the centres."""
    columns = (np.arange(view.width) + 0.5) * (np.asarray(view.u, np.float64) @ direction)
    rows = (np.arange(view.height) + 0.5) * (np.asarray(view.v, np.float64) @ direction)
    return (np.asarray(view.origin, np.float64) - origin) @ direction + rows[:, None] + columns
