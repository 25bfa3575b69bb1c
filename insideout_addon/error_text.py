"""What an error says to the user."""

from __future__ import annotations

import errno
from collections.abc import Mapping
from typing import Any

from bpy.app.translations import pgettext_rpt as rpt_

from ..core.errors import InsideOutError
from .told_text import displayable, told_text

# Windows calls it ERROR_FILENAME_EXCED_RANGE.
_TOO_LONG = 206


def error_text(error: Exception) -> str:
    """The sentence of an error, of this add-on or of the core, in Blender's language where there is a translation.

    An error is translated here, where it is shown, and not where it is made: that may be another thread, where Blender
    translates nothing, or a module without bpy.
    """
    return told_text(error.told(), error) if isinstance(error, InsideOutError) else displayable(error)


def told_error_text(message: Mapping[str, Any]) -> str:
    """As `error_text`, of an error that the engine told."""
    return told_text(message.get("told"), message.get("message"))


def sentence(error: Exception) -> str:
    """An error as a sentence for the user, without the numbers and temporary names of the system's own."""
    path = (error.filename2 or error.filename) if isinstance(error, OSError) else None
    # Each system has words of its own for it.
    too_long = getattr(error, "errno", None) == errno.ENAMETOOLONG or getattr(error, "winerror", None) == _TOO_LONG
    if path and too_long:
        told = rpt_("{path}: file name too long; choose another file or folder.")
        return displayable(told.format(path=path))
    if path and error.strerror:
        told = rpt_("{path}: {reason}; choose another file or folder.")
        return displayable(told.format(path=path, reason=error.strerror.lower()))
    if isinstance(error, OSError) and error.strerror:
        # The system does not say of which file: it was open already.
        told = rpt_("The file cannot be used: {reason}; choose another file or folder.")
        return told.format(reason=error.strerror.lower())
    return error_text(error)
