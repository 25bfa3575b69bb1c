"""The file that a model was imported from: kept relative to the .blend on the disk, and found again when it has moved.

Blender keeps paths right that are its own, where a .blend is saved in another folder; ours it does not know. In an
open file a model's path is absolute, so that no undo brings back one seen from where the .blend was before.
"""

from __future__ import annotations

import ntpath
import os
from collections.abc import Callable, Generator, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import bpy
from bpy.app.handlers import persistent

from ...core.errors import GaussianFileError, InsideOutError
from ...core.fingerprint import fingerprint_in_steps
from ...core.ply import read_header
from ...core.run_folder import STAGES
from ...core.steps import part_of_work, run_through
from .paths import blend_relative
from .provenance import provenance_of

SOURCE_KEY = "insideout_source"
# Of a scene's settings; what the user chose stays relative where it was.
_SETTINGS = ("capture", "run", "filled_run")
# On a scene of an open file: the folder of the .blend that these are seen from. An undo brings both back.
_SEEN_FROM = "insideout_seen_from"
_RELATIVE = "//"
# Share of relinking that is done when the model's own file is compared.
_COMPARED = 0.6


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
    if os.path.isfile(place):
        return place
    for candidate in (place / name, place / folder / name):
        if os.path.isfile(candidate):
            return candidate
    raise GaussianFileError(
        "{place}: holds no {file}; choose the run folder, or the file that {model} is from.",
        place=place,
        file=name,
        model=model.name,
    )


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
    path, _ = run_through(relink_in_steps(model, place, other_model, others=False))
    return path


def relink_in_steps(
    model: bpy.types.Object, place: Path, other_model: bool = False, others: bool = True
) -> Generator[float, None, tuple[Path, int]]:
    """As `relink`, with breaks that tell the share that is done, 0 to 1; closed before its end nothing is changed.

    Args:
        others: also sets the file of each model of the .blend whose own is gone and is found in the same run.

    Returns:
        The file, and how many others have theirs again.

    Raises:
        GaussianFileError, OtherModelError: as `relink`.
        ReferenceError: an undo in a break has taken the model away.
    """
    marks: dict[Path, str] = {}
    uid = model.session_uid
    looking = _source_in_steps(model, place, other_model, marks)
    found = {uid: (yield from part_of_work(looking, 0.0, _COMPARED if others else 1.0))}
    path = found[uid]
    lost = [one.session_uid for one in _models() if others and one.session_uid != uid and _is_lost(one)]
    for index, one in enumerate(lost):
        first, last = (_COMPARED + (1 - _COMPARED) * (index + done) / len(lost) for done in (0, 1))
        with suppress(InsideOutError, OSError, ReferenceError):
            looking = _source_in_steps(_with_uid(one), run_of(path), False, marks)
            found[one] = yield from part_of_work(looking, first, last)
    there = [_with_uid(uid), *(one for one in _models() if one.session_uid in found and one.session_uid != uid)]
    for one in there:
        remember_source(one, found[one.session_uid])
    return path, len(there) - 1


def _with_uid(uid: int) -> bpy.types.Object:
    """A model by its `session_uid`: an undo in a break leaves no references."""
    for model in _models():
        if model.session_uid == uid:
            return model
    raise ReferenceError("the model is gone")


def _is_lost(model: bpy.types.Object) -> bool:
    path = source_path(model)
    return path is not None and not os.path.isfile(path)


def _source_in_steps(
    model: bpy.types.Object, place: Path, other_model: bool, marks: dict[Path, str]
) -> Generator[float, None, Path]:
    """`relink`'s file, after the breaks of `fingerprint_in_steps`; `marks` are the fingerprints known by then."""
    path, name, known = find_source(place, model), model.name, provenance_of(model).get("file")
    yield 0.0
    different = yield from _difference_in_steps(path, name, known, marks)
    if different is not None and not other_model:
        raise different
    return path


def run_of(path: Path) -> Path:
    """The run folder that a .ply lies in: its own, or the one above that of a stage."""
    return path.parent.parent if path.parent.name in STAGES else path.parent


