"""Which iterations are left out where steps turn out to take longer than they were given."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from .loop import Task

# Steps whose mean tells what the next ones will take.
_STEPS = 40
# The share of the rest that is made however late it is.
_LEAST = 0.25


class Rhythm:
    """Leaves out iterations of an optimisation, so that the last of its schedule is reached when its time is over.

    Steps take up to a third more or less than those that were timed before the run, on one and the same machine. Broken
    off at the end of its time, a fit misses the low rates at the end of its schedule: the Shepp-Logan head had 28.5 dB
    where 2415 iterations were broken off, 30.0 and 30.2 to the end of its schedule. So, when the number of splats no
    longer grows, as many of the rest are made as there is time for, all over the rest. Which are left out is drawn by
    their numbers, for every n-th projection has its smoothness. Where little or nothing is left of its time by then, a
    fourth of them is made, at the cost of the parts after it, as far as the deadline allows. Held-out views that are
    still to be measured, the last time after the last step, take some of its time, too: what photos show besides the
    object is fitted to each, which may take as long as hundreds of steps.
    """

    def __init__(self, task: Task) -> None:
        self._task = task
        self._taken: deque[float] = deque(maxlen=_STEPS)
        self._measure_s = task.measure_s

    def measured(self, seconds: float) -> None:
        """Held-out views were, which took so long without compiling."""
        self._measure_s = seconds

    def took(self, seconds: float) -> None:
        """A step did, without compiling."""
        self._taken.append(seconds)

    def leaves_out(self, iteration: int, made: int, now: float) -> bool:
        """Whether an iteration is not made, after so many that were.

        Args:
            now: seconds of the run.
        """
        task = self._task
        if task.aim is None or made < task.least or len(self._taken) < _STEPS:
            return False
        if iteration < task.settled_splats * task.iterations:
            return False
        needed = (task.iterations - iteration) * float(np.mean(self._taken))
        now += self._measure_s * sum(due > iteration for due in task.due)
        late = _LEAST * needed if task.deadline is None else min(_LEAST * needed, task.deadline - now)
        left = max(task.aim - now, late)
        return bool(np.random.default_rng([5, iteration]).random() * needed >= left)
