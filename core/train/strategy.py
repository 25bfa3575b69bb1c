"""When splats are cloned, split, pruned and made clear again."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ..gaussians import GaussianSet
from ..rotations import normalize_quats, quats_to_matrices
from .parameters import Parameters


@dataclass(frozen=True)
class DefaultStrategy:
    """Adaptive density control of 3DGS (arXiv 2308.04079, section 5.2), and of R2-Gaussian with `halve_density`.

    Counts of iterations are fractions of the whole optimisation, so that presets scale.

    Attributes:
        start, stop: densify between these fractions of the iterations.
        every: iterations between two densifications.
        gradient: splats whose mean screen gradient exceeds this are cloned or split; in normalised device
            coordinates (pixel gradient times half the image's side). 3DGS: 2e-4, R2-Gaussian: 5e-5.
        clone_size: largest scale, as a share of the scene's extent, that is cloned rather than split.
        split_factor: the scales of split splats are divided by this.
        prune_opacity: splats clearer than this are dropped; 0 for none.
        prune_density: splats thinner than this share of the density unit are dropped; 0 for none.
        prune_size: splats larger than this share of the extent are dropped, once opacities were reset.
        reset_every: iterations between two resets of all opacities to `reset_opacity`; 0 for none.
        reset_opacity: see `reset_every`.
        most: splats are not added beyond this number; those with the largest gradients go first.
        halve_density: a clone or split shares the density of its parent, so that the total attenuation stays.
    """

    start: float = 0.05
    stop: float = 0.5
    every: int = 100
    gradient: float = 2e-4
    clone_size: float = 0.01
    split_factor: float = 1.6
    prune_opacity: float = 0.005
    prune_density: float = 0.0
    prune_size: float = 0.1
    reset_every: int = 0
    reset_opacity: float = 0.01
    most: int = 500_000
    halve_density: bool = False


class Densifier:
    """Runs a strategy on the parameters of one optimisation.

    Args:
        strategy: the rules.
        parameters: changed in place.
        extent: radius of the scene in the set's units.
        iterations: of the whole optimisation.
        seed: of the places where split splats land.
        box: (2, 3), splats outside are dropped; none if None.
    """

    def __init__(
        self,
        strategy: DefaultStrategy,
        parameters: Parameters,
        extent: float,
        iterations: int,
        seed: int,
        box: np.ndarray | None = None,
    ) -> None:
        self.strategy, self.parameters = strategy, parameters
        self.extent, self.iterations, self.seed, self.box = extent, iterations, seed, box
        self._clear()
        self._was_reset = False

    def observe(self, screen_gradient: np.ndarray, visible: np.ndarray) -> None:
        """Notes one view's screen gradients (N,) in normalised device coordinates, of the splats it shows (N,)."""
        self._sum[visible] += screen_gradient[visible]
        self._count[visible] += 1

    def after_step(self, iteration: int) -> bool:
        """Densifies, prunes and resets as the strategy says; True when splats were added or dropped."""
        done, rule = iteration + 1, self.strategy
        first, last = rule.start * self.iterations, rule.stop * self.iterations
        changed = False
        if first < done <= last and done % rule.every == 0:
            self._densify(done)
            changed = True
        if rule.reset_every and done < last and done % rule.reset_every == 0:
            opacities = torch.sigmoid(self.parameters.raw["opacities"].detach()).numpy()
            self.parameters.set_opacities(np.minimum(opacities, rule.reset_opacity))
            self._was_reset = True
        return changed

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        sums = {"sum": torch.from_numpy(self._sum.copy()), "count": torch.from_numpy(self._count.copy())}
        return {**sums, "was_reset": self._was_reset}

    def restore(self, state: dict[str, Any]) -> None:
        self._sum, self._count = state["sum"].numpy().copy(), state["count"].numpy().copy()
        self._was_reset = bool(state["was_reset"])

    def _clear(self) -> None:
        self._sum = np.zeros(len(self.parameters), np.float32)
        self._count = np.zeros(len(self.parameters), np.int32)

    def _densify(self, done: int) -> None:
        rule, parameters = self.strategy, self.parameters
        current = parameters.to_set()
        mean = self._sum / np.maximum(self._count, 1)
        chosen = self._largest(mean, mean > rule.gradient, rule.most - len(current))
        small = current.scales.max(axis=1) <= rule.clone_size * self.extent
        clone, split = chosen & small, chosen & ~small
        keep = ~split & self._worth_keeping(current)
        share = 0.5 if rule.halve_density else 1.0
        changed = {}
        if rule.halve_density and clone.any():
            density = np.where(clone, current.density * share, current.density)
            changed["density"] = parameters.raw_density(density)
        rng = np.random.default_rng([self.seed, 7, done])
        halves = [self._split(current.select(split), share, rng) for _ in range(2)]
        clones = current.select(clone & keep)
        clones = GaussianSet(**{**vars(clones), "density": clones.density * np.float32(share)})
        parameters.replace_rows(keep, GaussianSet.concatenate([clones, *halves]), changed)
        self._clear()

    def _largest(self, mean: np.ndarray, wanted: np.ndarray, room: int) -> np.ndarray:
        """At most `room` of the wanted splats, those with the largest gradients."""
        if wanted.sum() <= room:
            return wanted
        chosen = np.zeros_like(wanted)
        if room > 0:
            order = np.argsort(np.where(wanted, -mean, np.inf), kind="stable")
            chosen[order[:room]] = True
        return chosen

    def _worth_keeping(self, current: GaussianSet) -> np.ndarray:
        rule = self.strategy
        keep = current.opacities >= rule.prune_opacity
        if rule.prune_density:
            keep &= current.density >= rule.prune_density * self.parameters.density_unit
        if self._was_reset:
            keep &= current.scales.max(axis=1) <= rule.prune_size * self.extent
        if self.box is not None:
            keep &= np.all((current.means >= self.box[0]) & (current.means <= self.box[1]), axis=1)
        return keep

    def _split(self, parents: GaussianSet, share: float, rng: np.random.Generator) -> GaussianSet:
        """One child of each parent, drawn from it."""
        axes = quats_to_matrices(normalize_quats(parents.quats))
        offsets = rng.normal(size=(len(parents), 3)) * parents.scales
        return GaussianSet(
            **{
                **vars(parents),
                "means": (parents.means + np.einsum("nij,nj->ni", axes, offsets)).astype(np.float32),
                "scales": (parents.scales / self.strategy.split_factor).astype(np.float32),
                "density": (parents.density * share).astype(np.float32),
            }
        )
