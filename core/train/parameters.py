"""The raw parameters of a GaussianSet under training, in one flat buffer with Adam's moments beside it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..gaussians import GaussianSet
from ..rotations import normalize_quats
from ..threads import Alone
from .activation import activate
from .adam import adam_step, all_finite

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15
_LEAST_SCALE = 1e-12
_OPACITY_MARGIN = 1e-5
_LEAST_DENSITY = 1e-9
# Fewer gradients are looked through, and fewer parameters moved, before other threads are awake.
_FEW_GRADIENTS, _FEW_PARAMETERS = 2_000_000, 400_000

GROUPS = ("means", "quats", "scales", "opacities", "sh_dc", "sh_rest", "density")


def inverse_softplus(value: Any) -> np.ndarray:
    """x with softplus(x) = value, for value > 0, accurate at both ends: value + log(−expm1(−value))."""
    value = np.asarray(value, np.float64)
    return value + np.log(-np.expm1(-value))


_RAW_OF_NONE = np.float32(inverse_softplus(_LEAST_DENSITY))


@dataclass(frozen=True)
class ScaleLimits:
    """Standard deviations are kept within these, in the set's units; no splat vanishes or swallows the scene."""

    least: float = _LEAST_SCALE
    most: float = 1e12


@dataclass(frozen=True)
class Separate:
    """Some groups of the first splats, which have steps of Adam of their own: `Parameters.step_separate`.

    What one loss in several moves would otherwise follow old momentum in between.

    Attributes:
        rows: how many splats.
        groups: names, all of them trained.
        memory: how much is kept of their mean of squared gradients from step to step (β₂).
    """

    rows: int
    groups: tuple[str, ...]
    memory: float = BETA2


