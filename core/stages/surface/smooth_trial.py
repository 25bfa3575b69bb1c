"""Whether a part of the smoothness tells more of projections that are not trained on, tried while a fit goes on.

How much an object bears is not known before. Of true sections of walls of one density a third of the weight of presets
loses up to 0.9 dB; those of a cast engine, whose grain is smoothed away by all of it, it has 2.4 dB nearer. Noise does
not tell which it is: with ten times as many photons the walls lost 0.8.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...errors import SettingError

_LEAST_VIEWS, _MOST_VIEWS = 4, 16


@dataclass(frozen=True)
class SmoothTrial:
    """Two fits that go on side by side for some iterations, one with all of the weight and one with a part of it.

    Both see the same projections and smooth the same blocks, so that what they differ by is the weight's alone. Some
    training projections are set aside until it is decided, never held-out ones, which only measure.

    Attributes:
        share: of the weight, for the other fit.
        begin: fraction of the iterations after which it begins. Earlier, rates are so high that chance decides.
        steps: how many iterations it takes; none of fits with fewer than ten times as many. After 160 a cast
            engine and walls of one density were 0.06 dB apart, after 250 0.17.
        settle: iterations before the first look: what is smoothed less fits more at once, whether that is there or
            not.
        every: iterations between two looks, each at the next of the projections set aside. One sees one moment, and
            rates are still such that it may be off by half a decibel.
        aside: one of so many training projections is set aside, but four at least and sixteen at most.
        fewest: training projections; with fewer the weight stays, which then matters most.
        least_db: by so much the part must be better, what is smoothed less mostly being ahead by a little at first.

    Raises:
        SettingError: a share that is not between 0 and 1, no look, or too few projections to set some aside.
    """

    share: float = 0.3
    begin: float = 2 / 3
    steps: int = 250
    settle: int = 100
    every: int = 3
    aside: int = 10
    fewest: int = 20
    least_db: float = 0.15

    def __post_init__(self) -> None:
        if not 0 <= self.share < 1:
            raise SettingError("share is {share}; give a part of the smoothness, from 0 to below 1.", share=self.share)
        if self.every < 1 or self.settle < 0 or self.looks < 1:
            raise SettingError(
                "steps is {steps}, settle {settle}, every {every}; give whole numbers with a look in them: {least} "
                "steps or more.",
                steps=self.steps,
                settle=self.settle,
                every=self.every,
                least=max(self.settle, 0) + max(self.every, 1),
            )
        if self.fewest < 2 * _LEAST_VIEWS:
            raise SettingError("fewest is {fewest}; give {least} or more.", fewest=self.fewest, least=2 * _LEAST_VIEWS)

    @property
    def looks(self) -> int:
        """How many there are in all."""
        return (self.steps - self.settle) // self.every

    def suits(self, iterations: int, training: int) -> bool:
        """Whether there is time for it, and projections to set aside."""
        return iterations >= 10 * self.steps and training >= self.fewest

    def set_aside(self, training: np.ndarray) -> np.ndarray:
        """Indices, evenly spread, out of those (N,) trained on."""
        count = min(max(_LEAST_VIEWS, len(training) // self.aside), _MOST_VIEWS)
        return training[((np.arange(count) + 0.5) * len(training) / count).astype(int)]


@dataclass
class TrialRun:
    """How far a trial has come.

    Attributes:
        made: iterations.
        gains_db: for each look the index of the projection, and by how much it is better with the part of the weight.
    """

    settings: SmoothTrial
    made: int = 0
    gains_db: list[tuple[int, float]] = field(default_factory=list)

    def looks_at(self, aside: np.ndarray) -> int | None:
        """Which of the projections set aside is looked at after as many iterations; None for none."""
        since = self.made - self.settings.settle
        if since <= 0 or since % self.settings.every:
            return None
        return int(aside[(since // self.settings.every - 1) % len(aside)])

    def verdict(self) -> dict[str, float]:
        """`share` of the weight to go on with; and if anything could be seen `gain_db` of the part, its standard error
        `error_db`, and `looks`, how many say so.

        All of the weight stays unless the part is better by more than `least_db` and that error, as half of the looks
        or more say: of models that cannot be told apart the plainer one (Breiman et al., Classification and Regression
        Trees, 1984, have such a rule).
        """
        seen = [(index, gain) for index, gain in self.gains_db if np.isfinite(gain)]
        if not seen:
            return {"share": 1.0}
        by_view = np.array([np.mean([gain for i, gain in seen if i == index]) for index in {i for i, _ in seen}])
        gain, error = float(by_view.mean()), float(by_view.std() / np.sqrt(max(by_view.size - 1, 1)))
        enough = by_view.size >= _LEAST_VIEWS and 2 * len(seen) >= self.settings.looks
        less = enough and gain > max(self.settings.least_db, error)
        share = self.settings.share if less else 1.0
        return {"share": share, "gain_db": gain, "error_db": error, "looks": len(seen)}

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"made": self.made, "gains_db": [list(gain) for gain in self.gains_db]}

    def restore(self, state: dict[str, Any]) -> None:
        """From a checkpoint."""
        self.made, self.gains_db = int(state["made"]), [(int(index), float(gain)) for index, gain in state["gains_db"]]
