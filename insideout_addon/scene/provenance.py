"""Where a model comes from: capture, settings, versions and figures of its run, kept as text on the object.

No bpy, but for its version: another thread may read files.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path, PureWindowsPath
from typing import TYPE_CHECKING, Any

from ... import __version__
from ...core.files import plain
from ...core.fingerprint import fingerprint
from ...core.gaussians import GaussianSet
from ...core.ply import FACT_PREFIX, fact_comment, read_comments, read_sh_degree
from ...core.run_folder import STAGES
from ..engine.curve_picture import CurvePoint, curve_points

if TYPE_CHECKING:
    import bpy

# On each model, as JSON: what `read_provenance` finds, and `imported`.
PROVENANCE_KEY = "insideout_provenance"
# What a .ply's header has no room for; preset, seed and version tell as much.
_TOO_LONG = ("settings", "curve")
# Characters of a text as JSON that a comment has room for, after the name.
_ROOM = 180
# What runs leave in their folder and in those of their stages.
_SETS = ("rgb.ply", "xray.ply", "joint.ply", "fused.ply")
_LOG_TAIL_BYTES = 4096
_HELDOUT = ("photos", "projections", "sections")
_OF_EFFECT = (
    "half",
    "found",
    "used",
    "chosen_by",
    "strength",
    "unit",
    "threshold",
    "error",
    "gain_db",
    "times_as_long",
    "reason",
    "told",
)


def read_provenance(path: Path, gaussians: GaussianSet, unit: str) -> dict[str, Any]:
    """What is known of the .ply that `gaussians` were read from: by its run folder, or by the comments of an export.

    What cannot be read beside the .ply is left out: the splats can be shown without.

    Args:
        path: the .ply; in a run, in its folder or in one of its stages'.
        gaussians: with or without its view-dependent colours.
        unit: of its lengths.

    Returns:
        `file` (`name`, `splats`, `sh_degree`, `fingerprint`), `unit`; of a run also `run` (`name`, `finished`,
        `preset`, `seed`, `seconds`), `settings`, `capture` (`name`, `digest`), `versions`, `heldout` (`photos`,
        `projections`, `sections`: `psnr` in dB, `ssim`, `count`), `effects` (what was looked for or asked for, by
        name: rows of `core.effects.choose.Choice`), `curve` (of `report.json`, with what a picture of it needs).
    """
    path = Path(path)
    found = _of_run(path) or provenance_in_comments(path)
    file = {"name": path.name, "splats": len(gaussians), "sh_degree": read_sh_degree(path)}
    return {**found, "unit": unit, "file": {**file, "fingerprint": fingerprint(path)}}


def keep_provenance(model: bpy.types.Object, provenance: dict[str, Any]) -> None:
    """Writes it onto a model, with what imported it and when."""
    model[PROVENANCE_KEY] = json.dumps(plain({**provenance, "imported": stamp()}))


def stamp() -> dict[str, str]:
    """When something was done, and with what."""
    import bpy

    return {"date": _date(datetime.now(UTC)), "insideout": __version__, "blender": bpy.app.version_string}


def provenance_of(model: bpy.types.Object) -> dict[str, Any]:
    """What a model has on it, {} where there is nothing that can be read."""
    return _json_object(str(model.get(PROVENANCE_KEY, "")))


def curve_of(model: bpy.types.Object) -> tuple[CurvePoint, ...]:
    """The curve of a model's run, which may be gone; () where none is known."""
    return _curve_in(str(model.get(PROVENANCE_KEY, "")))


@lru_cache(maxsize=4)
def _curve_in(text: str) -> tuple[CurvePoint, ...]:
    return curve_points(_json_object(text).get("curve"))


def comment_lines(provenance: dict[str, Any]) -> list[str]:
    """A comment of a .ply for each fact: `insideout capture.name = "doll"`, values as JSON."""
    facts = {key: value for key, value in provenance.items() if key not in _TOO_LONG}
    # A line is too short for what a sentence is translated by.
    known = [(name, value) for name, value in _flat(plain(facts)) if not name.endswith(".told")]
    return [fact_comment(name, value) for name, value in known]


def provenance_in_comments(path: Path) -> dict[str, Any]:
    """What `comment_lines` has put into a .ply."""
    found: dict[str, Any] = {}
    for comment in read_comments(path):
        name, equals, text = comment.removeprefix(FACT_PREFIX).partition(" = ")
        if not comment.startswith(FACT_PREFIX) or not equals:
            continue
        try:
            value = json.loads(text)
        except ValueError:
            continue
        *parents, last = name.split(".")
        place = found
        for parent in parents:
            inner = place.setdefault(parent, {})
            place = inner if isinstance(inner, dict) else {}
        place[last] = value
    return found


