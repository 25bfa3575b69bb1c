"""What changes over an optimisation: learning rates, harmonics, image size, and which view is shown."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, TypeVar

import numpy as np

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    class Scheduled(DataclassInstance, Protocol):
        """Settings with a number of iterations and fields called `…_rate`."""

        @property
        def iterations(self) -> int: ...


Item = TypeVar("Item")
Rated = TypeVar("Rated", bound="DataclassInstance")
Planned = TypeVar("Planned", bound="Scheduled")


@dataclass(frozen=True)
class Decay:
    """A value that falls exponentially from `start` to `end` (constant if None)."""

    start: float
    end: float | None = None

    def at(self, fraction: float) -> float:
        """The value at a fraction 0..1 of the iterations."""
        if self.end is None or self.start <= 0:
            return self.start
        return float(self.start * (self.end / self.start) ** min(max(fraction, 0.0), 1.0))

    def times(self, factor: float) -> Decay:
        """So many times as large all along."""
        return Decay(factor * self.start, None if self.end is None else factor * self.end)

    def to_the_power(self, exponent: float) -> Decay:
        """With an exponent of a half it falls half as far, from half as far away from 1 (as logarithms)."""
        return Decay(self.start**exponent, None if self.end is None else self.end**exponent)


def hotter(settings: Rated, factor: float, but: Collection[str] = ()) -> Rated:
    """With so many times all of its rates `but` some; effects of photos have theirs."""
    changed: dict[str, Any] = {}
    for name in [one.name for one in fields(settings) if one.name.endswith("_rate") and one.name not in but]:
        rate = getattr(settings, name)
        changed[name] = rate.times(factor) if isinstance(rate, Decay) else factor * rate
    return replace(settings, **changed)


def in_iterations(settings: Planned, iterations: int, but: Collection[str] = ()) -> Planned:
    """For more or fewer iterations than those that the settings were made for.

    With n times the iterations the rates are n^-½ times as large; in fewer, splats are added sooner. A `draft` of 100
    has 23.9 dB of the matryoshka's true sections at six times the rates of `standard`, 23.2 at four times and 21.9 at
    twice, which are those of 1000; one of 250 has 29.4 at four times and 28.3 at twice, of the toy gun's 46.7 and 44.3;
    one of 500 50.1 of these at 2.8 times and 49.3 at twice. Photos of six captures were 0.8 to 1.8 dB better after 250
    at twice the rates of 1000.

    Args:
        but: rates that stay.
    """
    if iterations == settings.iterations:
        return settings
    share = iterations / settings.iterations
    changed: dict[str, Any] = {"iterations": iterations}
    strategy = getattr(settings, "strategy", None)
    if strategy is not None:
        changed["strategy"] = strategy.sooner(share)
    return hotter(replace(settings, **changed), share**-0.5, but)


def shuffled(items: Sequence[Item] | np.ndarray, iteration: int, *seeds: int) -> Item:
    """The item of an iteration: each once per round, in an order that changes from round to round."""
    lap, place = divmod(iteration, len(items))
    return items[int(np.random.default_rng([*seeds, lap]).permutation(len(items))[place])]


def active_degree(iteration: int, interval: int, highest: int) -> int:
    """Degree of the colour functions in use: one more every `interval` iterations (3DGS: 1000)."""
    return min(iteration // max(interval, 1), highest)


@dataclass(frozen=True)
class Growth:
    """Images that grow while an optimisation goes on: fewer pixels while splats are still far off.

    Attributes:
        steps: (fraction of the iterations up to which it holds, share of the image's side), in order. The rest is
            at full size.
    """

    steps: tuple[tuple[float, float], ...] = ()

    def share(self, fraction: float) -> float:
        """Share of the full side length at a fraction 0..1 of the iterations."""
        for until, share in self.steps:
            if fraction < until:
                return share
        return 1.0


@dataclass(frozen=True)
class Until:
    """A held-out figure that is good enough, or that cannot be had.

    Attributes:
        kind: what is measured, "photos" or "projections".
        psnr: dB, mean over the views measured on the way.
    """

    kind: str
    psnr: float

    # Before half of the steps images are small and splats few; what the last steps' low rates bring comes on top.
    _EARLIEST: ClassVar[float] = 0.5
    _LATE_GAIN_DB: ClassVar[float] = 1.5
    _MOST_LASTING: ClassVar[float] = 0.9

    def verdict(self, points: Sequence[Mapping[str, float]], iterations: int, settled: float = 0.0) -> str:
        """ "reached", "out of reach", or "" to go on, after the measured points of an optimisation of `iterations`.

        Out of reach is what is more than 1.5 dB above where the curve leads when its gains go on to shrink, from
        one point to the next, as they did; after a fall nobody knows, and they are taken to last. A last point that
        fell may be chance: the next one tells.

        Args:
            settled: fraction of the iterations up to which something throws the figures back now and then; where
                the curve leads is seen from later points alone.
        """
        known = [(point["iteration"], point[self.kind]) for point in points if self.kind in point]
        if known and known[-1][1] >= self.psnr:
            return "reached"
        known = [(iteration, value) for iteration, value in known if iteration > settled * iterations]
        if len(known) < 3 or known[-1][0] < self._EARLIEST * iterations:
            return ""
        gains = [later - sooner for (_, sooner), (_, later) in pairwise(known)]
        if gains[-1] < 0 <= gains[-2]:
            return ""
        lasting = max(gains[-1], 0.0) / max(gains[-2], 1e-9)
        lasting = min(lasting, self._MOST_LASTING)
        ahead = round((iterations - known[-1][0]) / max(known[-1][0] - known[-2][0], 1))
        coming = sum(max(gains[-1], 0.0) * lasting**step for step in range(1, ahead + 1))
        return "out of reach" if known[-1][1] + coming + self._LATE_GAIN_DB < self.psnr else ""


@dataclass(frozen=True)
class Stop:
    """When an optimisation ends before its last iteration: the curve on views set aside for this has gone flat.

    Those views are taken from the training views, never from the held-out ones, which only measure.

    Attributes:
        views: how many training views are set aside.
        every: iterations between two looks, as a fraction of all.
        gain_db: least PSNR that counts as a gain over the best so far.
        patience: looks in a row without a gain, after which it ends.
        least: no look before this fraction of the iterations.
    """

    views: int = 4
    every: float = 0.05
    gain_db: float = 0.05
    patience: int = 3
    least: float = 0.5

    def looks(self, done: int, iterations: int) -> bool:
        """Whether the curve is looked at after `done` iterations."""
        return done >= self.least * iterations and done % max(1, round(self.every * iterations)) == 0

    def is_flat(self, curve: Sequence[float]) -> bool:
        """Whether the last `patience` values of a curve (dB) brought no gain over those before."""
        if len(curve) <= self.patience:
            return False
        return max(curve[-self.patience :]) < max(curve[: -self.patience]) + self.gain_db

    def set_aside(self, count: int) -> list[int]:
        """Evenly spread places of the views set aside out of `count`; none where fewer than two would stay."""
        views = min(self.views, count - 2)
        return [round((place + 0.5) * count / views) for place in range(views)] if views > 0 else []
