"""When splats are cloned, split, pruned and made clear again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self

import numpy as np
import torch

from ..compiled import njit
from ..errors import SettingError, check_choices
from ..gaussians import GaussianSet
from ..rotations import normalize_quats, quats_to_matrices
from .parameters import Parameters

if TYPE_CHECKING:
    from .mcmc import McmcStrategy


class DensityControl(Protocol):
    """A strategy at work on the parameters of one optimisation. Random choices follow from seed and iteration."""

    def masks(self, iteration: int) -> torch.Tensor | None:
        """(N,) what `splat` multiplies each splat's α by in this step; None where all are drawn."""

    def penalty(self, gaussians: GaussianSet) -> torch.Tensor | None:
        """What the strategy adds to the loss of the torch set about to be changed; None for nothing."""

    def observe_pixels(self, by_pixels: np.ndarray, visible: np.ndarray, width: int, height: int) -> None:
        """Notes a view's gradients (N, 2) by the projected centres in pixels, and which splats it shows (N,)."""

    def after_step(self, iteration: int, rates: Mapping[str, float] | None = None) -> bool:
        """Changes the set after a step made at those rates; True when splats were added, moved or dropped."""

    def state(self) -> dict[str, Any]:
        """For a checkpoint: tensors and plain numbers."""

    def restore(self, state: dict[str, Any]) -> None:
        """Becomes what `state()` was taken of, bit for bit."""


class Strategy(Protocol):
    """How many splats there are and where: the settings that a `DensityControl` begins with.

    Attributes:
        masked: whether its `masks` are not None, which takes kernels of their own.
    """

    masked: ClassVar[bool]

    def begin(
        self, parameters: Parameters, extent: float, iterations: int, seed: int, box: np.ndarray | None = None
    ) -> DensityControl:
        """The strategy at work; see `Densifier` for the arguments."""

    @property
    def densify(self) -> DefaultStrategy | McmcStrategy:
        """What adds splats: the strategy itself, or the one that it is built on."""

    def at_most(self, splats: int) -> Self:
        """The strategy with no more splats than these, or than it allows already."""

    def sooner(self, share: float) -> Self:
        """The strategy for a share of the iterations that it was made for, see `every_sooner`."""


# Fewer views between two densifications tell too little of where splats are too few.
_LEAST_EVERY = 20


def every_sooner(every: int, share: float) -> int:
    """Iterations between two densifications in a share of the iterations that `every` was made for: as many of them,
    but never fewer than 20, and no fewer where there are more iterations.

    With 100 still, 487 iterations of `standard` had two densifications: 2431 X-ray splats became 9724 where 60,000 are
    allowed, and projections 4.5 dB worse.
    """
    return max(round(min(share, 1.0) * every), min(every, _LEAST_EVERY))