def in_pieces(text: str) -> dict[str, str]:
    """A text of any length as facts that each fit into a comment."""
    pieces: dict[str, str] = {}
    while text:
        size = next(size for size in range(_ROOM, 0, -1) if len(json.dumps(text[:size])) <= _ROOM)
        pieces[str(len(pieces))], text = text[:size], text[size:]
    return pieces


def of_pieces(found: Any) -> str:
    """The text that `in_pieces` has divided; "" of anything else."""
    pieces = found if isinstance(found, dict) else {}
    return "".join(str(pieces.get(str(index), "")) for index in range(len(pieces)))


def is_of_a_run(path: Path) -> bool:
    """Whether a .ply is what the run that it may lie in has left there: one that was exported into a run folder, or
    copied there by another name, tells of other splats than the run's report, volume and mesh."""
    return path.name in _SETS and "exported" not in provenance_in_comments(path)


def was_imported_from_a_run(model: bpy.types.Object, source: Path) -> bool:
    """Whether a model was imported from what a run has left, whatever lies in that place by now."""
    return source.name in _SETS and "exported" not in provenance_of(model)


def _of_run(path: Path) -> dict[str, Any]:
    """What the run that has left a .ply says, {} of a file that is of none."""
    if not is_of_a_run(path):
        return {}
    run = path.parent.parent if path.parent.name in STAGES else path.parent
    report, marker = _read(run / "report.json"), _read(run / "capture.json")
    if "stages" not in report and not marker:
        return {}
    found: dict[str, Any] = {"run": {"name": run.resolve().name, "finished": _finished(run)}}
    found["run"] |= {key: report[key] for key in ("preset", "seed", "seconds") if key in report}
    if marker:
        # The run may be of Windows.
        name = PureWindowsPath(str(marker.get("path", ""))).name
        found["capture"] = {"name": name, "digest": str(marker.get("digest", ""))}
    settings, versions, heldout = _read(run / "settings.json"), _part(report, "versions"), _part(report, "heldout")
    figures = {
        name: {key: _part(heldout, name)[key] for key in ("psnr", "ssim", "count") if key in _part(heldout, name)}
        for name in _HELDOUT
        if name in heldout
    }
    known = {"settings": settings, "versions": versions, "heldout": figures, "effects": _effects(report)}
    known["curve"] = _curve(report)
    for name, content in known.items():
        if content:
            found[name] = content
    return found


def _curve(report: dict[str, Any]) -> list[dict[str, Any]]:
    """Rounded, for it is kept in the .blend: a tenth of a second, a hundredth of a dB."""
    found = []
    for point in curve_points(report.get("curve")):
        figures = {kind: getattr(point, kind) for kind in _HELDOUT}
        known = {kind: round(value, 2) for kind, value in figures.items() if value is not None}
        found.append({"stage": point.stage, "part": point.part, "seconds": round(point.seconds, 1), **known})
    return found


def _effects(report: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """By name, so that a .ply's comments have room for them."""
    rows = report.get("effects")
    found = [row for row in rows if isinstance(row, dict)] if isinstance(rows, list) else []
    return {
        row["name"]: {key: row[key] for key in _OF_EFFECT if key in row}
        for row in found
        # Dots would part it in a comment.
        if isinstance(row.get("name"), str) and row["name"].isidentifier()
    }


def _finished(run: Path) -> str:
    """When the last line was logged; files that were copied have lost their date."""
    try:
        with open(run / "log.jsonl", "rb") as stream:
            stream.seek(max(0, (run / "log.jsonl").stat().st_size - _LOG_TAIL_BYTES))
            times = re.findall(rb'"time": ([0-9.]+)', stream.read())
        return _date(datetime.fromtimestamp(float(times[-1]), UTC))
    except (OSError, IndexError, ValueError, OverflowError):
        return ""


def _date(time: datetime) -> str:
    return time.isoformat(timespec="seconds")


def _flat(content: dict[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in content.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{before}{key}.")
        else:
            yield f"{before}{key}", value


def _part(content: dict[str, Any], name: str) -> dict[str, Any]:
    found = content.get(name)
    return found if isinstance(found, dict) else {}


def _read(path: Path) -> dict[str, Any]:
    try:
        return _json_object(path.read_text("utf-8"))
    except (OSError, ValueError):
        return {}


def _json_object(text: str) -> dict[str, Any]:
    try:
        found = json.loads(text)
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}
