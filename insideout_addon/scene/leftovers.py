"""Node groups and materials of ours that nothing uses: what is ended early leaves none of them behind."""

from __future__ import annotations

import bpy

_OURS = "InsideOut"


def known_looks() -> set[int]:
    """Those of the whole file, by their `session_uid`."""
    return {block.session_uid for block in _looks()}


def remove_unused_looks(before: set[int], names: tuple[str, ...] = (_OURS,)) -> None:
    """Takes away those that nothing uses and that were not there before.

    Args:
        names: that theirs begin with one of.
    """
    # Groups use each other.
    while unused := [block for block in _looks(names) if block.users == 0 and block.session_uid not in before]:
        bpy.data.batch_remove(unused)


def _looks(names: tuple[str, ...] = (_OURS,)) -> list[bpy.types.ID]:
    """What models are shown by; what the user makes in a break is not among it."""
    blocks = (*bpy.data.node_groups, *bpy.data.materials)
    return [block for block in blocks if block.name.startswith(names) and block.library is None]
