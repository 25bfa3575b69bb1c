"""Paths as a .blend keeps them: relative to its folder, so that both can be moved together."""

from __future__ import annotations

import os
from pathlib import Path

import bpy


def blend_relative(path: str | Path, folder: Path | None = None) -> str:
    """`path` as "//..." seen from a .blend in `folder`, by default from the open one.

    Absolute where no relative path leads: without a saved .blend, or from another drive of Windows.
    """
    absolute = os.path.abspath(bpy.path.abspath(str(path)))
    if folder is None and not bpy.data.filepath:
        return absolute
    try:
        return bpy.path.relpath(absolute, start=None if folder is None else str(folder))
    except ValueError:
        return absolute


def free_path(path: Path) -> Path:
    """`path`, or where that exists the first of name-2, name-3, ... that does not."""
    path, number = Path(path), 2
    found = path
    while found.exists():
        found, number = path.with_stem(f"{path.stem}-{number}"), number + 1
    return found
