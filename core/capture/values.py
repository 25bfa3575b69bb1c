"""Numbers out of the JSON, settings and .npy files of a capture, and which views are held out when it does not say."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from ..volume import ARCHIVE_ERRORS
from .findings import CaptureProblem


def every_eighth(count: int) -> np.ndarray:
    """(count,) bool: the views held out for measuring when the capture does not say which."""
    held_out = np.zeros(count, bool)
    if count >= 8:
        held_out[::8] = True
    return held_out


def read_json(path: Path) -> Any:
    """Parses a JSON file. Raises CaptureError naming the line where it breaks."""
    try:
        return json.loads(path.read_text("utf-8-sig"))
    except json.JSONDecodeError as error:
        raise CaptureProblem(
            path,
            "is not valid JSON at line {line}: {what}",
            "mend that line or export it again",
            line=error.lineno,
            what=error.msg,
        ) from error
    except (OSError, UnicodeDecodeError) as error:
        raise CaptureProblem(path, "cannot be read ({error})", "export it again", error=error) from error


def read_array(path: Path) -> np.ndarray:
    """The array of an .npy as it is stored. Raises CaptureError when it is damaged, an .npz, or of objects."""
    try:
        array = np.load(path, allow_pickle=False)
    except ARCHIVE_ERRORS as error:
        raise CaptureProblem(path, "cannot be read as .npy ({error})", "export it again", error=error) from error
    if not isinstance(array, np.ndarray):
        array.close()
        raise CaptureProblem(path, "is an .npz", "export it as .npy")
    return array


def listed(source: Path, content: dict[str, Any], key: str) -> list[Any]:
    """The list under a key of a JSON file; empty when it is missing or null. Raises CaptureError for anything else."""
    value = content.get(key)
    if value is None:
        return []
    if not isinstance(value, list):
        raise CaptureProblem(source, "'{key}' is {value}", "make it a list, [...]", key=key, value=repr(value))
    return value


def number(source: Path, content: dict[str, Any], key: str, default: float | None = None) -> float:
    """A finite number of a geometry file. Raises CaptureError when it is missing or something else."""
    return float(numbers(source, content, key, 1, None if default is None else [default])[0])


def numbers(
    source: Path, content: dict[str, Any], key: str, count: int, default: list[float] | None = None
) -> np.ndarray:
    """`count` finite numbers of a geometry file. Raises CaptureError when they are missing or something else."""
    if key not in content:
        if default is not None:
            return np.asarray(default, np.float64)
        raise CaptureProblem(source, "lacks '{key}'", "add it; the scanner's own settings have the value", key=key)
    try:
        values = np.atleast_1d(np.asarray(content[key], np.float64))
    except (TypeError, ValueError):
        values = np.array([np.nan])
    if count > 1 and values.shape == (1,):
        values = np.repeat(values, count)
    if values.shape != (count,) or not np.isfinite(values).all():
        raise CaptureProblem(
            source,
            "'{key}' is {value}",
            "give {count} finite numbers" if count > 1 else "give {count} finite number",
            key=key,
            value=repr(content[key]),
            count=count,
        )
    return values


def positive(source: Path, key: str, values: np.ndarray | float) -> None:
    """Raises CaptureError when a length or a count is not above zero."""
    if np.any(np.asarray(values) <= 0):
        raise CaptureProblem(source, "'{key}' is {values}", "give a value above zero", key=key, values=values)
