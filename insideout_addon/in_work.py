"""What is in work step by step: operators of ours in a window, and the import that a timer makes after a run."""

from __future__ import annotations

from collections.abc import Callable

import bpy

# Timers that bring a model into a scene and do not wait for anything now.
_importing: list[Callable[[], float | None]] = []


def works_in_steps() -> bool:
    """Whether an operator of ours has done some of its steps and not all, in whichever window."""
    return any(getattr(running, "in_work", False) for running in modal_operators())


def modal_operators() -> list[bpy.types.Operator]:
    """Those that run now, and those whose file browser is open."""
    return [operator for window in bpy.context.window_manager.windows for operator in window.modal_operators]


def is_importing() -> bool:
    """Whether a timer brings a model into a scene, step by step; not while it waits for the user."""
    # Blender drops timers that raise, and all where another file is opened.
    return any(bpy.app.timers.is_registered(timer) for timer in _importing)


def note_import(timer: Callable[[], float | None], goes_on: bool) -> None:
    """A timer says that its import goes on, or that it waits or has ended."""
    _importing[:] = [other for other in _importing if other is not timer and bpy.app.timers.is_registered(other)]
    if goes_on:
        _importing.append(timer)
