"""Duplicates of pieces and bodies are the user's, in a file that is opened again, too."""

from __future__ import annotations

from typing import Any

import bpy
from bpy.app.handlers import persistent

from .world import free_copies


def attach() -> None:
    """Tells them apart whenever the file is saved from now on."""
    bpy.app.handlers.save_pre.append(_before_save)


def detach() -> None:
    """Ends it."""
    if _before_save in bpy.app.handlers.save_pre:
        bpy.app.handlers.save_pre.remove(_before_save)


@persistent
def _before_save(*_: Any) -> None:
    free_copies()
