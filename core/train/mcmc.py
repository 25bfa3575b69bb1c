"""Splats as samples of a distribution: moved by noise, relocated instead of split, never more than a cap."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from math import comb
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from ..gaussians import GaussianSet
from ..rotations import normalize_quats, quats_to_matrices
from .parameters import Parameters
from .strategy import every_sooner

# Where a splat's noise has fallen to a millionth of a dead one's, it is not drawn.
_LEAST_SHARE = 1e-6


@dataclass(frozen=True)
class McmcStrategy:
    """3D Gaussian Splatting as Markov Chain Monte Carlo (Kheradmand et al. 2024, arXiv 2404.09591).

    Counts of iterations are fractions of the whole optimisation, so that presets scale.

    Attributes:
        start, stop: splats are relocated and added between these fractions of the iterations.
        every: iterations between two relocations.
        most: the cap; splats are not added beyond it.
        growth: share of the splats that is added each time.
        dead: a splat no more opaque than this is put where a live one is.
        noise: of the means after each step, as a multiple of their rate, in the unit of `radius`.
        softness, threshold: the noise's share is sigmoid(softness · ((1 − o) − threshold)) of opacity o.
        opacity_weight, scale_weight: of mean opacity and mean scale in the loss.
        copies: at most this many splats share what one was (the N of `relocated`).
        radius: extent of the scenes that noise and weights were found for. A mean's noise is Σ (length²) times a rate
            (length), so lengths are measured as if the scene had this extent: no result depends on the photo frame's
            unit.
    """

    start: float = 0.0167
    stop: float = 0.833
    every: int = 100
    most: int = 500_000
    growth: float = 0.05
    dead: float = 0.005
    noise: float = 5e5
    softness: float = 100.0
    threshold: float = 0.995
    opacity_weight: float = 0.01
    scale_weight: float = 0.01
    copies: int = 50
    radius: float = 5.0

    masked: ClassVar[bool] = False

    def begin(
        self, parameters: Parameters, extent: float, iterations: int, seed: int, box: np.ndarray | None = None
    ) -> Relocator:
        """The strategy at work on one optimisation."""
        return Relocator(self, parameters, extent, iterations, seed, box)

    @property
    def densify(self) -> McmcStrategy:
        """See `Strategy.densify`."""
        return self

    def at_most(self, splats: int) -> McmcStrategy:
        """See `Strategy.at_most`."""
        return replace(self, most=min(self.most, splats))

    def sooner(self, share: float) -> McmcStrategy:
        """See `Strategy.sooner`."""
        return replace(self, every=every_sooner(self.every, share))


class Relocator:
    """Runs the strategy on the parameters of one optimisation; a `core.train.strategy.DensityControl`.

    Args:
        strategy: the rules.
        parameters: changed in place.
        extent: radius of the scene in the set's units.
        iterations: of the whole optimisation.
        seed: of noise and of which live splats are chosen.
        box: (2, 3), splats outside count as dead; none if None.
    """

    def __init__(
        self,
        strategy: McmcStrategy,
        parameters: Parameters,
        extent: float,
        iterations: int,
        seed: int,
        box: np.ndarray | None = None,
    ) -> None:
        self.strategy, self.parameters = strategy, parameters
        self.extent, self.iterations, self.seed, self.box = extent, iterations, seed, box

    def masks(self, iteration: int) -> Tensor | None:
        """None: every splat is drawn."""
        return None

    def penalty(self, gaussians: GaussianSet) -> Tensor | None:
        """Weighted mean opacity and mean scale, which lets splats that serve nothing die."""
        rule = self.strategy
        if len(gaussians) == 0:
            return None
        unit = rule.radius / self.extent
        return rule.opacity_weight * gaussians.opacities.mean() + rule.scale_weight * unit * gaussians.scales.mean()

    def observe_pixels(self, by_pixels: np.ndarray, visible: np.ndarray, width: int, height: int) -> None:
        """Nothing: which splats are chosen follows from their opacities."""

    def after_step(self, iteration: int, rates: Mapping[str, float] | None = None) -> bool:
        """Relocates and adds when it is time, then moves the means at random; True when splats were moved or added."""
        done, rule = iteration + 1, self.strategy
        changed = False
        if rule.start * self.iterations < done <= rule.stop * self.iterations and done % rule.every == 0:
            changed = self.relocate(done) | self.grow(done)
        self._shake(done, (rates or {}).get("means", 0.0))
        return changed

    def state(self) -> dict[str, Any]:
        """Nothing: all follows from the parameters, the seed and the iteration."""
        return {}

    def restore(self, state: dict[str, Any]) -> None:
        """Nothing is kept."""

    def relocate(self, done: int) -> bool:
        """Puts the dead where live splats are, drawn by opacity, so that the image stays the same to first order.

        Only the moved forget their moments. Were they forgotten by the splat that was there too, all that now lie in
        one place would take the same steps from there on, since Adam's first ones know no size.
        """
        current = self.parameters.to_set()
        alive = self._alive(current)
        dead = np.flatnonzero(~alive)
        hosts, counts = self._draw(np.where(alive, current.opacities, 0.0), len(dead), [8, done])
        if len(hosts) == 0:
            return False
        shared = self._shared(current.select(hosts), counts + 1)
        copies = np.repeat(np.arange(len(hosts)), counts)
        moved = dead[: len(copies)]
        rows = np.concatenate([hosts, moved])
        self.parameters.overwrite(rows, GaussianSet.concatenate([shared, shared.select(copies)]), moved)
        return True

    def grow(self, done: int) -> bool:
        """Adds splats where live ones are, up to the cap."""
        current, rule = self.parameters.to_set(), self.strategy
        wanted = min(rule.most, int((1 + rule.growth) * len(current))) - len(current)
        weights = np.where(self._alive(current), current.opacities, 0.0)
        hosts, counts = self._draw(weights, max(wanted, 0), [9, done])
        if len(hosts) == 0:
            return False
        shared = self._shared(current.select(hosts), counts + 1)
        self.parameters.overwrite(hosts, shared, np.zeros(0, np.int64))
        added = shared.select(np.repeat(np.arange(len(hosts)), counts))
        self.parameters.replace_rows(np.ones(len(current), bool), added, {})
        return True

    def _alive(self, current: GaussianSet) -> np.ndarray:
        alive = current.opacities > self.strategy.dead
        if self.box is not None:
            alive &= np.all((current.means >= self.box[0]) & (current.means <= self.box[1]), axis=1)
        return alive

    def _draw(self, weights: np.ndarray, count: int, stream: list[int]) -> tuple[np.ndarray, np.ndarray]:
        """Rows drawn and how often each: at most `count` in all, none more often than a splat may be shared.

        By the running sum of the weights, which, other than `torch.multinomial`, has no limit of 2²⁴ of them.
        """
        total = np.cumsum(weights, dtype=np.float64)
        if count == 0 or len(total) == 0 or total[-1] <= 0:
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        places = np.random.default_rng([self.seed, *stream]).random(count) * total[-1]
        drawn = np.searchsorted(total, places, side="right")
        hosts, counts = np.unique(np.minimum(drawn, np.flatnonzero(weights)[-1]), return_counts=True)
        # The surplus stays where it is: splats beyond the N of the formula would make the image more opaque.
        return hosts, np.minimum(counts, self.strategy.copies - 1)

    def _shared(self, hosts: GaussianSet, number: np.ndarray) -> GaussianSet:
        """What each of `number` (M,) equal splats in the place of one has to be."""
        opacities, factor = relocated(hosts.opacities, number)
        mass = number * factor**3
        return replace(
            hosts,
            opacities=opacities.astype(np.float32),
            scales=(hosts.scales * factor[:, None]).astype(np.float32),
            density=(hosts.density / mass).astype(np.float32),
        )

    def _shake(self, done: int, rate: float) -> None:
        """Adds Σ·η·sigmoid(...)·rate to the means, with η from the seed and the iteration."""
        rule, raw = self.strategy, self.parameters.raw
        if rate <= 0 or rule.noise <= 0 or len(self.parameters) == 0:
            return
        clear = torch.sigmoid(-raw["opacities"].detach()).numpy()
        share = 0.5 + 0.5 * np.tanh(0.5 * rule.softness * (clear - rule.threshold))
        rows = np.flatnonzero(share > _LEAST_SHARE)
        unit = np.random.default_rng([self.seed, 10, done]).standard_normal((len(rows), 3))
        axes = quats_to_matrices(normalize_quats(raw["quats"].detach().numpy()[rows]))
        variances = np.exp(2 * raw["scales"].detach().numpy()[rows].astype(np.float64))
        # Σ·η with Σ = axes · variances · axesᵀ.
        push = np.einsum("nij,nj->ni", axes, variances * np.einsum("nkj,nk->nj", axes, unit))
        push *= (share[rows] * rule.noise * rate * (rule.radius / self.extent) ** 2)[:, None]
        raw["means"].detach().numpy()[rows] += push.astype(np.float32)


def relocated(opacities: np.ndarray, number: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Opacity (M,) and factor of the scales (M,) of N equal splats that together show what one showed.

    o' = 1 − (1 − o)^(1/N) and s'/s = o / Σᵢ₌₁..N Σₖ₌₀..ᵢ₋₁ C(i−1, k)(−1)ᵏ o'ᵏ⁺¹/√(k+1).

    Args:
        opacities: (M,) of the splat that was, below 1.
        number: (M,) whole numbers N from 1.
    """
    old = np.asarray(opacities, np.float64)
    new = -np.expm1(np.log1p(-old) / number)
    below = np.empty_like(old)
    for count in np.unique(number):
        chosen = number == count
        powers = new[chosen, None] ** np.arange(1, count + 1)
        below[chosen] = powers @ _coefficients(int(count))
    return new, old / below


@cache
def _coefficients(count: int) -> np.ndarray:
    """Of o'ᵏ⁺¹, k = 0..N−1: Σᵢ C(i−1, k) over i = 1..N is C(N, k+1)."""
    return np.array([comb(count, k + 1) * (-1) ** k / np.sqrt(k + 1) for k in range(count)])
