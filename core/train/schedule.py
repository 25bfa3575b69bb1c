"""What changes over an optimisation: learning rates, harmonics, image size."""

from __future__ import annotations

from dataclasses import dataclass


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
