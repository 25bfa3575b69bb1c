"""Whether a part of the smoothness tells more of projections that are not trained on, tried while a fit goes on.

How much an object bears is not known before: the weight by which true sections of walls of one density gain 2.4 dB
takes 2.4 dB of those of a cast engine, whose grain it smooths away. Noise does not tell: with ten times as many photons
walls gained as much.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...errors import SettingError

_LEAST_VIEWS = 4


@dataclass(frozen=True)
class SmoothTrial:
    """Two fits that go on side by side for some iterations, one with all of the weight and one with a part of it.

    Both see the same projections and smooth the same blocks, so that what they differ by is the weight's alone. Some
    training projections are set aside until it is decided, never held-out ones, which only measure.

    Attributes:
        share: of the weight, for the other fit.
        begin: fraction of the iterations after which it begins. Earlier, rates are so high that chance decides.
        steps: how many iterations it takes; none of fits with fewer than ten times as many.
        every: iterations between two looks at the projections set aside. A look sees one moment, and rates are still
            such that it may be off by half a decibel.
        settle: iterations before the first look: what is smoothed less fits more at once, whether that is there or
            not.
        aside: one of so many training projections is set aside, but four at least.
        fewest: training projections; with fewer the weight stays, which then matters most.
        least_db: by so much the part must be better, what is smoothed less always being ahead by a little at first.

    Raises:
        SettingError: a share that is not between 0 and 1, or no look.
    """

    share: float = 0.3
    begin: float = 2 / 3
    steps: int = 250
    every: int = 25
    settle: int = 100
    aside: int = 10
    fewest: int = 20
    least_db: float = 0.15

    def __post_init__(self) -> None:
        if not 0 <= self.share < 1:
            raise SettingError("share is {share}; give a part of the smoothness, from 0 to below 1.", share=self.share)
        if not 0 < self.every <= self.settle < self.steps:
            raise SettingError(
                "every is {every}, settle {settle}, steps {steps}; give whole numbers above 0 that grow in this order.",
                every=self.every,
                settle=self.settle,
                steps=self.steps,
            )

    def suits(self, iterations: int, training: int) -> bool:
        """Whether there is time for it, and projections to set aside."""
        return iterations >= 10 * self.steps and training >= self.fewest

    def set_aside(self, training: np.ndarray) -> np.ndarray:
        """Indices, evenly spread, out of those (N,) trained on."""
        count = max(_LEAST_VIEWS, len(training) // self.aside)
        return training[((np.arange(count) + 0.5) * len(training) / count).astype(int)]


@dataclass
class TrialRun:
    """How far a trial has come.

    Attributes:
        made: iterations.
        gains_db: for each look, by how much (V,) projections set aside are better with the part of the weight.
    """

    settings: SmoothTrial
    made: int = 0
    gains_db: list[list[float]] = field(default_factory=list)

    @property
    def looks(self) -> bool:
        """Whether projections set aside are looked at after as many iterations."""
        return self.made >= self.settings.settle and self.made % self.settings.every == 0

    @property
    def over(self) -> bool:
        """Whether it can be decided."""
        return self.made >= self.settings.steps

    def verdict(self) -> dict[str, float]:
        """`share` of the weight to go on with, `gain_db` of the part and its standard error `error_db`.

        All of the weight stays unless the part is better by more than `least_db` and that error: of models that cannot
        be told apart the plainer one (Breiman et al., Classification and Regression Trees, 1984, have such a rule).
        """
        by_view = np.mean(self.gains_db, axis=0)
        if not by_view.size:
            return {"share": 1.0}
        gain, error = float(by_view.mean()), float(by_view.std() / np.sqrt(max(by_view.size - 1, 1)))
        less = gain > max(self.settings.least_db, error)
        return {"share": self.settings.share if less else 1.0, "gain_db": gain, "error_db": error}

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"made": self.made, "gains_db": [list(gains) for gains in self.gains_db]}

    def restore(self, state: dict[str, Any]) -> None:
        """From a checkpoint."""
        self.made, self.gains_db = int(state["made"]), [list(gains) for gains in state["gains_db"]]
