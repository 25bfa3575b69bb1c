"""What an error says to the user."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from bpy.app.translations import pgettext_rpt as rpt_

from ..core.errors import InsideOutError


def error_text(error: Exception) -> str:
    """The sentence of an error, of this add-on or of the core, in Blender's language where there is a translation.

    An error is translated here, where it is shown, and not where it is made: that may be another thread, where Blender
    translates nothing, or a module without bpy.
    """
    return _filled_in(error.template, error.values) if isinstance(error, InsideOutError) else str(error)


def told_error_text(message: Mapping[str, Any]) -> str:
    """As `error_text`, of an error that the engine told.

    Its English sentence where an engine of before sent no template, or this one cannot be filled in.
    """
    template, values = message.get("template"), message.get("values")
    if isinstance(template, str) and isinstance(values, dict):
        # A translation's places are those of this version, the values another's; and JSON has no infinite numbers.
        with suppress(KeyError, IndexError, ValueError, TypeError, AttributeError, OverflowError, MemoryError):
            return _filled_in(template, values)
    return str(message.get("message") or "")


def _filled_in(template: str, values: Mapping[str, object]) -> str:
    return rpt_(template).format(**values) if values else rpt_(template)
