"""Where objects stand in the world, those that are hidden too."""

from __future__ import annotations

import bpy
from mathutils import Matrix


def place_in_world(thing: bpy.types.Object) -> Matrix:
    """(4, 4) from an object's own frame to the world's.

    Blender does not keep up `matrix_world` of what no window shows, as of the model and its planes while it is in
    pieces, and in a file that was opened anew it is that of the origin. What constraints or a bone place is known from
    there alone.

    Args:
        thing: as the viewport shows it, or as a depsgraph has it.
    """
    if _is_shown(thing.original) or thing.parent_type != "OBJECT" or thing.constraints:
        return thing.matrix_world.copy()
    if thing.parent is None:
        # What an earlier parent has left in the inverse does not count.
        return thing.matrix_basis.copy()
    return place_in_world(thing.parent) @ thing.matrix_parent_inverse @ thing.matrix_basis


def put_in_world(thing: bpy.types.Object, place: Matrix) -> None:
    """Moves an object to where `place_in_world` is `place`, but for shear, which no object has of its own."""
    parent = thing.parent
    if parent is None or _is_shown(parent) or thing.parent_type != "OBJECT":
        thing.matrix_world = place
    else:
        thing.matrix_basis = (place_in_world(parent) @ thing.matrix_parent_inverse).inverted_safe() @ place


def _is_shown(thing: bpy.types.Object) -> bool:
    """Whether a window shows an object, so that Blender keeps up where it is."""
    windows = bpy.context.window_manager.windows
    layers = {bpy.context.view_layer, *(window.view_layer for window in windows)}
    return any(thing.visible_get(view_layer=layer) for layer in layers)
