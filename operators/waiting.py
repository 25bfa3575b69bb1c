"""Blender's progress cursor while something takes long."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import bpy


@contextmanager
def waiting(context: bpy.types.Context) -> Iterator[Callable[[float], None]]:
    """A function to call with the share that is done, 0 to 1."""
    manager = context.window_manager
    manager.progress_begin(0.0, 1.0)
    try:
        yield manager.progress_update
    finally:
        manager.progress_end()
