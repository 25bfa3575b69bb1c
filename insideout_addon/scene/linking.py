"""Where new objects come."""

from __future__ import annotations

import bpy


def open_collection(context: bpy.types.Context) -> bpy.types.Collection:
    """The active collection; the scene's own where that one is linked from another file, and takes nothing."""
    active = context.collection
    return context.scene.collection if active.library is not None else active