@dataclass(frozen=True)
class DefaultStrategy:
    """Adaptive density control of 3DGS (arXiv 2308.04079, section 5.2), and of radiative splats.

    Counts of iterations are fractions of the whole optimisation, so that presets scale.

    Attributes:
        start, stop: densify between these fractions of the iterations.
        every: iterations between two densifications.
        gradient: splats whose mean screen gradient exceeds this are cloned or split; in normalised device
            coordinates (pixel gradient times half the image's side). 3DGS: 2e-4, R2-Gaussian: 5e-5; 0 to leave their
            number to `most` and `budget`.
        clone_size: largest scale, as a share of the scene's extent, that is cloned rather than split.
        split: "drawn": both children of a split are drawn from the parent and all scales shrink (3DGS);
            "along": they lie on either side of it on its longest axis and only that scale shrinks, so that together
            they keep the parent's mean and covariance.
        split_factor: scales that shrink in a split are divided by this.
        prune_opacity: splats clearer than this are dropped; 0 for none.
        prune_density: splats thinner than this share of the density unit are dropped; 0 for none.
        prune_size: splats larger than this share of the extent are dropped, once opacities were reset.
        reset_every: iterations between two resets of all opacities to `reset_opacity`; 0 for none.
        reset_opacity: see `reset_every`.
        most: splats are not added beyond this number; those with the largest gradients go first.
        budget: the number allowed grows evenly from the first count to `most` between `start` and `stop`, instead of
            being `most` at once: early iterations, whose splats are far off still, stay cheap.
        share_density: clones and children of a split keep the attenuation of their parent in sum. R2-Gaussian
            halves ρ in both children, which takes 1 − 1/1.6³ = 76 % of it away at each split; projections then
            fall by 20 dB for hundreds of iterations.
        halve_density: clones and children of a split have half of ρ each, as R2-Gaussian has it; not with
            `share_density`.

    Raises:
        SettingError: `split` or `every` are none that there are; density is to be shared and halved.
    """

    start: float = 0.05
    stop: float = 0.5
    every: int = 100
    gradient: float = 2e-4
    clone_size: float = 0.01
    split: str = "drawn"
    split_factor: float = 1.6
    prune_opacity: float = 0.005
    prune_density: float = 0.0
    prune_size: float = 0.1
    reset_every: int = 0
    reset_opacity: float = 0.01
    most: int = 500_000
    budget: bool = False
    share_density: bool = False
    halve_density: bool = False

    masked: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check_choices(self, {"split": ("drawn", "along")})
        if self.every < 1:
            raise SettingError("every is {every}; choose 1 iteration or more.", every=self.every)
        if self.share_density and self.halve_density:
            raise SettingError("share_density and halve_density are both on; choose one of them.")

    def begin(
        self, parameters: Parameters, extent: float, iterations: int, seed: int, box: np.ndarray | None = None
    ) -> Densifier:
        """The strategy at work on one optimisation."""
        return Densifier(self, parameters, extent, iterations, seed, box)

    @property
    def densify(self) -> DefaultStrategy:
        """See `Strategy.densify`."""
        return self

    def at_most(self, splats: int) -> DefaultStrategy:
        """See `Strategy.at_most`."""
        return replace(self, most=min(self.most, splats))

    def sooner(self, share: float) -> DefaultStrategy:
        """See `Strategy.sooner`. Opacities are reset as seldom as before."""
        return replace(self, every=every_sooner(self.every, share))


