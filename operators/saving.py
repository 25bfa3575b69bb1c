"""Where a file goes that the user saves, and how a failure reads."""

from __future__ import annotations

import errno
from pathlib import Path

import bpy

from ..core.errors import RunFolderError

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
        raise RunFolderError(f"{filepath}: lies beside the .blend, which is not saved yet; save it first.")
    path = Path(bpy.path.abspath(filepath))
    if path.is_dir():
        raise RunFolderError(f"{path}: is a folder; give the file a name.")
    return path


# Windows calls it ERROR_FILENAME_EXCED_RANGE.
_TOO_LONG = 206


def sentence(error: Exception) -> str:
    """An error as a sentence for the user, without the numbers and temporary names of the system's own."""
    # Each system has words of its own for it.
    too_long = getattr(error, "errno", None) == errno.ENAMETOOLONG or getattr(error, "winerror", None) == _TOO_LONG
    if isinstance(error, OSError) and too_long:
        return f"{error.filename2 or error.filename}: file name too long; choose another file or folder."
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename2 or error.filename}: {error.strerror.lower()}; choose another file or folder."
    return str(error)
