"""Whether a run with a time budget ends in time, and is as good as a preset that takes as long."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..capture.model import Capture
from ..capture.read import read_capture
from ..files import write_json
from ..pipeline import reconstruct
from ..progress import Reporter
from ..settings import Settings
from .compiling import compile_kernels
from .kept import kept_beside, made_with, names_of

KINDS = ("photos", "projections")


def measure_budgets(
    captures: Sequence[Path],
    settings: Sequence[Settings],
    out: Path,
    reporter: Reporter | None = None,
    timed: Settings | None = None,
) -> list[dict[str, Any]]:
    """Runs each capture with each of some settings, and again with the time that it took as the budget.

    The budget is for all of a run, from its start to its report, as `--time-budget` has it. A measurement that was
    broken off goes on with the budget of before, which is kept beside the runs.

    Args:
        captures: folders of different names.
        settings: without a budget.
        out: gets a folder for each run.
        timed: what is fitted to the budget; else what fits it best, as of a run that asks for no preset.

    Returns:
        A row each: `capture`, `preset`, `budget_s` (what the preset took), `seconds` (what the run with that budget
        took), `late` (by what share of the budget later), and for photos and projections that were kept back
        [of the preset, in its time] in dB, None where there are none.

    Raises:
        SettingError: two captures have the same name; a budget is too short.
        RunFolderError: `out` holds what another capture, other settings, version or machine took; or as
            `pipeline.reconstruct`.
        CaptureError, DiskFullError: as `pipeline.reconstruct`.
        Cancelled: the user asked to stop; the same call goes on.
    """
    reporter, rows = reporter or Reporter(), []
    for capture, name in zip(captures, names_of(captures), strict=True):
        read = read_capture(Path(capture), reporter.check)
        for chosen in settings:
            row = _measured(read, chosen, timed, Path(out) / f"{name}-{chosen.preset}", reporter)
            rows.append({"capture": name, "preset": chosen.preset, **row})
    return rows


def _measured(
    capture: Capture, whole: Settings, timed: Settings | None, folder: Path, reporter: Reporter
) -> dict[str, Any]:
    """A row of one capture and preset.

    A run that is finished, and is asked for again, counts its seconds anew: what it took is noted when it ends.
    """
    # Names of captures may have dots, as in scan-1.5mm, of which a suffix would be put in place of the last part.
    noted, in_time = folder.parent / f"{folder.name}.json", folder.with_name(f"{folder.name}-s-time")
    of = made_with(capture.digest, [whole, timed])
    ended = kept_beside(folder, noted, of).get("ended") or []
    if len(ended) < 2:
        compile_kernels(capture, whole, reporter)
    while len(ended) < 2:
        if not ended:
            report = reconstruct(capture, folder, settings=whole, reporter=reporter)
        elif timed is not None:
            asked = replace(timed, time_budget_s=ended[0]["seconds"])
            report = reconstruct(capture, in_time, settings=asked, reporter=reporter)
        else:
            report = reconstruct(
                capture,
                in_time,
                seed=whole.seed,
                kernel=whole.kernel,
                refine=whole.refine,
                effects=whole.effects,
                time_budget_s=ended[0]["seconds"],
                reporter=reporter,
            )
        heldout = {kind: _held_out(report, kind) for kind in KINDS}
        ended.append({"seconds": float(report["seconds_in_all"]), **heldout})
        write_json(noted, {"made_with": of, "ended": ended})
    budget, seconds = (one["seconds"] for one in ended)
    found = {kind: [one[kind] for one in ended] for kind in KINDS}
    return {"budget_s": budget, "seconds": seconds, "late": seconds / budget - 1, **found}


def _held_out(report: dict[str, Any], kind: str) -> float | None:
    psnr = (report["heldout"].get(kind) or {}).get("psnr")
    return None if psnr is None else float(psnr)
