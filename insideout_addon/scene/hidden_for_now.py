"""What is hidden with a model that is in pieces: on each object is noted, in the file too, how it was before."""

from __future__ import annotations

from collections.abc import Iterable

import bpy

# On what is hidden: whether it was before, in the viewport and in renderings.
HIDDEN_KEY = "insideout_hidden_by_break"


def is_hidden_for_now(thing: bpy.types.Object) -> bool:
    """Whether `show_as_before` has something to do."""
    return HIDDEN_KEY in thing


def hide_for_now(things: Iterable[bpy.types.Object]) -> None:
    """Hides objects until `show_as_before`; those that are linked from another file stay as they are there."""
    for thing in things:
        if thing.is_editable and HIDDEN_KEY not in thing:
            thing[HIDDEN_KEY] = [thing.hide_viewport, thing.hide_render]
            thing.hide_viewport = thing.hide_render = True


def show_as_before(things: Iterable[bpy.types.Object]) -> None:
    """Undoes `hide_for_now`: what was hidden before stays hidden."""
    for thing in things:
        if HIDDEN_KEY in thing:
            thing.hide_viewport, thing.hide_render = (bool(hidden) for hidden in thing[HIDDEN_KEY])
            del thing[HIDDEN_KEY]


def set_hidden(thing: bpy.types.Object, *, viewport: bool | None = None, render: bool) -> None:
    """Hides or shows an object; one that is hidden for now will be so when it is shown as before.

    Args:
        viewport: None leaves it as it is there.
    """
    if HIDDEN_KEY in thing:
        before = bool(thing[HIDDEN_KEY][0])
        thing[HIDDEN_KEY] = [before if viewport is None else viewport, render]
        return
    thing.hide_render = render
    if viewport is not None:
        thing.hide_viewport = viewport
