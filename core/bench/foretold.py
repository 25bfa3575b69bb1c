"""Whether runs take what was foretold: the forecast of each capture, then the run itself."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..capture.read import read_capture
from ..files import write_json
from ..forecast.budget import forecasts
from ..forecast.forecast import Forecast
from ..pipeline import reconstruct
from ..progress import Reporter
from ..resume import refuse_nesting
from ..run_folder import STAGES
from ..settings import Settings
from .kept import kept_beside, made_with, names_of


def measure_forecasts(
    captures: Sequence[Path], settings: Sequence[Settings], out: Path, reporter: Reporter | None = None
) -> list[dict[str, Any]]:
    """Runs each capture with each of some settings, after it was foretold how long that takes.

    Both are kept beside the run, so that a measurement that was broken off goes on with what was foretold at first.

    Args:
        captures: folders of different names.
        out: gets a folder for each run.

    Returns:
        A row each: `capture`, `preset`, `foretold_s`, `seconds`, `off` (the difference as a share of what it took),
        `cameras` (whether they had to be found, whose time nobody can tell well), `stages` {stage or "report":
        [foretold, taken] in s}.

    Raises:
        SettingError: two captures have the same name.
        RunFolderError: `out` holds what another capture, preset, version or machine took.
        CaptureError, DiskFullError: as `pipeline.reconstruct`.
        Cancelled: the user asked to stop; the same call goes on.
    """
    reporter, rows = reporter or Reporter(), []
    for capture, name in zip(captures, names_of(captures), strict=True):
        refuse_nesting(Path(capture), Path(out))
        read = read_capture(Path(capture), reporter.check)
        for chosen in settings:
            folder = Path(out) / f"{name}-{chosen.preset}"
            kept = folder.parent / f"{folder.name}.json"
            of = made_with(read.digest, chosen)
            row = kept_beside(folder, kept, of).get("row") or {}
            if "foretold" not in row:
                found = forecasts(read, [chosen], reporter)[0]
                row = {"foretold": _by_stage(found), "cameras": found.cameras}
                write_json(kept, {"made_with": of, "row": row})
            if "taken" not in row:
                row["taken"] = _taken(reconstruct(read, folder, settings=chosen, reporter=reporter))
                write_json(kept, {"made_with": of, "row": row})
            rows.append({"capture": name, "preset": chosen.preset, **_beside(**row)})
    return rows


def _by_stage(forecast: Forecast) -> dict[str, float]:
    by_stage = dict.fromkeys((*STAGES, "report"), 0.0)
    for part, seconds in forecast.parts.items():
        by_stage[part.split()[0]] += seconds
    return by_stage


def _taken(report: dict[str, Any]) -> dict[str, float]:
    taken = {stage: float(report["stages"][stage]["seconds"]) for stage in STAGES}
    # With it counts what lies between stages.
    return {**taken, "report": float(report["seconds_in_all"]) - sum(taken.values())}


def _beside(foretold: dict[str, float], taken: dict[str, float], cameras: bool) -> dict[str, Any]:
    whole, seconds = sum(foretold.values()), sum(taken.values())
    return {
        "foretold_s": whole,
        "seconds": seconds,
        "off": whole / seconds - 1,
        "cameras": cameras,
        "stages": {stage: [foretold[stage], taken[stage]] for stage in taken},
    }
