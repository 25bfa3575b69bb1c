"""Catalogues of an asset library: the text file beside its .blend files that Blender sorts assets by. No bpy."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from uuid import UUID, uuid5

from ...core.errors import SettingError
from ...core.files import atomic_write

FILE = "blender_assets.cats.txt"
_OURS = UUID("6f1d0a52-8a6c-4b7e-9a3f-2a4f2d6d9c11")
_VERSION = "VERSION 1"
_HEAD = f"""# This is an Asset Catalog Definition file for Blender.
#
# Empty lines and lines starting with `#` will be ignored.
# The first non-ignored line should be the version indicator.
# Other lines are of the format "UUID:catalog/path/for/assets:simple catalog name"

{_VERSION}

"""


def catalog_id(path: str) -> str:
    """The identity of a catalogue of ours, the same in every library: by it assets say where they belong."""
    return str(uuid5(_OURS, path))


def check_catalogs(folder: Path) -> None:
    """Raises SettingError where `add_catalogs` would."""
    _read(Path(folder) / FILE)


def add_catalogs(folder: Path, paths: Iterable[str]) -> None:
    """Lists catalogues such as "InsideOut/Materials" in a library's file.

    What is in it stays: catalogues of the user's, and ours where they were moved or renamed.

    Raises:
        SettingError: the file is of a version of Blender that has another format.
        DiskFullError, RunFolderError: as `atomic_write`.
    """
    file = Path(folder) / FILE
    text, lines = _read(file)
    known = {line.partition(":")[0] for line in lines}
    new = [f"{catalog_id(path)}:{path}:{path.replace('/', '-')}" for path in paths if catalog_id(path) not in known]
    if new or not file.exists():
        with atomic_write(file, "w") as stream:
            stream.write(text if text.endswith("\n") else f"{text}\n")
            stream.writelines(f"{line}\n" for line in new)


def _read(file: Path) -> tuple[str, list[str]]:
    """The text of a library's file, which may be missing, and its lines of catalogues."""
    text = file.read_text("utf-8") if file.exists() else _HEAD
    lines = [line.strip() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    if lines[:1] != [_VERSION]:
        raise SettingError("{file}: its format is not known here; choose another folder.", file=file)
    return text, lines[1:]