def _difference_in_steps(
    path: Path, name: str, known: Any, marks: dict[Path, str]
) -> Generator[float, None, OtherModelError | None]:
    """What tells a file from the one that a model was imported from; None where nothing does, or nothing is known.

    Args:
        name: of the model.
        known: what the model's provenance has of its file.
    """
    count, _, _ = read_header(path)
    if not isinstance(known, dict):
        return None
    if count != known.get("splats"):
        return OtherModelError(
            "{path}: holds another model than {model}: {found:,} splats, not {known:,}; choose the right file.",
            path=path,
            model=name,
            found=count,
            known=known.get("splats"),
        )
    if path not in marks:
        marks[path] = yield from fingerprint_in_steps(path)
    if marks[path] == known.get("fingerprint"):
        return None
    return OtherModelError(
        "{path}: holds another model than {model}: as many splats, {count:,}, but with other values; choose the right "
        "file.",
        path=path,
        model=name,
        count=count,
    )


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
    yield handlers.blend_import_post, _after_append
    yield handlers.undo_post, _after_undo
    yield handlers.redo_post, _after_undo


@persistent
def _before_save(filepath: str = "", *_: Any) -> None:
    """Makes paths relative to where the .blend is going to be."""
    if not filepath:
        # The startup file has no folder.
        return
    here, there = _folder(bpy.data.filepath), _folder(filepath)
    for settings, name in _chosen():
        setattr(settings, name, _for_the_file(getattr(settings, name), here, there))
    for scene in _scenes():
        scene.pop(_SEEN_FROM, None)
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
    _note_folder(here)


def on_path_chosen(settings: bpy.types.PropertyGroup, _: bpy.types.Context) -> None:
    """Update callback: a capture or a run folder was chosen."""
    folder = _folder(bpy.data.filepath)
    if folder is not None:
        settings.id_data[_SEEN_FROM] = str(folder)


def _note_folder(folder: Path | None) -> None:
    for scene in _scenes() if folder is not None else ():
        scene[_SEEN_FROM] = str(folder)


@persistent
def _after_undo(*_: Any) -> None:
    """Lets paths of before the .blend was saved elsewhere lead where they led then."""
    now = _folder(bpy.data.filepath)
    for scene in _scenes():
        before = scene.get(_SEEN_FROM)
        if before is None or now is None or before == str(now):
            continue
        for name in _SETTINGS:
            path = getattr(scene.insideout, name)
            if path.startswith(_RELATIVE):
                setattr(scene.insideout, name, _seen_from(path, Path(before), now))
        scene[_SEEN_FROM] = str(now)


@persistent
def _after_load(*_: Any) -> None:
    folder = _folder(bpy.data.filepath)
    _note_folder(folder)
    for model in _models():
        model[SOURCE_KEY] = _seen_from(model[SOURCE_KEY], folder, None)
    # What a library has is read from there each time.
    for thing in bpy.data.objects:
        if thing.library is not None and isinstance(thing.get(SOURCE_KEY), str):
            there = _folder(bpy.path.abspath(thing.library.filepath))
            thing[SOURCE_KEY] = _seen_from(thing[SOURCE_KEY], there, None)


@persistent
def _after_append(context: bpy.types.BlendImportContext, *_: Any) -> None:
    """Makes paths of models and scenes of another .blend, which are seen from there, those of the open file.

    Of linked models, too: where they are made local nothing tells any more which file they were in.
    """
    for item in context.import_items:
        thing, library = item.id, item.source_library
        if library is None:
            continue
        folder = _folder(bpy.path.abspath(library.filepath))
        if isinstance(thing, bpy.types.Object) and isinstance(thing.get(SOURCE_KEY), str):
            thing[SOURCE_KEY] = _seen_from(thing[SOURCE_KEY], folder, None)
        elif isinstance(thing, bpy.types.Scene) and thing.library is None:
            for name in _SETTINGS:
                if getattr(thing.insideout, name).startswith(_RELATIVE):
                    setattr(thing.insideout, name, _seen_from(getattr(thing.insideout, name), folder, None))


def _models() -> list[bpy.types.Object]:
    """Objects of this .blend that know a source; those of a library belong to another."""
    return [thing for thing in bpy.data.objects if thing.library is None and isinstance(thing.get(SOURCE_KEY), str)]


def _scenes() -> list[bpy.types.Scene]:
    """Those of this .blend."""
    return [scene for scene in bpy.data.scenes if scene.library is None]


def _chosen() -> Iterator[tuple[bpy.types.PropertyGroup, str]]:
    for scene in _scenes():
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
    elif ntpath.isabs(path) and not os.path.isabs(path):
        # Of Windows, read elsewhere: it leads nowhere here, and is right there again.
        return path
    absolute = os.path.abspath(path)
    seen = absolute if there is None else blend_relative(absolute, there)
    # On Windows a network share begins with two backslashes, and relative paths with two slashes.
    return (seen.replace("\\", "/") if seen.startswith(_RELATIVE) else seen) + ending
