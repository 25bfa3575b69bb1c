"""The optimisation loop: progress, checkpoints, cancel, resume."""

from __future__ import annotations

import io
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from ..errors import Cancelled
from ..files import atomic_write
from ..progress import Progress, Reporter, Tick, unstopped
from ..render.kernels.cpu import announce
from .schedule import Stop

_SAVE_SECONDS = 20.0


class Trainer(Protocol):
    """What the loop drives. Random choices must follow from the iteration's number, not from a running state."""

    def __len__(self) -> int:
        """Number of splats."""

    def step(self, iteration: int) -> float:
        """One iteration; returns its loss."""

    def measure(self, tick: Tick = unstopped) -> float | None:
        """Mean PSNR in dB on held-out views, None when there are none; `tick` is called between views."""

    def state(self) -> dict[str, Any]:
        """All that `restore` needs to go on bit for bit: tensors and plain numbers."""

    def restore(self, state: dict[str, Any]) -> None:
        """Becomes what `state()` was taken of."""


@dataclass(frozen=True)
class Task:
    """Name and place of an optimisation.

    Attributes:
        stage, part: as in `Progress`.
        iterations: in total.
        first, last: its share of the stage, as fractions.
        checkpoint: file; none if None.
        measures: how many times the held-out PSNR is measured on the way.
        message: said once at the start.
        renderers: what the steps draw with on the `cpu` kernel; the user is told when it has yet to be compiled.
        stop: ends the optimisation early; the trainer then has a method `validate` like `measure`, of views set aside
            for this.
    """

    stage: str
    part: str
    iterations: int
    first: float = 0.0
    last: float = 1.0
    checkpoint: Path | None = None
    measures: int = 4
    message: str = ""
    renderers: tuple[str, ...] = ()
    stop: Stop | None = None

    def share(self, done: int) -> float:
        """How far the stage is after that many iterations, as a fraction."""
        return min(self.first + (self.last - self.first) * done / self.iterations, 0.999)


def optimise(trainer: Trainer, task: Task, reporter: Reporter) -> dict[str, Any]:
    """Runs all iterations, from the checkpoint if there is one.

    Returns:
        `iterations` made, `seconds` (those before it was broken off included), `losses` (about a hundred (iteration,
        loss) pairs), `heldout` ((iteration, PSNR) pairs), `skipped_steps` (whose loss or gradient was not finite),
        `validation` ((iteration, PSNR) pairs, with `task.stop`).

    Raises:
        Cancelled: the user asked to stop; a checkpoint is kept.
    """
    history: dict[str, Any] = {"losses": [], "heldout": [], "skipped_steps": 0, "seconds": 0.0}
    if task.stop is not None:
        history["validation"] = []
    start = _restore(task, trainer, history)
    if start < task.iterations and task.renderers:
        announce(reporter, Progress(task.stage, task.part, task.share(start), splats=len(trainer)), task.renderers)
    saved = begun = time.monotonic()
    before = history["seconds"]
    done = start
    try:
        # A run that was broken off while it was measured goes on with that.
        if start:
            _measure(task, trainer, start, history, reporter.check)
        for iteration in range(start, task.iterations):
            if task.stop is not None and task.stop.is_flat([psnr for _, psnr in history["validation"]]):
                break
            loss = trainer.step(iteration)
            done = iteration + 1
            history["skipped_steps"] += not np.isfinite(loss)
            if iteration % max(1, task.iterations // 100) == 0 and np.isfinite(loss):
                history["losses"].append([iteration, loss])
            heldout = _measure(task, trainer, done, history, reporter.check)
            history["seconds"] = before + time.monotonic() - begun
            reporter.update(
                Progress(
                    task.stage,
                    part=task.part,
                    fraction=task.share(done),
                    iteration=done,
                    iterations=task.iterations,
                    loss=loss if np.isfinite(loss) else None,
                    heldout_psnr=heldout,
                    splats=len(trainer),
                    message=task.message if iteration == start else "",
                )
            )
            if time.monotonic() - saved > _SAVE_SECONDS:
                _save(task, trainer, done, history)
                saved = time.monotonic()
    except Cancelled:
        history["seconds"] = before + time.monotonic() - begun
        _save(task, trainer, done, history)
        raise
    # A later part of the stage that is cancelled must not cost this one again.
    _save(task, trainer, done, history)
    return {"iterations": done, **history}


def _measure(task: Task, trainer: Trainer, done: int, history: dict[str, Any], tick: Tick) -> float | None:
    """Adds to the history what is due after `done` iterations and not there yet; returns a new held-out PSNR."""
    due = {round(task.iterations * (i + 1) / task.measures) for i in range(task.measures)}
    heldout = trainer.measure(tick) if done in due and done not in dict(history["heldout"]) else None
    if heldout is not None:
        history["heldout"].append([done, heldout])
    if task.stop is not None and task.stop.looks(done, task.iterations) and done not in dict(history["validation"]):
        value = trainer.validate(tick)  # type: ignore[attr-defined]
        if value is not None:
            history["validation"].append([done, value])
    return heldout


def _save(task: Task, trainer: Trainer, done: int, history: dict[str, Any]) -> None:
    if task.checkpoint is None:
        return
    buffer = io.BytesIO()
    content = {"iterations": task.iterations, "done": done, "history": history, "trainer": trainer.state()}
    torch.save(content, buffer)
    with atomic_write(task.checkpoint) as stream:
        stream.write(buffer.getvalue())


def _restore(task: Task, trainer: Trainer, history: dict[str, Any]) -> int:
    if task.checkpoint is None or not task.checkpoint.exists():
        return 0
    try:
        content = torch.load(task.checkpoint, weights_only=True)
        iterations, done, kept, state = (content[name] for name in ("iterations", "done", "history", "trainer"))
    except Exception:
        # A damaged checkpoint costs time, never the run; torch raises anything from UnpicklingError to IndexError.
        return 0
    if iterations != task.iterations:
        return 0
    untouched = trainer.state()
    try:
        trainer.restore(state)
    except (RuntimeError, ValueError, KeyError, IndexError, TypeError):
        trainer.restore(untouched)
        return 0
    history.update(kept)
    return int(done)
