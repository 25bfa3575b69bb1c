"""What a preset can be expected to reach: PSNR of what is kept back, from runs that were made before.

`reached.json` holds what finished runs of known objects reached: rows of `insideout bench reached`, those of `paper`
from a machine and a day of their own. A capture of which there is a finished run is told from that run, and
from what presets differ by on those objects: that is surer, for objects differ by more than presets do.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..capture.kept_back import photos_kept_back, projections_kept_back
from ..errors import SettingError
from ..files import plain
from ..resume import difference
from ..settings import PRESETS, Settings

if TYPE_CHECKING:
    from ..capture.model import Capture

QUALITIES = ("photos", "projections")
"""What is told; sections are compared with an FDK, whose noise bounds their figure."""
_MEASURED = Path(__file__).with_name("reached.json")

Row = dict[str, Any]
Range = tuple[float, float]


@dataclass(frozen=True)
class FinishedRun:
    """What a run of a whole preset reached.

    Attributes:
        name: of its folder.
        capture: name of the capture's folder.
        digest: the capture's.
        preset: all of whose steps it made, and no others.
        psnr: dB by what was kept back, see `QUALITIES`.
    """

    name: str
    capture: str
    digest: str
    preset: str
    psnr: dict[str, float]

    @classmethod
    def read(cls, folder: Path) -> FinishedRun:
        """Raises SettingError: the folder holds no finished run, or one of other steps than its preset's."""
        try:
            report, of = (json.loads((folder / name).read_text("utf-8")) for name in ("report.json", "capture.json"))
            psnr = {
                quality: float(figures["psnr"])
                for quality in QUALITIES
                if (figures := report["heldout"].get(quality)) and figures.get("psnr") is not None
            }
            run = cls(folder.resolve().name, Path(of["path"]).name, of["digest"], report["preset"], psnr)
            whole = run.preset in PRESETS and _is_whole(report)
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            raise SettingError(
                "{folder}: holds no finished run; name the folder of one that has ended.", folder=folder
            ) from None
        if not whole:
            raise SettingError(
                "{folder}: has other steps than its preset, or effects, which tells nothing of presets; name another "
                "run.",
                folder=folder,
            )
        return run

    def row(self) -> Row:
        """As `reached` has them."""
        psnr = {quality: round(value, 2) for quality, value in self.psnr.items()}
        return {"capture": self.capture, "preset": self.preset, **psnr}


def _is_whole(report: Mapping[str, Any]) -> bool:
    """Whether a run made all steps of its preset, as it is by default, and no others."""
    usual, stages = plain(Settings.of(report["preset"]).stages), report["stages"]
    # What is skipped, the capture having no use for it, has no settings.
    others = [name for name, one in stages.items() if "settings" in one and difference(one["settings"], usual[name])]
    left_out = [name for name, one in stages.items() if one.get("left_out")]
    used = [effect for effect in report.get("effects") or () if effect["used"]]
    timed = report["time_budget_s"] is not None or report["endings"]
    return not (others or left_out or used or timed)


def finished_run(folder: Path, capture: Capture) -> FinishedRun:
    """A run of this capture. Raises SettingError: it is another's, or see `FinishedRun.read`."""
    run = FinishedRun.read(folder)
    if run.digest != capture.digest:
        raise SettingError(
            "{folder}: is the run of another capture, {capture}; name a run of this one.",
            folder=folder,
            capture=run.capture,
        )
    return run


def reached() -> tuple[Row, ...]:
    """Rows {`capture`, `preset`, `photos`, `projections` (dB)} of what presets reached on known objects."""
    return _rows(_MEASURED)


@cache
def _rows(path: Path) -> tuple[Row, ...]:
    return tuple(json.loads(path.read_text("utf-8"))["rows"])


def expected(
    preset: str, has: Sequence[str], known: FinishedRun | None = None, rows: Sequence[Row] | None = None
) -> dict[str, Range]:
    """Lowest and highest PSNR to be expected, dB, by what is kept back.

    Args:
        preset: of the run to come.
        has: what the capture has of `QUALITIES`.
        known: a finished run of the same capture.
        rows: see `reached`, which is the default.

    Returns:
        Nothing of what no object was measured in with this preset, or, told from `known`, with both; nor, then, of what
        it kept nothing back of.
    """
    rows = reached() if rows is None else rows
    found = {}
    for quality in has:
        values = _values(rows, preset, quality)
        if known is not None:
            base, before = known.psnr.get(quality), _values(rows, known.preset, quality)
            if base is None:
                continue
            values = {name: base + values[name] - before[name] for name in values.keys() & before.keys()}
            if preset == known.preset:
                values = {known.name: base}
        if values:
            found[quality] = (min(values.values()), max(values.values()))
    return found


def qualities_of(capture: Capture, refine: str = "joint") -> list[str]:
    """What of `QUALITIES` a capture keeps back; nothing with another `refine` than runs were measured with.

    Those were of photos and X-rays. One half alone makes nearly the same steps, and comes within some tenths of a dB.
    """
    kept = {"photos": photos_kept_back(capture.photos), "projections": projections_kept_back(capture.projections)}
    return [name for name in QUALITIES if refine == "joint" and kept[name]]


def range_text(found: Range) -> str:
    """As in "34 to 40 dB", or "about 34 dB" where both are the same to a dB."""
    low, high = math.floor(found[0] + 0.5), math.floor(found[1] + 0.5)
    return f"about {low} dB" if low == high else f"{low} to {high} dB"


def source_text(known: FinishedRun | None = None) -> str:
    """Where the figures are from, in a sentence."""
    objects = len({row["capture"] for row in reached()})
    if known is None:
        return f"dB: of what was kept back of {objects} simulated objects; yours may lie outside of that."
    differ = f"what presets differ by on {objects} simulated objects"
    return f"dB: of what is kept back, told from {known.name} and from {differ}."


def _values(rows: Sequence[Row], preset: str, quality: str) -> dict[str, float]:
    return {
        row["capture"]: float(row[quality]) for row in rows if row["preset"] == preset and row.get(quality) is not None
    }
