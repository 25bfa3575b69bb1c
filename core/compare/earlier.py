"""What earlier comparisons found: that in the folder of this one, and those that are shown beside it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..errors import RunFolderError, SettingError
from .ablation import ABLATION
from .code import other_code
from .methods import METHODS
from .sharing import read_dict
from .study import FOUND_FRAME

FILES = ("tables.json", "tables.md", "plot.png")
"""What a comparison writes into its folder."""
_METHODS = {method.name: method for method in (*METHODS.values(), *ABLATION)}


def own_captures(
    out: Path, how: dict[str, Any], measured: dict[str, Any], settings: Mapping[str, str], coming: Sequence[str]
) -> dict[str, Any]:
    """The captures of the comparison that is in `out` already: it will come to them again, or was given others before.

    Args:
        how: how rows are made now: preset, seed, kernel and such.
        measured: what figures depend on beside that.
        settings: digests of the rows' settings now, by their names.
        coming: names of the captures that are compared now.

    Returns:
        Their figures; none that were measured in another way, and without rows that other code made.

    Raises:
        RunFolderError: going on would give up its rows, which were made in another way, or captures that are not
            `coming` again and were measured in another way or by other code; or it is something else.
    """
    own = read_dict(out / "tables.json")
    if own is None or not _is_comparison(own):
        foreign = next((out / name for name in FILES if (out / name).exists()), None)
        if foreign is not None:
            raise RunFolderError(f"{foreign}: is not of a comparison; choose another --out, nothing was changed.")
        return {}
    lost = set(own["captures"]) - set(coming)
    for name, value in {**how, **measured}.items():
        # What was measured in another way, but made in the same, is measured anew when its turn comes.
        if own.get(name) != value and (own["captures"] if name in how else lost):
            raise RunFolderError(
                f"{out}: holds a comparison made {_difference(name, own.get(name), value, how['preset'])}; choose "
                "another --out, or delete that folder, nothing was changed."
            )

    def is_other(name: str, row: Mapping[str, Any]) -> bool:
        return _is_other(name, row, settings)

    for name, one in own["captures"].items():
        if _has_any(one, is_other) or (name in lost and _has_any(one, _is_by_other_code)):
            raise RunFolderError(
                f"{out}: holds a comparison made {_difference('settings', None, None, how['preset'])}; choose "
                "another --out, or delete that folder, nothing was changed."
            )
    if any(own.get(name) != value for name, value in measured.items()):
        return {}
    return {
        name: _without(one, _is_by_other_code) if _has_any(one, _is_by_other_code) else one
        for name, one in _with_machine(own).items()
    }


def other_captures(
    path: Path, how: Mapping[str, Any], settings: Mapping[str, str], out: Path, coming: Sequence[str]
) -> dict[str, Any]:
    """The captures of an earlier comparison that was made and measured in the same way, with those of its rows that
    would be made with the same settings, and by the same code, now.

    Args:
        path: its tables.json.
        how: how rows are made and measured now.
        settings: digests of the rows' settings now, by their names.
        out: the folder of this comparison, whose own captures none may take the place of.
        coming: names of the captures that are compared now, and take rows of the same capture from it.

    Raises:
        SettingError: the file is no tables.json; another preset, seed, kernel or time was chosen; none of its rows
            would be made with the same settings; or it holds a capture that `out` has rows of.
    """
    content = read_dict(path) or {}
    if not _is_comparison(content):
        raise SettingError(f"--also {path}: is no tables.json of a comparison; name that file, or leave it out.")
    for name, value in how.items():
        if content.get(name) != value:
            difference = _difference(name, content.get(name), value, how["preset"])
            raise SettingError(f"--also {path}: was made {difference}; compare like with like.")

    def is_other(name: str, row: Mapping[str, Any]) -> bool:
        return _is_other(name, row, settings) or _is_by_other_code(name, row)

    others = {name: _without(one, is_other) for name, one in _with_machine(content).items()}
    if content["captures"] and not any(any(_all_rows(one)) for one in others.values()):
        difference = _difference("settings", None, None, how["preset"])
        raise SettingError(f"--also {path}: was made {difference}; compare like with like.")
    for name in others:
        if name not in coming and (out / name).is_dir():
            raise SettingError(
                f"--also {path}: holds the capture '{name}', of which {out} has rows of its own; leave --also out, or "
                "choose another --out."
            )
    return others


def rows_kept(earlier: Mapping[str, Any] | None, stamp: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """The rows that stay of a capture's earlier figures, until they are made again: those of the same capture and the
    same truth whose folder is still there.

    Args:
        earlier: its figures, made and measured in the same way; None if there are none.
        stamp: the capture's and the truth's digest, with which they were kept.
        folder: of the capture's runs.

    Returns:
        `methods`, `ablation`, `projections` {number: rows}, and `alignment` if there was one.
    """
    if earlier is None or earlier.get("stamp") != stamp:
        return {"methods": {}, "ablation": {}, "projections": {}}
    thinned = {
        count: _still_there(rows, folder / "projections" / count) for count, rows in earlier["projections"].items()
    }
    kept: dict[str, Any] = {
        "methods": _still_there(earlier["methods"], folder),
        "ablation": _still_there(earlier["ablation"], folder),
        "projections": {count: rows for count, rows in thinned.items() if rows},
    }
    if "insideout" in kept["methods"] and "alignment" in earlier:
        kept["alignment"] = earlier["alignment"]
    return kept


def with_rows_beside(
    kept: dict[str, Any], beside: Mapping[str, Any] | None, stamp: Mapping[str, Any]
) -> dict[str, Any]:
    """A capture's rows, with those that only an earlier comparison made: on another machine, or before the runs were
    deleted.

    Args:
        kept: the rows of this comparison, see `rows_kept`.
        beside: the earlier one's figures of a capture of this name; None if there are none.
        stamp: the capture's and the truth's digest; rows of another capture are not taken.
    """
    if beside is None or beside.get("stamp") != stamp:
        return kept
    numbers = {**beside["projections"], **kept["projections"]}
    return {
        **({"alignment": beside["alignment"]} if "alignment" in beside else {}),
        **kept,
        "methods": {**beside["methods"], **kept["methods"]},
        "ablation": {**beside["ablation"], **kept["ablation"]},
        "projections": {
            number: {**beside["projections"].get(number, {}), **kept["projections"].get(number, {})}
            for number in numbers
        },
    }


def _still_there(rows: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    return {name: row for name, row in rows.items() if (folder / name / "figures.json").exists()}


def _all_rows(capture: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """The rows of a capture by their names: of its methods, its ablation, and with fewer projections."""
    yield capture["methods"]
    yield capture["ablation"]
    yield from capture["projections"].values()


def _is_other(name: str, row: Mapping[str, Any], settings: Mapping[str, str]) -> bool:
    """Whether a row was made with other settings than it would have now."""
    return row.get("settings") != settings.get(name)


def _is_by_other_code(name: str, row: Mapping[str, Any]) -> bool:
    """Whether a row was made by other code than it would be now; one that there is no more counts by its settings."""
    return name in _METHODS and bool(other_code(row, _METHODS[name].code))


def _has_any(capture: Mapping[str, Any], is_such: Callable[[str, Mapping[str, Any]], bool]) -> bool:
    return any(is_such(name, row) for rows in _all_rows(capture) for name, row in rows.items())


def _in_found_frame(row: Mapping[str, Any]) -> bool:
    """Whether a photo row was brought to mm by the similarity that the InsideOut row found."""
    return any((row.get(part) or {}).get("frame") == FOUND_FRAME for part in ("sections", "mesh"))


def _without(capture: Mapping[str, Any], is_other: Callable[[str, Mapping[str, Any]], bool]) -> dict[str, Any]:
    """Without rows that would be others now; without the InsideOut row there is neither its alignment nor what was
    measured in the frame that it found."""

    def like(rows: Mapping[str, Any]) -> dict[str, Any]:
        return {name: row for name, row in rows.items() if not is_other(name, row)}

    thinned = {count: kept for count, rows in capture["projections"].items() if (kept := like(rows))}
    found = {**capture, "methods": like(capture["methods"]), "ablation": like(capture["ablation"])}
    if "insideout" not in found["methods"]:
        found.pop("alignment", None)
        found["methods"] = {name: row for name, row in found["methods"].items() if not _in_found_frame(row)}
    return {**found, "projections": thinned}


def _difference(name: str, before: Any, now: Any, preset: str) -> str:
    if name in ("settings", "version", "figures"):
        return f"by another version of the program, whose preset {preset} or measures are others"
    if name == "same_time":
        return f"{'with' if before else 'without'} the same time for methods that see X-rays"
    return f"with {name} {before}, not {now}"


def _is_comparison(content: dict[str, Any]) -> bool:
    return isinstance(content.get("captures"), dict) and "machine" in content


def _with_machine(content: dict[str, Any]) -> dict[str, Any]:
    return {name: {"machine": content["machine"], **one} for name, one in content["captures"].items()}
