"""The optimisation loop: progress, checkpoints, cancel, resume."""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from ..compiled import work_clock
from ..errors import Cancelled
from ..files import atomic_write
from ..progress import Progress, Reporter, Tick, unstopped
from ..render.kernels.cpu import announce
from .rhythm import Rhythm
from .schedule import Stop, Until

_SAVE_SECONDS = 20.0
Measured = dict[str, float]
"""Mean PSNR in dB by what was held out: "photos", "projections" or "sections"; what the trainer fits comes first."""


class Trainer(Protocol):
    """What the loop drives. Random choices must follow from the iteration's number, not from a running state.

    One that does more for a while than in most steps, so that those say nothing of what later ones take, has a `usual`
    that is false meanwhile.
    """

    def __len__(self) -> int:
        """Number of splats."""

    def step(self, iteration: int) -> float:
        """One iteration; returns its loss."""

    def measure(self, tick: Tick = unstopped) -> Measured:
        """On held-out views, {} when there are none; `tick` is called between views."""

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
        measures: how many times held-out views are measured on the way, evenly.
        message: said once at the start.
        renderers: what the steps draw with on the `cpu` kernel; the user is told when it has yet to be compiled.
        deadline: seconds of the run (`Reporter.seconds`) at which it ends, whatever it has reached; none if None.
        least: iterations that are made even after the deadline.
        aim: seconds of the run at which its schedule is to end: see `rhythm.Rhythm`; none if None.
        settled_splats: fraction of the iterations after which there are no more splats than before.
        tell: called in the end with the shares of the iterations that were made, and of the measurements.
        until: ends it when held-out views are good enough, or will not be; none if None.
        settled: see `Until.verdict`.
        stop: ends the optimisation early; the trainer then has a method `validate` like `measure`, of views set aside
            for this.
        measure_s: seconds that held-out views are expected to take each time, until they were measured once; see
            `rhythm.Rhythm`.
    """

    stage: str
    part: str
    iterations: int
    first: float = 0.0
    last: float = 1.0
    checkpoint: Path | None = None
    measures: int = 8
    message: str = ""
    renderers: tuple[str, ...] = ()
    deadline: float | None = None
    least: int = 0
    aim: float | None = None
    settled_splats: float = 0.0
    tell: Callable[[float, float], None] | None = None
    until: Until | None = None
    settled: float = 0.0
    stop: Stop | None = None
    measure_s: float = 0.0

    def share(self, done: int) -> float:
        """How far the stage is after that many iterations, as a fraction."""
        return min(self.first + (self.last - self.first) * done / self.iterations, 0.999)

    @property
    def due(self) -> set[int]:
        """The iterations after which held-out views are measured."""
        return {round(self.iterations * (i + 1) / self.measures) for i in range(self.measures)}


def known(figures: Mapping[str, float | None]) -> Measured:
    """Those that could be measured."""
    return {name: value for name, value in figures.items() if value is not None}


def optimise(trainer: Trainer, task: Task, reporter: Reporter) -> dict[str, Any]:
    """Runs all iterations that there is time for, from the checkpoint if there is one.

    Returns:
        `iterations` made, `planned` ones, `left_out` (those on the way that there was no time for, see
        `rhythm.Rhythm`), `seconds` by `work_clock` (those before it was broken off included), `losses` (up to a hundred
        (iteration, loss) pairs), `heldout` (for each time it was measured `iteration`, `seconds` of the run so far,
        `splats` and what is `Measured`), `ended` (why before its last iteration, where a deadline or `until` did),
        `skipped_steps` (whose loss or gradient was not finite), `validation` ((iteration, PSNR) pairs, with
        `task.stop`).

    Raises:
        Cancelled: the user asked to stop; a checkpoint is kept.
    """
    history: dict[str, Any] = {"losses": [], "heldout": [], "skipped_steps": 0, "left_out": 0, "seconds": 0.0}
    if task.stop is not None:
        history["validation"] = []
    start = _restore(task, trainer, history)
    if start < task.iterations and task.renderers:
        announce(reporter, Progress(task.stage, task.part, task.share(start), splats=len(trainer)), task.renderers)
    saved, begun = time.monotonic(), work_clock()
    before = history["seconds"]
    done, rhythm = start, Rhythm(task)
    loss = float("nan")
    try:
        # A run that was broken off while it was measured goes on with that.
        if start:
            _measure(task, trainer, start, history, reporter, rhythm)
        if history["heldout"]:
            # Who listens now has not heard of them.
            place = (task.stage, task.part, task.share(start), start, task.iterations)
            reporter.update(Progress(*place, splats=len(trainer), heldout=list(history["heldout"])))
        for iteration in range(start, task.iterations):
            if task.stop is not None and task.stop.is_flat([psnr for _, psnr in history["validation"]]):
                break
            ended = _why_to_end(task, iteration, history, reporter)
            if ended:
                history["ended"] = ended
                break
            if rhythm.leaves_out(iteration, done - history["left_out"], reporter.seconds()):
                history["left_out"] += 1
            else:
                stepped = work_clock()
                loss = trainer.step(iteration)
                if getattr(trainer, "usual", True):
                    rhythm.took(work_clock() - stepped)
                history["skipped_steps"] += not np.isfinite(loss)
                if iteration % max(1, -(-task.iterations // 100)) == 0 and np.isfinite(loss):
                    history["losses"].append([iteration, loss])
            done = iteration + 1
            measured = _measure(task, trainer, done, history, reporter, rhythm)
            history["seconds"] = before + work_clock() - begun
            reporter.update(
                Progress(
                    task.stage,
                    part=task.part,
                    fraction=task.share(done),
                    iteration=done,
                    iterations=task.iterations,
                    loss=loss if np.isfinite(loss) else None,
                    heldout_psnr=next(iter(measured.values()), None),
                    heldout=history["heldout"][-1:] if measured else None,
                    splats=len(trainer),
                    message=task.message if iteration == start else "",
                )
            )
            if time.monotonic() - saved > _SAVE_SECONDS:
                _save(task, trainer, done, history)
                saved = time.monotonic()
    except Cancelled:
        history["seconds"] = before + work_clock() - begun
        _save(task, trainer, done, history)
        raise
    # A later part of the stage that is cancelled must not cost this one again.
    _save(task, trainer, done, history)
    made = done - history["left_out"]
    if task.tell is not None and task.iterations:
        task.tell(made / task.iterations, len(history["heldout"]) / max(len(task.due), 1))
    return {"iterations": made, "planned": task.iterations, **history}


def _why_to_end(task: Task, done: int, history: dict[str, Any], reporter: Reporter) -> str:
    """What the user asked to end it for, "" to go on."""
    if task.deadline is not None and done >= task.least and reporter.seconds() > task.deadline:
        return "its time was up"
    if task.until is None:
        return ""
    verdict = task.until.verdict(history["heldout"], task.iterations, task.settled)
    return f"{task.until.psnr:g} dB of {task.until.kind}: {verdict}" if verdict else ""


def _measure(
    task: Task, trainer: Trainer, done: int, history: dict[str, Any], reporter: Reporter, rhythm: Rhythm
) -> Measured:
    """Adds to the history what is due after `done` iterations and not there yet; returns what was measured."""
    measured: Measured = {}
    if done in task.due and done not in [point["iteration"] for point in history["heldout"]]:
        # Of the model as it is now, not of what measuring takes.
        seconds, begun = reporter.seconds(), work_clock()
        measured = trainer.measure(reporter.check)
        rhythm.measured(work_clock() - begun)
        if measured:
            history["heldout"].append({"iteration": done, "seconds": seconds, "splats": len(trainer), **measured})
    if task.stop is not None and task.stop.looks(done, task.iterations) and done not in dict(history["validation"]):
        value = trainer.validate(reporter.check)  # type: ignore[attr-defined]
        if value is not None:
            history["validation"].append([done, value])
    return measured


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
