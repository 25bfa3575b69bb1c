"""The file that a model was imported from: kept relative to the .blend on the disk, and found again when it has moved.

Blender keeps paths right that are its own, where a .blend is saved in another folder; ours it does not know. In an
open file a model's path is absolute, so that no undo brings back one seen from where the .blend was before.
"""

from __future__ import annotations

import ntpath
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import bpy
from bpy.app.handlers import persistent

from ...core.errors import GaussianFileError, InsideOutError
from ...core.fingerprint import fingerprint
from ...core.ply import read_header
from ...core.run_folder import STAGES
from .paths import blend_relative
from .provenance import provenance_of

SOURCE_KEY = "insideout_source"
# Of a scene's settings; what the user chose stays relative where it was.
_SETTINGS = ("capture", "run")
_RELATIVE = "//"


class OtherModelError(InsideOutError):
    """A file is not the one that a model was imported from."""


def remember_source(model: bpy.types.Object, path: Path) -> None:
    """Keeps where a model is from."""
    model[SOURCE_KEY] = os.path.abspath(path)


def source_path(model: bpy.types.Object) -> Path | None:
    """The .ply that a model was imported from, which may be gone; None of a model that was not imported."""
    known = str(model.get(SOURCE_KEY, ""))
    return Path(bpy.path.abspath(known, library=model.library)) if known else None


def source_name(model: bpy.types.Object) -> str:
    """The file's name, whichever system wrote the path; "" of a model that was not imported."""
    return ntpath.basename(str(model.get(SOURCE_KEY, "")))


def find_source(place: Path, model: bpy.types.Object) -> Path:
    """The .ply that a model is from, in the folder of its run wherever that is now, or `place` if that is a file.

    Raises:
        GaussianFileError: there is none.
    """
    known = str(model.get(SOURCE_KEY, ""))
    name, folder = ntpath.basename(known), ntpath.basename(ntpath.dirname(known))
    if place.is_file():
        return place
    for candidate in (place / name, place / folder / name):
        if candidate.is_file():
            return candidate
    raise GaussianFileError(f"{place}: holds no {name}; choose the run folder, or the file that {model.name} is from.")


def relink(model: bpy.types.Object, place: Path, other_model: bool = False) -> Path:
    """Sets the file that a model was imported from.

    Args:
        place: the file, or the folder of the run.
        other_model: also one that holds another model.

    Returns:
        The file.

    Raises:
        GaussianFileError: there is none, or it is no .ply.
        OtherModelError: it is not the file that the model was imported from.
    """
    path = find_source(place, model)
    difference = _difference(path, model)
    if difference and not other_model:
        raise OtherModelError(f"{path}: holds another model than {model.name}: {difference}; choose the right file.")
    remember_source(model, path)
    return path


def relink_others(place: Path) -> int:
    """Sets the file of each model of the .blend whose own is gone and is found in a folder; returns how many."""
    found = 0
    for model in _models():
        path = source_path(model)
        if path is not None and not path.is_file():
            try:
                relink(model, place)
            except (InsideOutError, OSError):
                continue
            found += 1
    return found


def run_of(path: Path) -> Path:
    """The run folder that a .ply lies in: its own, or the one above that of a stage."""
    return path.parent.parent if path.parent.name in STAGES else path.parent


def _difference(path: Path, model: bpy.types.Object) -> str:
    """What tells a file from the one that a model was imported from; "" where nothing does, or nothing is known."""
    count, _, _ = read_header(path)
    known = provenance_of(model).get("file")
    if not isinstance(known, dict):
        return ""
    if count != known.get("splats"):
        return f"{count:,} splats, not {known.get('splats'):,}"
    return "" if fingerprint(path) == known.get("fingerprint") else f"as many splats, {count:,}, but with other values"


def attach() -> None:
    """Keeps paths right from now on."""
    for handlers, handler in _handlers():
        handlers.append(handler)


def detach() -> None:
    """Ends it."""
    for handlers, handler in _handlers():
        if handler in handlers:
            handlers.remove(handler)


def _handlers() -> Iterator[tuple[list[Callable[..., None]], Callable[..., None]]]:
    handlers = bpy.app.handlers
    yield handlers.save_pre, _before_save
    yield handlers.save_post, _after_save
    yield handlers.save_post_fail, _after_save
    yield handlers.load_post, _after_load


@persistent
def _before_save(filepath: str = "", *_: Any) -> None:
    """Makes paths relative to where the .blend is going to be."""
    if not filepath:
        # The startup file has no folder.
        return
    here, there = _folder(bpy.data.filepath), _folder(filepath)
    for settings, name in _chosen():
        setattr(settings, name, _for_the_file(getattr(settings, name), here, there))
    for model in _models():
        model[SOURCE_KEY] = _for_the_file(model[SOURCE_KEY], here, there)


@persistent
def _after_save(filepath: str = "", *_: Any) -> None:
    """Makes paths those of the open file again, which stays where it is if it was a copy that was saved."""
    if not filepath:
        return
    here, there = _folder(bpy.data.filepath), _folder(filepath)
    for settings, name in _chosen():
        if here != there and getattr(settings, name).startswith(_RELATIVE):
            setattr(settings, name, _seen_from(getattr(settings, name), there, here))
    for model in _models():
        model[SOURCE_KEY] = _seen_from(model[SOURCE_KEY], there, None)


@persistent
def _after_load(*_: Any) -> None:
    folder = _folder(bpy.data.filepath)
    for model in _models():
        model[SOURCE_KEY] = _seen_from(model[SOURCE_KEY], folder, None)


def _models() -> list[bpy.types.Object]:
    """Objects of this .blend that know a source; those of a library belong to another."""
    return [thing for thing in bpy.data.objects if thing.library is None and isinstance(thing.get(SOURCE_KEY), str)]


def _chosen() -> Iterator[tuple[bpy.types.PropertyGroup, str]]:
    for scene in bpy.data.scenes:
        if scene.library is None:
            yield from ((scene.insideout, name) for name in _SETTINGS if getattr(scene.insideout, name))


def _folder(blend: str) -> Path | None:
    """Where a .blend lies; None for one that was never saved."""
    return Path(os.path.abspath(blend)).parent if blend else None


def _for_the_file(path: str, here: Path | None, there: Path | None) -> str:
    """A path as the .blend is to have it; absolute ones become relative if the user's preferences want that."""
    relative = path.startswith(_RELATIVE)
    if here == there if relative else not bpy.context.preferences.filepaths.use_relative_paths:
        return path
    return _seen_from(path, here, there)


def _seen_from(path: str, here: Path | None, there: Path | None) -> str:
    """A path seen from a .blend in `here` as one in `there` sees it: absolute where `there` is None."""
    ending = "/" if path.endswith(("/", "\\")) else ""
    if path.startswith(_RELATIVE):
        if here is None:
            return path
        # Windows writes, and only Windows reads, the other slash.
        path = os.path.join(here, path[2:].replace("\\", "/"))
    absolute = os.path.abspath(path)
    if there is None:
        return absolute + ending
    return blend_relative(absolute, there).replace("\\", "/") + ending
