"""Where new objects come."""

from __future__ import annotations

import bpy


def open_collection(context: bpy.types.Context) -> bpy.types.Collection:
    """The active collection; the scene's own where that one is of another file, linked or a library override, and takes
    nothing."""
    active = context.collection
    shut = active.library is not None or active.override_library is not None
    return context.scene.collection if shut else active
