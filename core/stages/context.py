"""What every stage is given."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..capture.model import Capture, Projections
from ..effect_names import BEFORE_CAMERAS, BEFORE_SPLATS
from ..forecast.pace import Pace, least_steps
from ..progress import Progress, Reporter
from ..render.options import SplatOptions
from ..resume import once
from ..run_folder import RunFolder
from .effects import RunEffects
from .measures import UNTIL, UNTIL_WITH_EFFECTS

if TYPE_CHECKING:
    from ..effects import Effect
    from ..effects.request import Request
    from ..train.loop import Task
    from ..train.schedule import Until

# Parts that look at no photos.
_WITHOUT_PHOTOS = ("surface xray", "internal xray", "internal display")


@dataclass(frozen=True)
class StageContext:
    """One run's capture, folder and helpers.

    Attributes:
        capture: what the user brought.
        run: where stages read their predecessors' files and leave their own.
        seed: of every random choice.
        kernel: "cpu", "cuda" or "reference".
        reporter: progress out, cancel in.
        pace: fits the run into its time budget; None where it has none.
        until: what is good enough; None to make all steps.
        photo_effects: what photos show besides the object, as a script asked `surface` to learn it, whatever else is
            asked for.
        request: the effects to look for in `initialize`, and to use; None for none.
        photo_side: pixels that `surface` scales photos down to.
        photo_options: how it was asked to draw splats in them; how it does, with what was found, is `SplatOptions.of`.
    """

    capture: Capture
    run: RunFolder
    seed: int = 0
    kernel: str = "cpu"
    reporter: Reporter = field(default_factory=Reporter)
    pace: Pace | None = None
    until: Until | None = None
    photo_effects: tuple[Effect, ...] = ()
    request: Request | None = None
    photo_side: int = 800
    photo_options: SplatOptions = SplatOptions()

    @cached_property
    def effects(self) -> RunEffects:
        """What the capture was found to show besides the object; not before `initialize` has looked."""
        return RunEffects(self.run.path / "initialize", self.photo_effects)

    @cached_property
    def projections(self) -> Projections | None:
        """The capture's projections, without the effects that were found in them."""
        given = self.capture.projections
        return None if given is None else self.effects.projections(given, self.reporter.check)

    def progress(self, stage: str, **details: object) -> None:
        """Shorthand for `reporter.update(Progress(stage, ...))`. Raises Cancelled."""
        self.reporter.update(Progress(stage, **details))  # type: ignore[arg-type]

    def compiled(self, *renderers: str) -> tuple[str, ...]:
        """Those renderers that Numba draws and compiles when they are first used: what a card draws is none of them."""
        drawn = {"cpu": renderers, "cuda": tuple(name for name in renderers if name == "splat_effects")}
        return drawn.get(self.kernel, ())

    def checkpoint(self, stage: str, name: str) -> Path:
        """Where an optimisation named `name` of a stage keeps its checkpoint."""
        return self.run.stage(stage) / f"{name}.checkpoint.pt"

    def paced(self, task: Task, most: float = math.inf) -> Task:
        """An optimisation with as many iterations as its time allows and with the run's `until`.

        What was chosen when it began stays when it is taken up again: schedules follow from it.

        Args:
            most: iterations, whatever the time.
        """
        name, task = f"{task.stage} {task.part}", replace(task, until=self.until)
        if self.until is not None and (self.until.kind != "photos" or name not in _WITHOUT_PHOTOS):
            measures = UNTIL_WITH_EFFECTS if self.effects.photos else UNTIL
            task = replace(task, measures=max(task.measures, measures))
        pace = self.pace
        if pace is None:
            return task
        if not self.photo_effects:
            pace.expect(name for name in self.effects.used("photos") if name not in BEFORE_CAMERAS + BEFORE_SPLATS)

        def choose() -> dict[str, Any]:
            chosen: dict[str, Any] = {"iterations": pace.iterations(name, task.iterations)}
            chosen |= {"deadline": pace.deadline(name), "aim": pace.aim(name), "measuring": pace.measuring(name)}
            return {**chosen, "begun": pace.begun(name)}

        kept = self.once(task.stage, f"{task.part}-pace", choose)
        pace.take_up(name, kept["begun"])
        iterations = int(kept["iterations"])
        if iterations > most:
            pace.made(name, most / iterations)
            iterations = int(most)
        least = least_steps(task.iterations)
        # Older versions kept nothing of measuring.
        measure_s = float(kept.get("measuring", 0.0)) / max(task.measures, 1)
        times = {"deadline": kept["deadline"], "aim": kept["aim"], "tell": partial(pace.made, name)}
        return replace(task, iterations=iterations, least=least, measure_s=measure_s, **times)

    def trained(self, stage: str, part: str, splats: int) -> None:
        """Lets the pace know how many splats a part ended with."""
        if self.pace is not None:
            self.pace.splats[f"{stage} {part}"] = splats

    def is_kept(self, stage: str, name: str) -> bool:
        """Whether `once` has this step."""
        return (self.run.stage(stage) / f"{name}.checkpoint.npz").exists()

    def once(
        self, stage: str, name: str, make: Callable[[], dict[str, Any]], leaves: Sequence[str] = ()
    ) -> dict[str, Any]:
        """What `make` returns; a stage that was broken off after this step does not make it again (`resume.once`).

        Args:
            leaves: names of files that `make` writes into the stage's folder.
        """
        folder = self.run.stage(stage)
        return once(folder / f"{name}.checkpoint.npz", make, [folder / file for file in leaves])
