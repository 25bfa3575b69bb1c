"""What an error says to the user."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..core.errors import InsideOutError
from .told_text import told_text


def error_text(error: Exception) -> str:
    """The sentence of an error, of this add-on or of the core, in Blender's language where there is a translation.

    An error is translated here, where it is shown, and not where it is made: that may be another thread, where Blender
    translates nothing, or a module without bpy.
    """
    return told_text(error.told(), error) if isinstance(error, InsideOutError) else str(error)


def told_error_text(message: Mapping[str, Any]) -> str:
    """As `error_text`, of an error that the engine told."""
    return told_text(message.get("told"), message.get("message"))
