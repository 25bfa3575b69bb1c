"""Whether splats may have been edited while an operator read them step by step."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import bpy


@contextmanager
def watched(data: bpy.types.PointCloud) -> Iterator[Callable[[], bool]]:
    """A function that says whether `data` may have been edited since, in whichever window.

    Blender also says so where a modifier of its object has changed, or another object shows it; not where one moves.
    """
    # By identity, for an undo may take the splats themselves away.
    identity, edited = data.session_uid, False

    def note(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
        nonlocal edited
        changed = [update.id for update in depsgraph.updates if update.is_updated_geometry]
        clouds = [thing for thing in changed if isinstance(thing, bpy.types.PointCloud)]
        edited = edited or any(cloud.original.session_uid == identity for cloud in clouds)

    handlers = bpy.app.handlers.depsgraph_update_post
    handlers.append(note)
    try:
        yield lambda: edited
    finally:
        # Another file has none of ours.
        with suppress(ValueError):
            handlers.remove(note)