class Densifier:
    """Runs the default strategy on the parameters of one optimisation; a `DensityControl`.

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
        self._first_count = len(parameters)
        self._clear()
        self._was_reset = False

    def masks(self, iteration: int) -> torch.Tensor | None:
        """None: every splat is drawn."""
        return None

    def penalty(self, gaussians: GaussianSet) -> torch.Tensor | None:
        """None: the loss stays as it is."""
        return None

    def watches(self, iteration: int) -> bool:
        """Whether what `observe` notes in this iteration can still add splats."""
        return iteration < self.strategy.stop * self.iterations

    def observe(self, screen_gradient: np.ndarray, visible: np.ndarray) -> None:
        """Notes one view's screen gradients (N,) in normalised device coordinates, of the splats it shows (N,)."""
        np.add(self._sum, screen_gradient, out=self._sum, where=visible)
        self._count += visible

    def observe_pixels(self, by_pixels: np.ndarray, visible: np.ndarray, width: int, height: int) -> None:
        """`observe` for gradients (N, 2) by the centres in pixels of an image of that size.

        Raises:
            ValueError: there are not as many as splats.
        """
        if not len(by_pixels) == len(visible) == len(self._sum):
            raise ValueError(f"gradients of {len(by_pixels)} splats, {len(visible)} visible, of {len(self._sum)}")
        half = np.float32(width / 2), np.float32(height / 2)
        add_view(np.ascontiguousarray(by_pixels, np.float32), *half, visible, self._sum, self._count)

    def after_step(self, iteration: int, rates: Mapping[str, float] | None = None) -> bool:
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
        return {**sums, "was_reset": self._was_reset, "first_count": self._first_count}

    def restore(self, state: dict[str, Any]) -> None:
        self._sum, self._count = state["sum"].numpy().copy(), state["count"].numpy().copy()
        self._was_reset = bool(state["was_reset"])
        self._first_count = int(state["first_count"])

    def _clear(self) -> None:
        self._sum = np.zeros(len(self.parameters), np.float32)
        self._count = np.zeros(len(self.parameters), np.int32)

    def _densify(self, done: int) -> None:
        rule, parameters = self.strategy, self.parameters
        current = parameters.to_set()
        mean = self._sum / np.maximum(self._count, 1)
        # Children of what is to be dropped would take its place, twice as many each time.
        worth = self._worth_a_child(current)
        chosen = self._largest(mean, worth & (mean > rule.gradient), self._allowed(done) - len(current))
        small = current.scales.max(axis=1) <= rule.clone_size * self.extent
        clone, split = chosen & small, chosen & ~small
        keep = ~split & worth & self._small_enough(current)
        changed = {}
        clones = current.select(clone & keep)
        if (rule.share_density or rule.halve_density) and clone.any():
            changed["density"] = parameters.raw_density(np.where(clone, 0.5 * current.density, current.density))
            clones = replace(clones, density=clones.density * np.float32(0.5))
        children = self._split(current.select(split), np.random.default_rng([self.seed, 7, done]))
        parameters.replace_rows(keep, GaussianSet.concatenate([clones, *children]), changed)
        parents = np.flatnonzero(split)
        self._rows_replaced(keep, np.concatenate([np.flatnonzero(clone & keep), parents, parents]))
        self._clear()

    def _rows_replaced(self, keep: np.ndarray, parents: np.ndarray) -> None:
        """For who knows more of each splat: those kept (N,) bool, and the rows that the appended ones come from."""

    def _allowed(self, done: int) -> int:
        """How many splats there may be after `done` iterations."""
        rule = self.strategy
        if not rule.budget or rule.most <= self._first_count:
            return rule.most
        share = (done / self.iterations - rule.start) / max(rule.stop - rule.start, 1e-12)
        return round(self._first_count + min(max(share, 0.0), 1.0) * (rule.most - self._first_count))

    def _largest(self, mean: np.ndarray, wanted: np.ndarray, room: int) -> np.ndarray:
        """At most `room` of the wanted splats, those with the largest gradients."""
        if wanted.sum() <= room:
            return wanted
        chosen = np.zeros_like(wanted)
        if room > 0:
            order = np.argsort(np.where(wanted, -mean, np.inf), kind="stable")
            chosen[order[:room]] = True
        return chosen

    def _worth_a_child(self, current: GaussianSet) -> np.ndarray:
        """(N,) bool: neither clear nor thin, and in the box; others are dropped whatever their gradients are."""
        rule = self.strategy
        worth = current.opacities >= rule.prune_opacity
        if rule.prune_density:
            worth &= current.density >= rule.prune_density * self.parameters.density_unit
        if self.box is not None:
            worth &= np.all((current.means >= self.box[0]) & (current.means <= self.box[1]), axis=1)
        return worth

    def _small_enough(self, current: GaussianSet) -> np.ndarray:
        """(N,) bool: what is too large may still be split."""
        largest = self.strategy.prune_size * self.extent if self._was_reset else np.inf
        return current.scales.max(axis=1) <= largest

    def _split(self, parents: GaussianSet, rng: np.random.Generator) -> list[GaussianSet]:
        """Two sets with one child of each parent."""
        rule = self.strategy
        shrink = np.full_like(parents.scales, rule.split_factor)
        if rule.split == "along":
            longest = parents.scales == parents.scales.max(axis=1, keepdims=True)
            # Of axes of the same length the first.
            longest &= np.cumsum(longest, axis=1) == 1
            shrink = np.where(longest, shrink, 1.0).astype(np.float32)
            # A variance of σ² is one of (σ / f)² within each child and one of d² between them.
            apart = longest * parents.scales * np.sqrt(1 - rule.split_factor**-2)
            offsets = [apart, -apart]
        else:
            offsets = [rng.normal(size=parents.scales.shape) * parents.scales for _ in range(2)]
        axes = quats_to_matrices(normalize_quats(parents.quats))
        density = parents.density * np.float32(0.5 if rule.halve_density else 1)
        if rule.share_density:
            density = parents.density * (0.5 * shrink.prod(axis=1))
        return [
            replace(
                parents,
                means=(parents.means + np.einsum("nij,nj->ni", axes, offset)).astype(np.float32),
                scales=(parents.scales / shrink).astype(np.float32),
                density=density.astype(np.float32),
            )
            for offset in offsets
        ]


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def add_view(by_pixels, half_width, half_height, visible, sums, counts):  # type: ignore[no-untyped-def]
    """Adds the lengths of gradients (N, 2), in normalised device coordinates, to the sums of the splats shown."""
    for i in range(np.uint64(len(sums))):
        x, y = by_pixels[i, 0] * half_width, by_pixels[i, 1] * half_height
        sums[i] += np.sqrt(x * x + y * y) if visible[i] else np.float32(0.0)
        counts[i] += visible[i]
