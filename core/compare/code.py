"""What code made a comparison's rows: neither settings nor the program's version tell that a method computes something
else than before."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..run_folder import STAGES

CODE = {
    "fdk": 2,
    "photos": 1,
    "xray": 1,
    "both": 1,
    "report": 1,
    "sart": 1,
    "naf": 1,
    "gs2mesh": 1,
}
"""A number for each part of it, to be raised by hand in the change after which the part makes something else than
before, by more than rounding, of the same capture with the same settings. (Rows know changed settings by themselves.)
What it concerns is made again by comparisons that go on; all else stays:

- fdk: the FDK, and with it what X-ray halves and NAF begin with, and what captures without a truth are measured
  against. 2: short scans with a displaced detector.
- photos, xray: a half of `initialize` or `surface`, and of X-rays alone the stages after them.
- both: `align`, `internal` or `fuse`, of both halves or of X-rays that are refined.
- report: held-out figures of a run's report. Its stages stay.
- sart, naf, gs2mesh: these rows.

Where figures come out otherwise that the comparison measures itself, it is `study.FIGURES` that is to be raised.
"""

# Of rows from before there were numbers.
_FIRST = {**dict.fromkeys(CODE, 1), "fdk": 2}
_OF_RUNS = {"photos": ("photos",), "xray": ("fdk", "xray"), "both": ("fdk", "photos", "xray", "both")}
# The first of the stages that a part is in, where that is not the first of all; the report comes after them.
_FROM = {"both": STAGES.index("align"), "report": len(STAGES)}


def code_of(modality: str, parts: tuple[str, ...] = ()) -> dict[str, int]:
    """The numbers that concern a row, by their names.

    Args:
        modality: "photos", "xray" or "both", which tells the parts of a pipeline.
        parts: those of what is no pipeline.
    """
    return {part: CODE[part] for part in parts or (*_OF_RUNS[modality], "report")}


def other_code(kept: Mapping[str, Any], code: Mapping[str, int]) -> list[str]:
    """The parts that had another number in `code` of what was kept of a row than they have now."""
    made = {**_FIRST, **kept.get("code", {})}
    return [part for part, number in code.items() if made.get(part) != number]


def first_by_other_code(kept: Mapping[str, Any], code: Mapping[str, int]) -> int | None:
    """Where in `STAGES` a run begins to be of other code, after their end if its report alone is; None where all is as
    it would be now."""
    return min((_FROM.get(part, 0) for part in other_code(kept, code)), default=None)
