"""Where a file goes that the user saves, and how a failure reads."""

from __future__ import annotations

import errno
from pathlib import Path

import bpy
from bpy.app.translations import pgettext_rpt as rpt_

from ..core.errors import RunFolderError
from ..insideout_addon.error_text import error_text

# A preset of other settings is not to write onto the file of another time.
FILE_PATH = bpy.props.StringProperty(
    name="File Path",
    description="Which file; // stands for the folder of the .blend",
    subtype="FILE_PATH",
    options={"PATH_SUPPORTS_BLEND_RELATIVE", "SKIP_PRESET"},
)


def chosen_file(filepath: str) -> Path:
    """The file that an operator's `filepath` means; "//" is the folder of the .blend.

    Raises:
        RunFolderError: it is a folder, or the .blend has none yet.
    """
    if filepath.startswith("//") and not bpy.data.filepath:
        raise RunFolderError("{path}: lies beside the .blend, which is not saved yet; save it first.", path=filepath)
    path = Path(bpy.path.abspath(filepath))
    if path.is_dir():
        raise RunFolderError("{path}: is a folder; give the file a name.", path=path)
    return path


# Windows calls it ERROR_FILENAME_EXCED_RANGE.
_TOO_LONG = 206


def sentence(error: Exception) -> str:
    """An error as a sentence for the user, without the numbers and temporary names of the system's own."""
    path = (error.filename2 or error.filename) if isinstance(error, OSError) else None
    # Each system has words of its own for it.
    too_long = getattr(error, "errno", None) == errno.ENAMETOOLONG or getattr(error, "winerror", None) == _TOO_LONG
    if path and too_long:
        return rpt_("{path}: file name too long; choose another file or folder.").format(path=path)
    if path and error.strerror:
        told = rpt_("{path}: {reason}; choose another file or folder.")
        return told.format(path=path, reason=error.strerror.lower())
    if isinstance(error, OSError) and error.strerror:
        # The system does not say of which file: it was open already.
        told = rpt_("The file cannot be used: {reason}; choose another file or folder.")
        return told.format(reason=error.strerror.lower())
    return error_text(error)