class Parameters:
    """N splats as raw numbers: log scales, logit opacities, inverse-softplus density / `density_unit`.

    Groups named in `trained` are trained; the others keep their values. All trained numbers lie in one float32
    buffer, group after group, so that a step of Adam is one pass.

    Args:
        gaussians: numpy set.
        trained: names of the groups to train, of GROUPS.
        density_unit: mm⁻¹ that a raw density is measured in, so that a rate means the same for bone and foam.
        limits: of the scales.
        memory: how much Adam keeps of its mean of squared gradients from step to step (β₂).
        separate: numbers that `step` leaves alone. Their splats stay: there is no `replace_rows`.

    Attributes:
        steps, steps_separate: optimisation steps made.

    Raises:
        ValueError: more separate splats than there are, or a separate group that is not trained.
    """

    _constant_density: Tensor | None

    def __init__(
        self,
        gaussians: GaussianSet,
        trained: tuple[str, ...],
        density_unit: float = 1.0,
        limits: ScaleLimits | None = None,
        memory: float = BETA2,
        separate: Separate | None = None,
    ) -> None:
        self._separate, self.steps_separate = separate or Separate(0, ()), 0
        self.trained = tuple(name for name in GROUPS if name in trained)
        if self._separate.rows > len(gaussians) or not set(self._separate.groups) <= set(self.trained):
            known = f"{len(gaussians)} splats whose {', '.join(self.trained)} are trained"
            raise ValueError(f"{self._separate}: there are {known}")
        self.density_unit = density_unit
        self.limits = limits or ScaleLimits()
        self.steps, self._memory = 0, memory
        self._constant_density: Tensor | None = None
        rows = self._raw_rows(gaussians)
        self._modality = torch.from_numpy(np.array(gaussians.modality, np.uint8))
        zeros = {name: np.zeros_like(rows[name]) for name in self.trained}
        self._fill(rows, zeros, zeros)

    def __len__(self) -> int:
        return int(self.raw["means"].shape[0])

    def activate(self, harmonics: bool = True) -> GaussianSet:
        """The torch set that the renderers take.

        `backward()` adds to the gradients of the raw numbers; `torch.autograd.grad` finds none.

        Args:
            harmonics: whether `sh` has all its coefficients. Projections and sections have no use for 45 numbers a
                splat, and they are the most that there is to copy.
        """
        raw = [self.raw[name] for name in GROUPS[:6]]
        if not harmonics:
            raw[5] = raw[5].detach()[:, :0].contiguous()
        means, quats, scales, opacities, sh = activate(*raw)
        return GaussianSet(
            means=means,
            quats=quats,
            scales=scales,
            opacities=opacities,
            sh=sh,
            density=self._density() if self._constant_density is None else self._constant_density,
            modality=self._modality,
        )

    def _density(self) -> Tensor:
        return torch.nn.functional.softplus(self.raw["density"]) * self.density_unit

    def to_set(self) -> GaussianSet:
        """The current values as a numpy set with unit quaternions."""
        with torch.no_grad():
            current = self.activate().to_numpy()
        # Copies: the tensors are views of the buffer that the next step changes.
        copies = {name: np.array(value) for name, value in vars(current).items()}
        # What X-rays do not see has no raw number of its own, and is none of what is asked for its density.
        copies["density"][self.raw["density"].detach().numpy() <= _RAW_OF_NONE] = 0.0
        return GaussianSet(**{**copies, "quats": normalize_quats(current.quats)})

    def zero_grad(self) -> None:
        self._gradients.fill(0.0)

    def step(self, rates: Mapping[str, float]) -> bool:
        """One step of Adam with a rate for each trained group; scales stay within the limits.

        The gradients are 0 afterwards, also of what is separate: those of the next step can be added at once.

        Returns:
            False, with no parameter changed, when a gradient is not finite.
        """
        with Alone(self._gradients.size < _FEW_GRADIENTS):
            finite = all_finite(self._gradients)
        if not finite:
            self.zero_grad()
            return False
        self.steps += 1
        used = np.array([max(rates.get(name, 0.0), 0.0) for name in self._moved])
        buffers = self._values, self._gradients, self._first, self._second
        with Alone(self._values.size < _FEW_PARAMETERS):
            adam_step(*buffers, self._ends, used, self._limits, self.steps, BETA1, self._memory, EPSILON)
        return True

    def step_separate(self, rates: Mapping[str, float]) -> bool:
        """One step of Adam of what is separate, whose gradients are 0 afterwards; all other gradients stay.

        Returns:
            False, with no parameter changed, when a gradient is not finite.
        """
        groups, memory = self._separate.groups, self._separate.memory
        spans = [self._separate_span(name) for name in groups]
        size = sum(span.stop - span.start for span in spans)
        with Alone(size < _FEW_GRADIENTS):
            finite = all(all_finite(self._gradients[span]) for span in spans)
        if not finite:
            for span in spans:
                self._gradients[span] = 0.0
            return False
        self.steps_separate += 1
        with Alone(size < _FEW_PARAMETERS):
            for name, span in zip(groups, spans, strict=True):
                parts = (part[span] for part in (self._values, self._gradients, self._first, self._second))
                ends, rate = np.array([span.stop - span.start]), np.array([max(rates.get(name, 0.0), 0.0)])
                limits = np.array([self._log_limits(name)], np.float32)
                adam_step(*parts, ends, rate, limits, self.steps_separate, BETA1, memory, EPSILON)
        return True

    def gradient(self, name: str) -> np.ndarray:
        """The gradient of a trained group, a view: (N, ...)."""
        return self._gradients[self._spans[name]].reshape(tuple(self.raw[name].shape))

    def set_opacities(self, opacities: np.ndarray) -> None:
        """Replaces all opacities (N,) and forgets their moments."""
        span = self._spans["opacities"]
        self._values[span] = _logit(opacities)
        self._first[span] = 0.0
        self._second[span] = 0.0

    def overwrite(self, rows: np.ndarray, gaussians: GaussianSet, moved: np.ndarray | None = None) -> None:
        """Puts the splats of a numpy set in the place of `rows` (M,).

        Args:
            moved: rows whose moments become 0; all of `rows` if None.
        """
        forget = rows if moved is None else moved
        new = self._raw_rows(gaussians)
        for name in GROUPS:
            values = self.raw[name].detach().numpy()
            values[rows] = new[name]
            if name in self._spans:
                for moments in (self._first, self._second):
                    moments[self._spans[name]].reshape(values.shape)[forget] = 0.0
        self._modality[torch.from_numpy(rows)] = torch.from_numpy(np.array(gaussians.modality, np.uint8))
        if self._constant_density is not None:
            self._constant_density = self._density()

    def replace_rows(self, keep: np.ndarray, added: GaussianSet, changed: Mapping[str, np.ndarray]) -> None:
        """Keeps some splats with their moments and appends new ones without.

        Args:
            keep: (N,) bool.
            added: numpy set of new splats.
            changed: new raw values of whole groups, applied before rows are dropped (densities halved by a split).

        Raises:
            ValueError: some splats have steps of their own, and would no longer be the first.
        """
        if self._separate.rows:
            raise ValueError("rows cannot be replaced while the first of them have steps of their own")
        new = self._raw_rows(added)
        rows: dict[str, np.ndarray] = {}
        first: dict[str, np.ndarray] = {}
        second: dict[str, np.ndarray] = {}
        for name in GROUPS:
            old = changed.get(name, self.raw[name].detach().numpy())
            rows[name] = np.concatenate([old[keep], new[name]])
        for name in self.trained:
            span, shape = self._spans[name], tuple(self.raw[name].shape)
            for moments, source in ((first, self._first), (second, self._second)):
                moments[name] = np.concatenate([source[span].reshape(shape)[keep], np.zeros_like(new[name])])
        modality = np.concatenate([self._modality.numpy()[keep], added.modality])
        self._fill(rows, first, second)
        self._modality = torch.from_numpy(modality)

    def raw_density(self, density: np.ndarray) -> np.ndarray:
        """Raw numbers (N,) of densities in mm⁻¹."""
        values = np.maximum(np.asarray(density, np.float64) / self.density_unit, _LEAST_DENSITY)
        return inverse_softplus(values).astype(np.float32)

    def state(self) -> dict[str, Any]:
        """Everything that a checkpoint needs; see `restore`."""
        return {
            "raw": {name: self.raw[name].detach().clone() for name in GROUPS},
            "first": torch.from_numpy(self._first.copy()),
            "second": torch.from_numpy(self._second.copy()),
            "modality": self._modality.clone(),
            "steps": self.steps,
            "steps_separate": self.steps_separate,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Becomes what `state()` was taken of, bit for bit."""
        rows = {name: state["raw"][name].numpy() for name in GROUPS}
        zeros = {name: np.zeros_like(rows[name]) for name in self.trained}
        self._fill(rows, zeros, zeros)
        self._first[:] = state["first"].numpy()
        self._second[:] = state["second"].numpy()
        self._modality = state["modality"].clone()
        self.steps, self.steps_separate = int(state["steps"]), int(state["steps_separate"])

    def _raw_rows(self, gaussians: GaussianSet) -> dict[str, np.ndarray]:
        scales = np.clip(gaussians.scales, max(self.limits.least, _LEAST_SCALE), self.limits.most)
        rows = {
            "means": gaussians.means,
            "quats": gaussians.quats,
            "scales": np.log(scales.astype(np.float64)),
            "opacities": _logit(gaussians.opacities),
            "sh_dc": gaussians.sh[:, :1],
            "sh_rest": gaussians.sh[:, 1:],
            "density": self.raw_density(gaussians.density),
        }
        return {name: np.ascontiguousarray(value, np.float32) for name, value in rows.items()}

    def _log_limits(self, name: str) -> tuple[float, float]:
        if name != "scales":
            return -math.inf, math.inf
        return math.log(self.limits.least), math.log(self.limits.most)

    def _separate_span(self, name: str) -> slice:
        span = self._spans[name]
        return slice(span.start, span.start + self._separate.rows * ((span.stop - span.start) // max(len(self), 1)))

    def _fill(
        self, rows: dict[str, np.ndarray], first: Mapping[str, np.ndarray], second: Mapping[str, np.ndarray]
    ) -> None:
        sizes = [rows[name].size for name in self.trained]
        ends = np.cumsum(sizes)
        self._spans = {
            name: slice(int(end - size), int(end)) for name, end, size in zip(self.trained, ends, sizes, strict=True)
        }

        def flat(parts: Mapping[str, np.ndarray]) -> np.ndarray:
            return np.concatenate([parts[name].ravel() for name in self.trained]).astype(np.float32)

        self._values, self._first, self._second = flat(rows), flat(first), flat(second)
        self._gradients = np.zeros_like(self._values)
        self.raw: dict[str, Tensor] = {}
        for name in GROUPS:
            if name not in self._spans:
                self.raw[name] = torch.from_numpy(np.ascontiguousarray(rows[name]))
                continue
            # Tensors are views of the flat buffers: a step on the buffer is a step on them.
            view = torch.from_numpy(self._values[self._spans[name]].reshape(rows[name].shape))
            view.requires_grad_(True)
            view.grad = torch.from_numpy(self._gradients[self._spans[name]].reshape(rows[name].shape))
            self.raw[name] = view
        # What `step` moves has a name, what it leaves alone none.
        parts = []
        for name in self.trained:
            if name in self._separate.groups:
                parts.append(("", self._separate_span(name).stop))
            parts.append((name, self._spans[name].stop))
        self._moved = [name for name, _ in parts]
        self._ends = np.array([end for _, end in parts], np.int64)
        self._limits = np.array([self._log_limits(name) for name in self._moved], np.float32)
        # Photos do not train it, so that it need not be made anew in each of their steps.
        self._constant_density = None if "density" in self.trained else self._density()


def _logit(opacities: np.ndarray) -> np.ndarray:
    kept = np.clip(np.asarray(opacities, np.float64), _OPACITY_MARGIN, 1 - _OPACITY_MARGIN)
    return (np.log(kept) - np.log1p(-kept)).astype(np.float32)
