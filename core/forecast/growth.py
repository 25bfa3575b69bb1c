"""How many splats a training has on its way, and what its steps take on average."""

from __future__ import annotations

import numpy as np

from ..train.mcmc import McmcStrategy
from ..train.schedule import Growth
from ..train.strategy import DefaultStrategy, Strategy
from .speed import StepTime

# Of Gompertz's curve, a densification.
_RATE = 0.13
# Steps of the schedule that are looked at: splats and image sizes change slowly.
_SAMPLES = 50


def grown(first: float, most: float, strategy: DefaultStrategy | McmcStrategy, iterations: int) -> float:
    """Photo splats in the end, where the strategy's limit lies higher.

    Args:
        first: at the beginning.
        most: that there is detail for.
    """
    last, first_step = int(strategy.stop * iterations), int(strategy.start * iterations)
    times = last // strategy.every - first_step // strategy.every
    if isinstance(strategy, McmcStrategy):
        return float(first * (1 + strategy.growth) ** times)
    return float(most * min(first / most, 1.0) ** np.exp(-_RATE * times)) if most > 0 else first


def mean_step(
    step: StepTime,
    splats: tuple[float, float],
    pixels: float,
    growth: Growth,
    strategy: Strategy,
) -> float:
    """Mean seconds of a step while splats grow from the first number to the last and images to their full size."""
    total = 0.0
    for fraction in (np.arange(_SAMPLES) + 0.5) / _SAMPLES:
        total += step.seconds(splats_then(splats, strategy, fraction), pixels * growth.share(fraction) ** 2)
    return total / _SAMPLES


def splats_then(splats: tuple[float, float], strategy: Strategy, fraction: float) -> float:
    """Splats after a fraction of a training whose splats grow from the first number to the last."""
    (first, last), densify = splats, strategy.densify
    share = np.clip((fraction - densify.start) / max(densify.stop - densify.start, 1e-9), 0.0, 1.0)
    return float(first + (last - first) * share)
