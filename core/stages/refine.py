"""Refining some of a set's parameters under a loss: what `internal` and `fuse` have in common."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Any

import numpy as np
from torch import Tensor

from ..gaussians import GaussianSet
from ..progress import Reporter, Tick, unstopped
from ..train.loop import Measured, Task, optimise
from ..train.parameters import Parameters
from ..train.schedule import Decay

Loss = Callable[[GaussianSet, int], Tensor]

_FIELDS = {"sh_dc": "sh", "sh_rest": "sh"}


def refine(
    gaussians: GaussianSet,
    rates: Mapping[str, Decay],
    loss: Loss,
    task: Task,
    reporter: Reporter,
    density_unit: float = 1.0,
    measure: Callable[[GaussianSet], Measured] | None = None,
) -> tuple[GaussianSet, dict[str, Any]]:
    """Adam on the groups named in `rates`; all other fields come back bit for bit, and so does the number of splats.

    A step whose loss or gradient is not finite is left out, so that one bad view cannot ruin the set.

    Args:
        gaussians: numpy set.
        rates: learning rate of each group to train (`core.train.parameters.GROUPS`), of its raw numbers: means in the
            set's units, logarithms of scales, logits of opacities.
        loss: of the torch set and the iteration's number; must depend on nothing else that changes.
        task: names for progress and checkpoint, number of iterations.
        reporter: progress out, cancel in.
        density_unit: mm⁻¹ that raw densities are measured in.
        measure: of a numpy set on held-out views, asked now and then.

    Returns:
        The refined numpy set and the loop's history.

    Raises:
        Cancelled: the user asked to stop; a checkpoint is kept.
    """
    if task.iterations < 1 or not rates or len(gaussians) == 0:
        return gaussians, {"iterations": 0, "losses": [], "heldout": [], "skipped_steps": 0, "seconds": 0.0}
    refiner = _Refiner(gaussians, rates, loss, task.iterations, density_unit, measure)
    history = optimise(refiner, task, reporter)
    return refiner.result(), history


def train_only(gaussians: GaussianSet, *names: str) -> GaussianSet:
    """The torch set with all fields but `names` cut off from the graph."""
    return replace(
        gaussians, **{f.name: getattr(gaussians, f.name).detach() for f in fields(gaussians) if f.name not in names}
    )


def median_spacing(points: np.ndarray) -> float:
    """Median distance of points (N, 3) to their nearest neighbour; 0 for fewer than two."""
    if len(points) < 2:
        return 0.0
    from scipy.spatial import cKDTree

    return float(np.median(cKDTree(points).query(points, k=2)[0][:, 1]))


class _Refiner:
    """A `core.train.loop.Trainer` over a fixed number of splats."""

    def __init__(
        self,
        gaussians: GaussianSet,
        rates: Mapping[str, Decay],
        loss: Loss,
        iterations: int,
        density_unit: float,
        measure: Callable[[GaussianSet], Measured] | None,
    ) -> None:
        self._start, self._rates, self._loss = gaussians, rates, loss
        self._iterations, self._measure = iterations, measure
        self._parameters = Parameters(gaussians, tuple(rates), density_unit)

    def __len__(self) -> int:
        return len(self._parameters)

    def step(self, iteration: int) -> float:
        total = self._loss(self._parameters.activate(), iteration)
        value = float(total.detach())
        # A section that misses every splat has no gradient to follow.
        if not np.isfinite(value) or not total.requires_grad:
            return value
        total.backward()
        fraction = iteration / self._iterations
        moved = self._parameters.step({name: rate.at(fraction) for name, rate in self._rates.items()})
        return value if moved else float("nan")

    def measure(self, tick: Tick = unstopped) -> Measured:
        tick()
        return {} if self._measure is None else self._measure(self.result())

    def result(self) -> GaussianSet:
        current = self._parameters.to_set()
        trained = {_FIELDS.get(name, name) for name in self._rates}
        return replace(self._start, **{name: getattr(current, name) for name in trained})

    def state(self) -> dict[str, Any]:
        return self._parameters.state()

    def restore(self, state: dict[str, Any]) -> None:
        self._parameters.restore(state)
