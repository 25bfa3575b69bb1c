"""The same time for every method: how many iterations fit into it."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path

from ..errors import SettingError
from ..files import write_json
from ..progress import Progress, Reporter
from .loop import Trainer

# Steps before the clock starts: kernels are loaded, buffers made.
_WARM_UP = 3
_LEAST_TIMED = 10
_SHARE = 0.03


def iterations_for(
    seconds: float,
    make_trainer: Callable[[], Trainer],
    kept: Path | None = None,
    reporter: Reporter | None = None,
    least: int = 100,
    most: int = 1_000_000,
    clock: Callable[[], float] = time.perf_counter,
) -> int:
    """How many iterations a trainer makes in a time, from its first ones: 3 % of the time, ten at least.

    A trainer that adds splats gets slower: make the one that is timed from about as many as it will have. Timing
    never comes out the same twice, so the number is kept in a file and a run that is taken up again reads it there.

    Args:
        seconds: all iterations may take.
        make_trainer: makes a trainer of its own, which is thrown away.
        kept: JSON file for the number; one that was made for another time or limits, or is damaged, is made anew.
        least, most: limits of the answer.
        clock: seconds, rising.

    Raises:
        SettingError: a time that is not above 0, or limits that leave no number.
        Cancelled: through `reporter`.
    """
    if not seconds > 0 or not 1 <= least <= most:
        raise SettingError(
            f"a budget of {seconds} s for {least} to {most} iterations leaves nothing to do; give a time above 0 "
            "and limits from 1 on, the lower first."
        )
    asked = {"seconds": float(seconds), "least": least, "most": most}
    known = _read(kept, asked)
    if known is not None:
        return known
    reporter = reporter or Reporter()
    reporter.update(Progress("compare", "budget", message="timing the first iterations"))
    a_step = _seconds_a_step(make_trainer(), seconds, reporter, clock)
    iterations = int(min(max(seconds / max(a_step, 1e-9), least), most))
    if kept is not None:
        write_json(kept, {**asked, "seconds_a_step": a_step, "iterations": iterations})
    return iterations


def _seconds_a_step(trainer: Trainer, seconds: float, reporter: Reporter, clock: Callable[[], float]) -> float:
    for iteration in range(_WARM_UP):
        reporter.check()
        trainer.step(iteration)
    start, steps = clock(), 0
    while True:
        reporter.check()
        trainer.step(_WARM_UP + steps)
        steps += 1
        passed = clock() - start
        if steps >= _LEAST_TIMED and passed >= _SHARE * seconds:
            return passed / steps


def _read(kept: Path | None, asked: dict[str, float]) -> int | None:
    if kept is None or not kept.is_file():
        return None
    try:
        content = json.loads(kept.read_text(encoding="utf-8"))
        if any(content[name] != value for name, value in asked.items()):
            return None
        iterations = content["iterations"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    fits = isinstance(iterations, int) and asked["least"] <= iterations <= asked["most"]
    return iterations if fits else None
