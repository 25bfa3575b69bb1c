"""Where new objects come."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress

import bpy


def open_collection(context: bpy.types.Context) -> bpy.types.Collection:
    """The active collection; the scene's own where that one is linked from another file, and takes nothing."""
    active = context.collection
    return context.scene.collection if active.library is not None else active


def link(thing: bpy.types.Object, context: bpy.types.Context) -> None:
    """Puts an object where the user's new ones come: with Local View on it is seen there, too, as what Blender adds."""
    open_collection(context).objects.link(thing)
    space = context.space_data
    if isinstance(space, bpy.types.SpaceView3D) and space.local_view is not None:
        _show(thing, space)


def show_where(thing: bpy.types.Object, other: bpy.types.Object) -> None:
    """Shows an object in the local views that another is in."""
    for space in _local_views():
        # Before Blender 5.0 only what is evaluated tells.
        shown = other.evaluated_get(bpy.context.evaluated_depsgraph_get())
        with suppress(RuntimeError):
            if shown.local_view_get(space):
                _show(thing, space)


def _show(thing: bpy.types.Object, space: bpy.types.SpaceView3D) -> None:
    # Not where it is in a collection that the view layer excludes.
    with suppress(RuntimeError):
        thing.local_view_set(space, True)


def _local_views() -> Iterator[bpy.types.SpaceView3D]:
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            space = area.spaces.active
            if isinstance(space, bpy.types.SpaceView3D) and space.local_view is not None:
                yield space
