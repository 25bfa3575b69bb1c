"""What a benchmark of whole runs keeps beside them, so that one that was broken off goes on with it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ... import __version__
from ..compare.sharing import read_dict
from ..errors import RunFolderError, SettingError
from ..files import plain
from .machine import machine, where


def names_of(captures: Sequence[Path]) -> list[str]:
    """The names of capture folders, by which their runs are called. Raises SettingError where two have the same."""
    names = [Path(capture).resolve().name for capture in captures]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise SettingError(f"two of the captures are called '{twice}'; rename one of them.")
    return names


def made_with(capture: str, settings: Any) -> dict[str, Any]:
    """What a time is of: of another machine, or as many cores of it, it says nothing here.

    Args:
        capture: its digest.
        settings: those of the runs.
    """
    return {"capture": capture, "settings": plain(settings), "version": __version__, "machine": where(machine())}


def kept_beside(run: Path, path: Path, of: dict[str, Any]) -> dict[str, Any]:
    """What was kept of a run that is still there; {} where nothing was.

    Raises RunFolderError where it was made with something else.
    """
    content = (read_dict(path) or {}) if run.exists() else {}
    if content.get("made_with", of) != of:
        raise RunFolderError(
            f"{path}: is of another capture, other settings, another version or machine; choose another --out."
        )
    return content
