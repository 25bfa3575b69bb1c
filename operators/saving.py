"""Where a file goes that the user saves."""

from __future__ import annotations

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
        raise RunFolderError("{path}: lies beside the .blend, which is not saved yet; save it first.", path=filepath)
    path = Path(bpy.path.abspath(filepath))
    if path.is_dir():
        raise RunFolderError("{path}: is a folder; give the file a name.", path=path)
    return path
