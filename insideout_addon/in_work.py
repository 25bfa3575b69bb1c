"""What is in work step by step: operators of ours in a window, and the import that a timer makes after a run."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import bpy

_imports: list[str] = []


def works_in_steps() -> bool:
    """Whether an operator of ours has done some of its steps and not all, in whichever window."""
    return any(getattr(running, "in_work", False) for running in modal_operators())


def modal_operators() -> list[bpy.types.Operator]:
    """Those that run now, and those whose file browser is open."""
    return [operator for window in bpy.context.window_manager.windows for operator in window.modal_operators]


def is_importing() -> bool:
    """Whether a timer brings a model into the scene, step by step."""
    return bool(_imports)


@contextmanager
def importing(name: str) -> Iterator[None]:
    """In here `is_importing`.

    Args:
        name: of what is imported.
    """
    _imports.append(name)
    try:
        yield
    finally:
        _imports.remove(name)
