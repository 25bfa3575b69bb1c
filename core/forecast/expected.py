"""What a preset can be expected to reach: PSNR of what is kept back, from runs that were made before.

`reached.json` holds what finished runs of known objects reached, as `insideout bench reached` collects it. A capture
of which there is a finished run is told from that run, and from what presets differ by on those objects: that is surer,
for objects differ by more than presets do.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import SettingError

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
        preset: as it is by default, neither fitted into a time nor ended early nor refined apart.
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
            found = {
                quality: float(figures["psnr"])
                for quality in QUALITIES
                if (figures := report["heldout"].get(quality)) and figures.get("psnr") is not None
            }
            run = cls(folder.resolve().name, Path(of["path"]).name, of["digest"], report["preset"], found)
            # What was skipped has no settings.
            joint = report["stages"]["internal"].get("settings", {}).get("joint", True) is not None
            whole = joint and report["time_budget_s"] is None and not report["endings"]
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            raise SettingError(f"{folder}: holds no finished run; name the folder of one that has ended.") from None
        if not whole:
            raise SettingError(
                f"{folder}: was fitted into a time, ended early or refined apart, which tells nothing of presets; name "
                "another run."
            )
        return run

    def row(self) -> Row:
        """As `reached` has them."""
        psnr = {quality: round(value, 2) for quality, value in self.psnr.items()}
        return {"capture": self.capture, "preset": self.preset, **psnr}


def finished_run(folder: Path, capture: Capture) -> FinishedRun:
    """A run of this capture. Raises SettingError: it is another's, or see `FinishedRun.read`."""
    run = FinishedRun.read(folder)
    if run.digest != capture.digest:
        raise SettingError(f"{folder}: is the run of another capture, {run.capture}; name a run of this one.")
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
        Nothing of what no object was measured in with this preset, or, told from `known`, with both.
    """
    rows = reached() if rows is None else rows
    found = {}
    for quality in has:
        values = _values(rows, preset, quality)
        if known is not None and quality in known.psnr:
            base, before = known.psnr[quality], _values(rows, known.preset, quality)
            values = {name: base + values[name] - before[name] for name in values.keys() & before.keys()}
            if preset == known.preset:
                values = {known.name: base}
        if values:
            found[quality] = (min(values.values()), max(values.values()))
    return found


def qualities_of(capture: Capture, refine: str = "joint") -> list[str]:
    """What of `QUALITIES` a capture keeps back; nothing with another `refine` than runs were measured with."""
    return [name for name in QUALITIES if refine == "joint" and getattr(capture, name) is not None]


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
