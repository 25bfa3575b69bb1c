"""Radiative Gaussians on the projections: exact additive line integrals (R2-Gaussian, arXiv 2405.20693)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ...capture.model import Projections
from ...errors import SettingError, check_choices
from ...evaluate.heldout import projection_peak, some_held_out
from ...evaluate.metrics import psnr
from ...gaussians import GaussianSet
from ...progress import Tick, unstopped
from ...render import radiograph
from ...render.radiograph import CUTOFF_SIGMAS
from ...train.loop import Measured, known
from ...train.losses import projection_loss
from ...train.parameters import Parameters, ScaleLimits
from ...train.schedule import Decay, Growth, Stop, shuffled
from ...train.smoothness import block_variation
from ...train.strategy import DefaultStrategy, Densifier
from ...views import Detector
from .smooth_trial import SmoothTrial, TrialRun

if TYPE_CHECKING:
    from ...effects.ring_offsets import RingOffsets

_LEAST_PIXELS = 32

# Of a vase or a doll that is about the largest line integral.
_BODIES = 2.8


@dataclass(frozen=True)
class XraySettings:
    """How the projections are fitted. Rates are Adam's; means are multiplied by the box's longest half side.

    Attributes:
        model: "additive", or "x_gaussian" for splats that are blended as in photos (`.x_gaussian`), which reads the
            rates of means, scales and rotation, `opacity_rate`, `intensity_rate`, `iterations`, `structure_weight`,
            `strategy` and `stop`, and nothing else.
        mode: of `render.radiograph`, "exact" or "affine".
        full_scale: what line integrals are divided by before they are compared: "peak" for the largest one trained
            on, "body" for what `body_scale` says, "box" for the density unit times half the box's longest side, which
            are R2-Gaussian's units.
        iterations: projections shown.
        growth: smaller projections at first: a share of a half averages 2 x 2 pixels, a third 3 x 3; never to fewer
            than 32 pixels a side.
        squares_weight: of the mean squared difference, which then stands in for L1; None for L1. What is left of a
            projection in the end is counting noise, whose likelihood squares are, and as they fall the total
            variation weighs more.
        straight_from: share of full scale from which differences count straight on, not squared; None for nowhere.
        structure_weight: of D-SSIM beside L1 or squares.
        smooth_weight: of the roughness of a block of voxels at a random place (`losses.total_variation`).
        smooth_edge: share of the density unit from which a difference in it counts as an edge, which is not smoothed
            (`losses.total_variation`); None for nowhere.
        smooth_voxels: side of that block.
        smooth_every: iterations between two blocks; their weight makes up for the pause.
        smooth_trial: whether a part of `smooth_weight` does better is tried on the way; None for all of it.
        cutoff_sigmas: where a splat ends while it is trained.
        whole: in the end densities are fitted to projections of whole splats; None for no. At 3 standard deviations one
            lacks 1 % of its mass, and its neighbours make up for it while they are trained: drawn, weighed and
            exported in full they have 0.7 % too much, which costs projections that were kept back 0.7 dB.
        least_scale, most_scale: limits of the scales as shares of the box's longest side.
        least_pixels: the same lower limit in detector pixels at the object, whichever is larger; in this fit.
            Projections hardly tell a sheet much thinner than a pixel from a thicker one of less density. A limit of
            0.4 keeps walls two voxels thin from being as thin as they are: 2.4 dB of the pharaoh's true sections and
            4 dB of its projections.
        memory: how much Adam keeps of its mean of squared gradients from step to step; 0.999 remembers longer than a
            short fit's gradients stay alike.
        strategy: densification.
        stop: ends the optimisation when projections set aside for this get no better; none if None.

    Raises:
        SettingError: an unknown model or full scale; a share that is not above 0, or without squares.
    """

    model: str = "additive"
    mode: str = "exact"
    full_scale: str = "peak"
    iterations: int = 5000
    growth: Growth = field(default_factory=Growth)
    squares_weight: float | None = None
    straight_from: float | None = None
    structure_weight: float = 0.25
    smooth_weight: float = 0.05
    smooth_edge: float | None = None
    smooth_voxels: int = 32
    smooth_every: int = 1
    smooth_trial: SmoothTrial | None = None
    cutoff_sigmas: float = 4.0
    whole: bool | None = None
    least_scale: float = 0.0005
    least_pixels: float = 0.1
    most_scale: float = 0.5
    means_rate: Decay = Decay(2e-4, 2e-5)
    density_rate: Decay = Decay(0.01, 0.001)
    scale_rate: Decay = Decay(0.005, 0.0005)
    rotation_rate: Decay = Decay(0.001, 0.0001)
    opacity_rate: float = 0.008
    intensity_rate: float = 0.002
    memory: float = 0.999
    strategy: DefaultStrategy = field(
        default_factory=lambda: DefaultStrategy(
            gradient=5e-5, prune_opacity=0.0, prune_density=1e-4, clone_size=0.01, split="along", share_density=True
        )
    )
    stop: Stop | None = None

    def __post_init__(self) -> None:
        check_choices(self, {"model": ("additive", "x_gaussian"), "full_scale": ("peak", "body", "box")})
        if self.straight_from is not None and not (self.squares_weight is not None and self.straight_from > 0):
            raise SettingError(
                "straight_from is {straight_from}, squares_weight {weight}; choose a share above 0 beside a weight of "
                "squares, or None.",
                straight_from=self.straight_from,
                weight=self.squares_weight,
            )


@dataclass
class _Fit:
    """Splats with their optimiser, what adds to them, and the weight of their smoothness."""

    parameters: Parameters
    densifier: Densifier
    smooth_weight: float

    def state(self) -> dict[str, Any]:
        return {"parameters": self.parameters.state(), "densifier": self.densifier.state()}

    def restore(self, state: dict[str, Any]) -> None:
        self.parameters.restore(state["parameters"])
        self.densifier.restore(state["densifier"])


class XrayTrainer:
    """Fits a set to projections; see `core.train.loop.Trainer`.

    Args:
        start: numpy set in mm.
        projections: those that are not held out are trained on, but for those that `settings.stop` sets aside.
        voxel_mm: side of the voxels in which smoothness is measured.
        density_unit: mm⁻¹, the size of the object's larger attenuations.
        offsets: what pixels add to all projections, learnt on the way, which must not grow; None for nothing.

    Attributes:
        training, validation: indices of the projections trained on, and of those set aside for `settings.stop`.
        smoothness: what `settings.smooth_trial` came to, see `TrialRun.verdict`; {} before it and without one.
    """

    def __init__(
        self,
        start: GaussianSet,
        projections: Projections,
        voxel_mm: float,
        density_unit: float,
        settings: XraySettings,
        seed: int,
        kernel: str,
        offsets: RingOffsets | None = None,
    ) -> None:
        self._projections, self._settings, self._offsets = projections, settings, offsets
        self._seed, self._kernel, self._voxel_mm = seed, kernel, voxel_mm
        shown = np.flatnonzero(~projections.held_out)
        aside = settings.stop.set_aside(len(shown)) if settings.stop else []
        # A projection that is not finite cannot be measured on.
        finite = [place for place in aside if np.isfinite(projections.images[shown[place]]).all()]
        self.training, self.validation = np.delete(shown, aside), shown[finite]
        self._peak = projections.peak(self.training)
        sides = projections.box_mm[1] - projections.box_mm[0]
        self.extent = float(sides.max()) / 2
        longest = float(sides.max())
        self._limits = ScaleLimits(
            max(settings.least_scale * longest, settings.least_pixels * projections.pixel_mm),
            settings.most_scale * longest,
        )
        self._density_unit = density_unit
        self._fit = self._fit_of(start, settings.smooth_weight)
        if settings.full_scale == "body":
            self._full_scale = body_scale(projections, self.training)
        else:
            self._full_scale = self._peak if settings.full_scale == "peak" else density_unit * self.extent
        self._grown: tuple[int, Projections] | None = None
        # The fit beside it while smoothness is on trial, the trial, and what came of it.
        self._rival: _Fit | None = None
        self._aside = np.zeros(0, np.int64)
        self._trial = None if settings.smooth_trial is None else TrialRun(settings.smooth_trial)
        self.smoothness: dict[str, float] = {}

    def __len__(self) -> int:
        return len(self.parameters)

    @property
    def parameters(self) -> Parameters:
        """What is trained; while smoothness is on trial, with all of its weight."""
        return self._fit.parameters

    @property
    def usual(self) -> bool:
        """Whether steps do what most of them do; not while two fits go on side by side."""
        return self._rival is None

    def step(self, iteration: int) -> float:
        """One projection; while smoothness is on trial, shown to both fits."""
        settings = self._settings
        self._try_less(iteration)
        index = self._choose(iteration)
        projections = self._shown_at(iteration / settings.iterations)
        loss = self._step(self._fit, projections, index, iteration)
        if self._trial is not None and self._rival is not None:
            self._step(self._rival, projections, index, iteration)
            self._trial.made += 1
            self._look(self._trial, self._rival)
        return loss

    def _step(self, fit: _Fit, projections: Projections, index: int, iteration: int) -> float:
        settings, parameters = self._settings, fit.parameters
        detector = projections.detectors[index]
        measured, offsets = projections.images[index], self._offsets
        shown = measured if offsets is None else measured - offsets.values
        target = torch.from_numpy(shown / np.float32(self._full_scale))
        current = parameters.activate()
        image = radiograph(current, detector, self._kernel, settings.mode, settings.cutoff_sigmas) / self._full_scale
        loss = projection_loss(
            image,
            target,
            settings.squares_weight,
            settings.structure_weight,
            settings.straight_from,
            projections.noise,
            self._full_scale,
        )
        loss.backward()
        if offsets is not None and fit is self._fit:
            offsets.observe(iteration, measured - image.detach().numpy() * np.float32(self._full_scale))
        watched = fit.densifier.watches(iteration)
        by_means = parameters.gradient("means").copy() if watched else None
        self._smooth(fit, iteration)
        if not parameters.step(self._rates(iteration / settings.iterations)):
            return float("nan")
        if by_means is not None:
            gradient = screen_gradient(by_means, current.means.detach().numpy(), detector)
            fit.densifier.observe(gradient, gradient > 0)
        fit.densifier.after_step(iteration)
        return float(loss.detach())

    def _fit_of(self, start: GaussianSet, smooth_weight: float) -> _Fit:
        settings = self._settings
        parameters = Parameters(
            start,
            ("means", "quats", "scales", "density"),
            density_unit=self._density_unit,
            limits=self._limits,
            memory=settings.memory,
        )
        box = self._projections.box_mm
        densifier = Densifier(settings.strategy, parameters, self.extent, settings.iterations, self._seed, box)
        return _Fit(parameters, densifier, smooth_weight)

    def finish(self) -> None:
        """Decides a trial that the end of the fit came before, by what was seen."""
        if self._rival is not None:
            self._decide()

    def _try_less(self, iteration: int) -> None:
        """Begins the trial of less smoothness, or decides it."""
        trial, settings = self._trial, self._settings
        if trial is None or self.smoothness:
            return
        begin = trial.settings.begin * settings.iterations
        if self._rival is None:
            due = iteration >= begin and settings.smooth_weight > 0
            if due and trial.settings.suits(settings.iterations, len(self.training)):
                self._begin_trial(trial, self._fit.state())
        # Where most iterations are left out, the rest is not for two fits.
        elif trial.made >= trial.settings.steps or iteration >= begin + 2 * trial.settings.steps:
            self._decide()

    def _look(self, trial: TrialRun, rival: _Fit) -> None:
        """Compares both fits on one of the projections set aside, if it is time."""
        index = trial.looks_at(self._aside)
        if index is None or not np.isfinite(self._projections.images[index]).all():
            return
        cut = self._settings.cutoff_sigmas
        less, full = (self._psnr(fit.parameters.to_set(), index, self._peak, cut) for fit in (rival, self._fit))
        trial.gains_db.append((index, less - full))

    def _decide(self) -> None:
        assert self._trial is not None
        self.smoothness = self._trial.verdict()
        if self.smoothness["share"] < 1 and self._rival is not None:
            self._fit = self._rival
        self._rival, self.training = None, np.union1d(self.training, self._aside)

    def _begin_trial(self, trial: TrialRun, state: dict[str, Any]) -> None:
        """A second fit, as `state` has it."""
        rival = self._fit_of(self.parameters.to_set(), trial.settings.share * self._settings.smooth_weight)
        rival.restore(state)
        self._rival = rival
        self._aside = trial.settings.set_aside(self.training)
        self.training = np.setdiff1d(self.training, self._aside)

    def _shown_at(self, fraction: float) -> Projections:
        """The projections at the size of a fraction 0..1 of the iterations."""
        shortest = min(self._projections.images.shape[1:])
        block = max(1, min(round(1 / self._settings.growth.share(fraction)), shortest // _LEAST_PIXELS))
        if self._grown is None or self._grown[0] != block:
            self._grown = (block, self._projections if block == 1 else self._projections.in_blocks(block))
        return self._grown[1]

    def measure(self, tick: Tick = unstopped) -> Measured:
        """Of some held-out projections; full scale is the largest value of all of them."""
        views, peak = some_held_out(self._projections), projection_peak(self._projections)
        return known({"projections": self._quality(views, peak, tick)})

    def validate(self, tick: Tick = unstopped) -> float | None:
        """Mean PSNR over the projections set aside; full scale is the largest value trained on."""
        return self._quality(self.validation, self._peak, tick)

    def _quality(self, indices: np.ndarray, peak: float, tick: Tick) -> float | None:
        current, values = self.parameters.to_set(), []
        for index in indices:
            tick()
            if np.isfinite(self._projections.images[index]).all():
                values.append(self._psnr(current, index, peak))
        return float(np.mean(values)) if values else None

    def _psnr(self, gaussians: GaussianSet, index: int, peak: float, cutoff_sigmas: float = CUTOFF_SIGMAS) -> float:
        with torch.no_grad():
            how = self._kernel, self._settings.mode, cutoff_sigmas
            image = radiograph(gaussians.to_torch(), self._projections.detectors[index], *how).numpy()
        return psnr(image, self._projections.images[index], peak)

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        offsets = {} if self._offsets is None else {"offsets": self._offsets.state()}
        rival = {} if self._rival is None else {"rival": self._rival.state()}
        trial = {} if self._trial is None else {"trial": self._trial.state(), "smoothness": dict(self.smoothness)}
        return {**self._fit.state(), **offsets, **trial, **rival}

    def restore(self, state: dict[str, Any]) -> None:
        """From a checkpoint."""
        self._fit.restore(state)
        if self._offsets is not None:
            self._offsets.restore(state["offsets"])
        if self._trial is None:
            return
        self._trial.restore(state["trial"])
        self.smoothness = dict(state["smoothness"])
        self._fit.smooth_weight = self._settings.smooth_weight * self.smoothness.get("share", 1.0)
        if "rival" in state:
            self._begin_trial(self._trial, state["rival"])

    def _smooth(self, fit: _Fit, iteration: int) -> None:
        settings, unit = self._settings, self._density_unit
        if fit.smooth_weight <= 0 or iteration % settings.smooth_every:
            return
        rng = np.random.default_rng([self._seed, 3, iteration])
        rough = block_variation(
            fit.parameters.activate(),
            self._projections.box_mm,
            self._voxel_mm,
            settings.smooth_voxels,
            settings.cutoff_sigmas,
            rng,
            None if settings.smooth_edge is None else settings.smooth_edge * unit,
        )
        (fit.smooth_weight * settings.smooth_every / unit * rough).backward()

    def _choose(self, iteration: int) -> int:
        return int(shuffled(self.training, iteration, self._seed, 2))

    def _rates(self, fraction: float) -> dict[str, float]:
        settings = self._settings
        return {
            "means": settings.means_rate.at(fraction) * self.extent,
            "quats": settings.rotation_rate.at(fraction),
            "scales": settings.scale_rate.at(fraction),
            "density": settings.density_rate.at(fraction),
        }


def body_scale(projections: Projections, indices: Sequence[int] | np.ndarray) -> float:
    """Full scale of some projections: the largest line integral, or 2.8 times what rays through most of the object
    measure (`Projections.body`), whichever is less.

    Where a little steel has the largest, walls of plastic are a hundredth of it, and what is left of their squares is
    far under the total variation: the toy gun's true sections were 1.4 dB further off.
    """
    return min(projections.peak(indices), _BODIES * projections.body(indices))


def screen_gradient(by_means: np.ndarray, means: np.ndarray, detector: Detector) -> np.ndarray:
    """Size (N,) of the loss's gradient by the projected centres, in normalised device coordinates.

    A centre moves over the detector by one pixel when it moves by u or v (mm a pixel), shortened by how far towards
    the source it lies.

    Args:
        by_means: (N, 3) gradient by the means, per mm.
        means: (N, 3) mm.
    """
    u, v = np.asarray(detector.u, np.float64), np.asarray(detector.v, np.float64)
    # Matrix products stay in the gradient's type: as float64 this took a twelfth of a training step.
    across = by_means @ (u * (detector.width / 2)).astype(by_means.dtype)
    down = by_means @ (v * (detector.height / 2)).astype(by_means.dtype)
    length = np.sqrt(across * across + down * down)
    if not detector.parallel:
        source, normal = np.asarray(detector.source, np.float64), np.cross(u, v)
        normal /= float((np.asarray(detector.center, np.float64) - source) @ normal)
        share = means @ normal.astype(means.dtype) - means.dtype.type(source @ normal)
        length *= np.maximum(share, 0)
    return length.astype(np.float32, copy=False)
