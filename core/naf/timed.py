"""NAF for a given time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from ..capture.model import Projections
from ..compiled import work_clock
from ..progress import Reporter
from ..train.budget import iterations_in_time
from ..volume import Volume
from .train import NafSettings, NafTrainer, naf

# Steps for the first guess.
_TIMED = 13


def naf_within(
    seconds: float,
    projections: Projections,
    attenuation: float,
    folder: Path,
    settings: NafSettings | None = None,
    seed: int = 0,
    reporter: Reporter | None = None,
    at_centers: bool = False,
) -> tuple[Volume, dict[str, Any]]:
    """What NAF finds in a time, and how many of its iterations that took (`iterations_in_time`).

    Args:
        seconds: for the iterations.
        projections, attenuation: see `NafTrainer`.
        folder: for the tries and the checkpoint; the same folder goes on where it was broken off.
        settings: without its number of iterations.
        at_centers: see `NafTrainer.volume`.

    Raises:
        SettingError: a setting or a time out of range.
        Cancelled: through `reporter`.
    """
    chosen = settings or NafSettings()
    checkpoint = folder / "naf.checkpoint.pt"

    def made(count: int) -> tuple[Volume, dict[str, Any]]:
        timed = replace(chosen, iterations=count)
        return naf(projections, attenuation, timed, seed, reporter, checkpoint, at_centers)

    def first() -> int:
        trainer = NafTrainer(projections, attenuation, chosen, seed)
        start = work_clock()
        for iteration in range(_TIMED):
            if reporter is not None:
                reporter.check()
            trainer.step(iteration)
        return round(_TIMED * seconds / (work_clock() - start))

    found = iterations_in_time(
        seconds,
        first,
        lambda count, _: float(made(count)[1]["seconds"]),
        folder / "budget.json",
        {"settings": replace(chosen, iterations=1), "seed": seed},
        least=min(100, chosen.iterations),
        most=chosen.iterations,
    )
    # The last of them left its checkpoint.
    return made(found["iterations"])[0], found
