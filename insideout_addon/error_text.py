"""What an error says to the user."""

from __future__ import annotations

from bpy.app.translations import pgettext_rpt as rpt_

from ..core.errors import InsideOutError


def error_text(error: Exception) -> str:
    """The sentence of an error: in Blender's language where this add-on made it, in English where the core did.

    An error is translated here, where it is shown, and not where it is made: that may be another thread, where Blender
    translates nothing, or a module without bpy.
    """
    if not isinstance(error, InsideOutError):
        return str(error)
    return rpt_(error.template).format(**error.values) if error.values else rpt_(error.template)
