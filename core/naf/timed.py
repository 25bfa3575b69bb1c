"""NAF for a given time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ..capture.model import Projections
from ..progress import Reporter
from ..train.budget import iterations_for
from ..volume import Volume
from .train import NafSettings, NafTrainer, naf


def naf_within(
    seconds: float,
    projections: Projections,
    attenuation: float,
    folder: Path,
    settings: NafSettings | None = None,
    seed: int = 0,
    reporter: Reporter | None = None,
) -> Volume:
    """What NAF finds in a time: as many of its iterations as fit, all else as published.

    Args:
        seconds: for the iterations.
        projections, attenuation: see `NafTrainer`.
        folder: for the number of iterations and the checkpoint; the same folder goes on where it was broken off.
        settings: without its number of iterations.

    Raises:
        SettingError: a setting or a time out of range.
        Cancelled: through `reporter`.
    """
    chosen = settings or NafSettings()
    count = iterations_for(
        seconds,
        lambda: NafTrainer(projections, attenuation, chosen, seed),
        folder / "budget.json",
        reporter,
        most=chosen.iterations,
        least=min(100, chosen.iterations),
    )
    chosen = replace(chosen, iterations=count)
    return naf(projections, attenuation, chosen, seed, reporter, folder / "naf.checkpoint.pt")[0]
