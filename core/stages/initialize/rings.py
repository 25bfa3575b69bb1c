"""What detector pixels add to all views alike, told from the object by a fit of its own, before anything else is made.

The fit is a first one, much smoother than that of `surface`, but for edges: rings go into the model less, and all that
follows, the FDK and the reference of the report among it, has projections without them.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING

from ...progress import Progress
from ...told import Told
from ...train.loop import Task, optimise
from ...train.smoothness import EDGE
from ..context import StageContext

if TYPE_CHECKING:
    from ...effects.choose import Choice
    from ..surface.xray import XraySettings

# With 1000 and 8000 splats a terracotta figure leaves so much of itself that 61 and 71 % of what gains of 2 % cost are
# won back (projections, true volume), not 70 and 94; with 3000 and 20,000 it is 73 and 93.
STEPS, _MOST_SPLATS = 2000, 15_000
# Of both, in a run with a time budget: the steps of the model itself are worth more.
_IN_TIME = 0.5
OF_BUDGET = 0.15
"""Against a time this share of it may be spent on telling."""
# Five times that of `standard`. Of ellipsoids' even offsets 0.24 are left by it; a fifth of it that smooths edges, too,
# leaves 0.28.
_SMOOTH_WEIGHT = 0.5
# A matryoshka's views share 84 % of what is not smooth, those of a terracotta figure 64 %, of ellipsoids 35 and 53 %.
_MOST_ALIKE = 0.8
# Ellipsoids, a terracotta figure, a skull and a pharaoh leave 0.98 to 1.06 times the energy of gains of 2 %, a
# matryoshka, whose outlines are the same in all views, 1.2. It loses by it.
_MOST_ENERGY = 1.1
_NO_TIME = Told("It is not taken out: the time budget is too short for a fit that tells pixels from the object.")
_LEFT = Told(
    "It is not taken out: what all views show alike is the object's as much, as of a body of revolution, and a fit "
    "cannot tell the two apart."
)


def settings_of_fit(against_time: bool) -> XraySettings:
    """How the fit is made, against a time with half of its steps and splats."""
    from ..short_fit import short_settings

    share = _IN_TIME if against_time else 1.0
    short = short_settings(int(share * STEPS), int(share * _MOST_SPLATS))
    return replace(short, smooth_weight=_SMOOTH_WEIGHT, smooth_edge=EDGE)


def learn_offsets(
    context: StageContext, choice: Choice, first: float, last: float, left_out: Iterable[str] = ()
) -> None:
    """Adds the pixels' offsets to what is known of `ring`, if it is in use; where the object leaves too much that looks
    like them it is no longer.

    Args:
        choice: of the effects; the others are taken out of the projections first, unless it has these already. Its
            projections go without the offsets, too, then.
        first, last: the share of `initialize` that it takes, for its progress.
        left_out: effects that were in use when it was done before: that fit has nothing to say of this one.

    Raises:
        CaptureError: the projections cannot be reconstructed.
        Cancelled: the user asked to stop; a checkpoint is kept.
    """
    given, numbers = context.capture.projections, choice.numbers.get("ring")
    if given is None or numbers is None:
        return
    from ...effects import ring
    from ...effects.choose import leave, without_effects
    from ...effects.finding import say
    from ...effects.rays import RayEvidence
    from ...effects.ring_offsets import RingOffsets, alike
    from ..short_fit import short_trainer

    started = time.monotonic()
    row = next(row for row in choice.rows if row["name"] == "ring")

    def leave_it(why: Told) -> None:
        del choice.numbers["ring"]
        leave(row, why)

    projections = choice.without
    if projections is None:
        projections = without_effects(given, choice.numbers, context.reporter.check)
    if alike(projections, numbers["deviation"], context.reporter.check) > _MOST_ALIKE:
        leave_it(_LEFT)
        return
    volume = RayEvidence(projections, context.reporter.silent(), context.seed).volume
    settings = settings_of_fit(against_time=context.pace is not None)
    steps = settings.iterations
    shown = int((~projections.held_out).sum())
    height, width = projections.images.shape[1:]
    offsets = RingOffsets((height, width), shown, steps, numbers["deviation"])
    here = Progress("initialize", "rings", first)
    # What the fit leaves is averaged over all views: it has to follow the object as close behind thick parts.
    trainer = short_trainer(context, replace(projections, noise=None), volume, settings, here, offsets)
    checkpoint = context.checkpoint("initialize", "-without-".join(["rings", *sorted(left_out)]))
    message = Told("telling detector pixels from the object")
    task = Task("initialize", "rings", steps, first, last, checkpoint, 0, message, context.compiled("radiograph"))
    if context.pace is not None:
        # A run that was broken off gets no more time for this.
        ends = context.reporter.seconds() + OF_BUDGET * context.pace.budget_s
        task = replace(task, deadline=context.once("initialize", "rings-pace", lambda: {"deadline": ends})["deadline"])
    made = optimise(trainer, task, context.reporter)
    row["seconds"] += time.monotonic() - started
    if "ended" in made:
        leave_it(_NO_TIME)
        return
    if offsets.energy > _MOST_ENERGY:
        leave_it(_LEFT)
        return
    choice.numbers["ring"] = {**numbers, "offsets": offsets.values}
    choice.without = ring.corrected(projections, choice.numbers["ring"], context.reporter.check)
    size = 100 * float(offsets.values.std()) / projections.peak(trainer.training)
    say(row, Told("Of that {percent:.2g} % was told from the object by a fit and taken out.", percent=size))
