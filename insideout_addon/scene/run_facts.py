"""What a run folder tells about its splats: their units, and what the run warned of. No bpy."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...core.capture.volumes import RELATIVE
from ...core.gaussians import GaussianSet
from ...core.ply import read_comments, says_relative
from .framing import has_density
from .provenance import in_pieces, is_of_a_run, of_pieces, provenance_in_comments

MILLIMETRE = "mm"
ARBITRARY = "arbitrary unit: no X-ray"
_LEAST_AGREEMENT = 0.3
# Where photo splats are before they are brought onto the X-rays.
_PHOTO_FRAME = ("initialize", "surface")


@dataclass(frozen=True)
class RunFacts:
    """What is known.

    Attributes:
        unit: MILLIMETRE or ARBITRARY.
        warnings: a sentence each.
        told: what each of them is translated by, as `core.told.Told.to_json`; () of a run that has no more than these.
        up: (3,) which way is up for the photographer, in a frame that is arbitrary; None where it is not, or unknown.
        water: attenuation of water in the model of a scan in Hounsfield units, mm⁻¹; None of other scans.
    """

    unit: str = MILLIMETRE
    warnings: tuple[str, ...] = ()
    told: tuple[Any, ...] = ()
    up: tuple[float, float, float] | None = None
    water: float | None = None

    @property
    def in_mm(self) -> bool:
        """Whether lengths are millimetres."""
        return self.unit == MILLIMETRE


def read_run_facts(path: Path, gaussians: GaussianSet) -> RunFacts:
    """What the run says that a .ply belongs to, or else the comments of the file: an export tells all of it, a copy, or
    what a run has left so far, what densities are in. A .ply of another program belongs to none.

    Attenuation is in 1/mm, so splats with some are in millimetres. Others are only once `align` has brought them
    onto X-rays; a model that was exported says so in its comments.

    Args:
        path: the .ply, in the run folder or in one of its stages' folders.
    """
    path = Path(path)
    comments = provenance_in_comments(path)
    report, align, photos = _exported_report(comments), {}, None
    for run in (path.parent, path.parent.parent) if is_of_a_run(path) else ():
        found, align = _read(run / "report.json"), _read(run / "align" / "report.json")
        photos = run / "initialize" / "photos.json"
        report = found if "stages" in found else report
        if "stages" in found or align:
            break
    aligned = bool(align.get("similarity")) and path.parent.name not in _PHOTO_FRAME
    warnings = report.get("warnings")
    known = tuple(str(warning) for warning in warnings) if isinstance(warnings, list) else ()
    told = report.get("warnings_told")
    said = known, tuple(told) if isinstance(told, list) and len(told) == len(known) else ()
    if says_relative(read_comments(path)) and not any(RELATIVE in warning for warning in known):
        said = (*known, str(RELATIVE)), (*said[1], RELATIVE.to_json()) if len(said[1]) == len(known) else ()
    if aligned or comments.get("unit") == MILLIMETRE or has_density(gaussians):
        return RunFacts(MILLIMETRE, *said, water=_water(report))
    return RunFacts(ARBITRARY, *said, None if photos is None else _up(_read(photos)))


def facts_to_export(warnings: str, told: str, water: float | None) -> dict[str, Any]:
    """What the comments of an export are to say, beside its provenance, for these facts to be known again.

    Args:
        warnings: a line each.
        told: what they are translated by, as JSON.
        water: as `RunFacts` has it.
    """
    known = {} if water is None else {"water_per_mm": water}
    return {"warnings": in_pieces(warnings), "warnings_told": in_pieces(told if warnings else ""), **known}


def _exported_report(comments: dict[str, Any]) -> dict[str, Any]:
    """What `facts_to_export` has put into comments, as a run's report says it."""
    try:
        told = json.loads(of_pieces(comments.get("warnings_told")))
    except ValueError:
        told = None
    warnings = of_pieces(comments.get("warnings")).splitlines()
    return {"warnings": warnings, "warnings_told": told, "water_per_mm": comments.get("water_per_mm")}


def _water(report: dict[str, Any]) -> float | None:
    water = report.get("water_per_mm")
    return water if isinstance(water, float) and water > 0 else None


def _up(photos: dict[str, Any]) -> tuple[float, float, float] | None:
    """The mean of the cameras' up directions (y points down in a camera), or None where they cancel out."""
    try:
        cameras = [photo["camera"] for photo in photos["photos"] if photo["camera"] is not None]
        down = np.array([camera["world_to_camera"][1][:3] for camera in cameras], np.float64)
    except (KeyError, TypeError, IndexError, ValueError):
        return None
    if down.ndim != 2 or down.shape[1] != 3 or len(down) == 0:
        return None
    mean = -down.mean(axis=0)
    length = float(np.linalg.norm(mean))
    return tuple((mean / length).tolist()) if length > _LEAST_AGREEMENT else None


def _read(path: Path) -> dict[str, Any]:
    """A JSON object, or {} where there is none that can be read: the splats can be shown without."""
    try:
        found = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
