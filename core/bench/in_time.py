"""Whether a run with a time budget ends in time, and is as good as a preset that takes as long."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..capture.read import read_capture
from ..errors import SettingError
from ..pipeline import reconstruct
from ..progress import Reporter
from ..settings import Settings

KINDS = ("photos", "projections")


def measure_budgets(
    captures: Sequence[Path],
    settings: Sequence[Settings],
    timed: Settings,
    out: Path,
    reporter: Reporter | None = None,
) -> list[dict[str, Any]]:
    """Runs each capture with each of some settings, and again with the time that it took as the budget of others.

    The budget is for all of a run, from its start to its report, as `--time-budget` has it. A measurement that was
    broken off goes on, and finished runs are kept.

    Args:
        captures: folders of different names.
        settings: without a budget.
        timed: what is fitted to the budget.
        out: gets a folder for each run.

    Returns:
        A row each: `capture`, `preset`, `budget_s` (what the preset took), `seconds` (what the run with that budget
        took), `late` (by what share of the budget later), and for photos and projections that were kept back
        [of the preset, in its time] in dB, None where there are none.

    Raises:
        SettingError: two captures have the same name; a budget is too short.
        CaptureError, DiskFullError, RunFolderError: as `pipeline.reconstruct`.
        Cancelled: the user asked to stop; the same call goes on.
    """
    reporter, rows = reporter or Reporter(), []
    names = [Path(capture).resolve().name for capture in captures]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise SettingError(f"two of the captures are called '{twice}'; rename one of them.")
    for capture, name in zip(captures, names, strict=True):
        read = read_capture(Path(capture), reporter.check)
        for chosen in settings:
            folder = Path(out) / f"{name}-{chosen.preset}"
            whole = reconstruct(read, folder, settings=chosen, reporter=reporter)
            budget = float(whole["seconds_in_all"])
            in_time = replace(timed, time_budget_s=budget)
            again = reconstruct(read, folder.with_name(f"{folder.name}-s-time"), settings=in_time, reporter=reporter)
            seconds = float(again["seconds_in_all"])
            row = {"capture": name, "preset": chosen.preset, "budget_s": budget, "seconds": seconds}
            found = {kind: [_held_out(report, kind) for report in (whole, again)] for kind in KINDS}
            rows.append({**row, "late": seconds / budget - 1, **found})
    return rows


def _held_out(report: dict[str, Any], kind: str) -> float | None:
    psnr = (report["heldout"].get(kind) or {}).get("psnr")
    return None if psnr is None else float(psnr)
