"""Photos with their cameras as a file of a run, so that later stages need no structure from motion."""

from __future__ import annotations

import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import RunFolderError
from ..files import write_json
from ..views import Camera
from .model import Backdrop, Lens, Photo, Photos


def save_photos(path: Path, photos: Photos) -> None:
    """Writes paths, cameras, lenses, held-out flags and sparse points as JSON, atomically.

    Image paths are kept both as they are and relative to the file, so that a capture and its run can move together;
    backdrops may lie beside it.

    Raises:
        DiskFullError, RunFolderError: see `core.files.atomic_write`.
    """
    path = Path(path)
    content: dict[str, Any] = {"photos": [_photo_to_json(photo, path.parent) for photo in photos.photos]}
    for name, values in (("points", photos.points), ("colors", photos.colors)):
        content[name] = None if values is None else np.asarray(values, np.float64).tolist()
    write_json(path, content)


def load_photos(path: Path) -> Photos:
    """Reads what `save_photos` wrote.

    Raises:
        RunFolderError: the file is missing or damaged, or an image is gone.
    """
    path = Path(path)
    try:
        content = json.loads(path.read_text("utf-8"))
        photos = [_photo_from_json(entry, path) for entry in content["photos"]]
        points, colors = (
            None if content[name] is None else np.asarray(content[name], np.float64).reshape(-1, 3)
            for name in ("points", "colors")
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RunFolderError(
            "{path}: cannot be read ({error}); run the initialize stage again.", path=path, error=error
        ) from error
    return Photos(photos, points, colors)


def relative_path(image: Path, folder: Path) -> str | None:
    """Where an image lies from a folder on, with slashes; None where there is no such way."""
    try:
        return Path(os.path.relpath(image.resolve(), folder.resolve())).as_posix()
    except ValueError:
        # Another drive on Windows has no relative path.
        return None


def _photo_to_json(photo: Photo, folder: Path) -> dict[str, Any]:
    image = photo.path.resolve()
    entry: dict[str, Any] = {
        "path": str(image),
        "held_out": bool(photo.held_out),
        "upright": bool(photo.upright),
        "camera": None,
        "lens": None if photo.lens is None else asdict(photo.lens),
    }
    if photo.backdrop is not None:
        entry["backdrop"] = {**asdict(photo.backdrop), "path": str(photo.backdrop.path.resolve())}
    entry["relative"] = relative_path(image, folder)
    if photo.camera is not None:
        camera = photo.camera
        entry["camera"] = {
            "width": int(camera.width),
            "height": int(camera.height),
            **{name: float(getattr(camera, name)) for name in ("fx", "fy", "cx", "cy", "near")},
            "orthographic": bool(camera.orthographic),
            "world_to_camera": np.asarray(camera.world_to_camera, np.float64).tolist(),
        }
    return entry


def _photo_from_json(entry: dict[str, Any], path: Path) -> Photo:
    image = Path(entry["path"])
    if not image.is_file() and entry.get("relative"):
        image = (path.parent / entry["relative"]).resolve()
    if not image.is_file():
        raise RunFolderError("{photo}: the photo is gone; put it back, or start a new run.", photo=entry["path"])
    camera = lens = None
    if entry["camera"] is not None:
        values = dict(entry["camera"])
        camera = Camera(**{**values, "world_to_camera": np.asarray(values["world_to_camera"], np.float64)})
    if entry["lens"] is not None:
        lens = Lens(**{**entry["lens"], "coefficients": tuple(entry["lens"]["coefficients"])})
    backdrop = None
    if entry.get("backdrop") is not None:
        kept = entry["backdrop"]
        behind = Path(kept["path"])
        # It lies beside the file that a run leaves, and not beside copies of that.
        beside = path.parent / behind.name
        behind = beside if beside.is_file() else behind
        backdrop = Backdrop(behind, tuple(kept["color"]), float(kept["tolerance"]))
    return Photo(image, camera, bool(entry["held_out"]), lens, bool(entry["upright"]), backdrop)
