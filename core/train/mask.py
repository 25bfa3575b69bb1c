"""Splats that may be masked out at random, and are dropped when they always are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from ..gaussians import GaussianSet
from ..threads import Alone
from .adam import adam_step, all_finite
from .parameters import BETA1, BETA2, EPSILON, Parameters
from .strategy import DefaultStrategy, Densifier, every_sooner

# Fewer logits are moved before other threads are awake.
_FEW = 400_000


@dataclass(frozen=True)
class MaskStrategy:
    """MaskGaussian (Liu et al. 2024, arXiv 2412.20522): whether a splat exists is drawn anew in every step.

    Attributes:
        densify: what adds splats; MaskGaussian drops those that serve nothing.
        weight: of the squared share of splats that exist, in the loss.
        start: two logits, of existing and of not, that every splat begins with.
        rate: Adam's of the logits; times the iterations it is how far a logit can move, so shorter optimisations than
            the published ones of 30,000 need a larger one.
        temperature: τ of the Gumbel-softmax whose gradient stands in for the draw's.
        every: iterations between two prunings; there is one more at the end.
        draws: a splat is dropped that none of so many draws shows.
    """

    densify: DefaultStrategy = field(default_factory=DefaultStrategy)
    weight: float = 5e-4
    start: tuple[float, float] = (10.0, 1.0)
    rate: float = 0.01
    temperature: float = 1.0
    every: int = 100
    draws: int = 10

    masked: ClassVar[bool] = True

    def begin(
        self, parameters: Parameters, extent: float, iterations: int, seed: int, box: np.ndarray | None = None
    ) -> MaskDensifier:
        """The strategy at work on one optimisation."""
        return MaskDensifier(self, parameters, extent, iterations, seed, box)

    def at_most(self, splats: int) -> MaskStrategy:
        """See `Strategy.at_most`."""
        return replace(self, densify=self.densify.at_most(splats))

    def sooner(self, share: float) -> MaskStrategy:
        """See `Strategy.sooner`: prunings, densifications, and logits, which have as far to go in fewer steps."""
        every = every_sooner(self.every, share)
        return replace(self, every=every, rate=self.rate / share, densify=self.densify.sooner(share))


class MaskDensifier(Densifier):
    """Runs the strategy on the parameters of one optimisation; a `core.train.strategy.DensityControl`.

    Call `masks` before `penalty`, both before `after_step`.

    Args:
        rule: the rules.
        parameters, extent, iterations, seed, box: see `Densifier`; `seed` is also of what is drawn.
    """

    def __init__(
        self,
        rule: MaskStrategy,
        parameters: Parameters,
        extent: float,
        iterations: int,
        seed: int,
        box: np.ndarray | None = None,
    ) -> None:
        super().__init__(rule.densify, parameters, extent, iterations, seed, box)
        self._rule, self._steps = rule, 0
        self._logits = np.tile(np.array(rule.start, np.float32), (len(parameters), 1))
        self._first, self._second = np.zeros_like(self._logits), np.zeros_like(self._logits)
        self._leaf: Tensor | None = None
        self._drawn: Tensor | None = None

    def masks(self, iteration: int) -> Tensor:
        """(N,) 1 for splats that exist in this step and 0 for others, with the Gumbel-softmax's gradient."""
        # The difference of two Gumbel variables is a logistic one.
        even = np.random.default_rng([self.seed, 11, iteration]).random(len(self._logits))
        even = np.clip(even, 1e-12, 1 - 1e-12)
        noise = torch.from_numpy((np.log(even) - np.log1p(-even)).astype(np.float32))
        self._leaf = torch.from_numpy(self._logits).requires_grad_()
        soft = torch.sigmoid((self._leaf[:, 0] - self._leaf[:, 1] + noise) / self._rule.temperature)
        self._drawn = (soft.detach() > 0.5).float() + (soft - soft.detach())
        return self._drawn

    def penalty(self, gaussians: GaussianSet) -> Tensor | None:
        """Weighted square of the share of splats that exist in this step."""
        if self._drawn is None or len(self._drawn) == 0:
            return None
        return self._rule.weight * self._drawn.mean().square()

    def observe_pixels(self, by_pixels: np.ndarray, visible: np.ndarray, width: int, height: int) -> None:
        """As `Densifier.observe_pixels`; a splat that was masked out has not been seen."""
        if self._drawn is not None:
            visible = visible & (self._drawn.detach().numpy() > 0)
        super().observe_pixels(by_pixels, visible, width, height)

    def after_step(self, iteration: int, rates: Mapping[str, float] | None = None) -> bool:
        """Moves the logits, densifies, and drops what no draw shows; True when splats were added or dropped."""
        self._step_logits()
        changed = super().after_step(iteration, rates)
        done = iteration + 1
        return (self._prune(done) if done % self._rule.every == 0 or done == self.iterations else False) or changed

    def state(self) -> dict[str, Any]:
        own = {"logits": self._logits, "first": self._first, "second": self._second}
        copies = {name: torch.from_numpy(values.copy()) for name, values in own.items()}
        return {"densifier": super().state(), **copies, "steps": self._steps}

    def restore(self, state: dict[str, Any]) -> None:
        super().restore(state["densifier"])
        self._logits, self._first, self._second = (state[name].numpy().copy() for name in ("logits", "first", "second"))
        self._steps = int(state["steps"])
        self._leaf = self._drawn = None

    def existing(self) -> np.ndarray:
        """(N,) probability that a draw shows each splat."""
        return 1 / (1 + np.exp((self._logits[:, 1] - self._logits[:, 0]).astype(np.float64)))

    def _step_logits(self) -> None:
        leaf, self._leaf, self._drawn = self._leaf, None, None
        if leaf is None or leaf.grad is None or len(self._logits) == 0:
            return
        gradients = leaf.grad.numpy().reshape(-1)
        with Alone(gradients.size < _FEW):
            self._move(gradients)

    def _move(self, gradients: np.ndarray) -> None:
        if not all_finite(gradients):
            return
        self._steps += 1
        flat = self._logits.reshape(-1), gradients, self._first.reshape(-1), self._second.reshape(-1)
        ends, rates = np.array([self._logits.size]), np.array([self._rule.rate])
        limits = np.array([[-np.inf, np.inf]], np.float32)
        adam_step(*flat, ends, rates, limits, self._steps, BETA1, BETA2, EPSILON)

    def _prune(self, done: int) -> bool:
        rng = np.random.default_rng([self.seed, 12, done])
        # The chance that one of the draws shows it, drawn once.
        ever = 1 - (1 - self.existing()) ** self._rule.draws
        keep = rng.random(len(ever)) < ever
        if keep.all():
            return False
        nothing = self.parameters.to_set().select(np.zeros(0, np.int64))
        self.parameters.replace_rows(keep, nothing, {})
        self._sum, self._count = self._sum[keep], self._count[keep]
        self._rows_replaced(keep, np.zeros(0, np.int64))
        return True

    def _rows_replaced(self, keep: np.ndarray, parents: np.ndarray) -> None:
        """Children begin with their parents' logits and no moments."""
        self._logits = np.concatenate([self._logits[keep], self._logits[parents]])
        self._first, self._second = (
            np.concatenate([moments[keep], np.zeros((len(parents), 2), np.float32)])
            for moments in (self._first, self._second)
        )
