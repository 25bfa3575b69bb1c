"""3DGS on the photos (Kerbl et al. 2023, arXiv 2308.04079)."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ...evaluate.heldout import some_of
from ...evaluate.metrics import psnr
from ...gaussians import GaussianSet
from ...progress import Tick, unstopped
from ...render import splat
from ...render.options import SplatOptions
from ...render.splat import PUBLISHED_LOW_PASS, SplatImage
from ...train.loop import Measured, known
from ...train.losses import image_loss, masked_loss
from ...train.parameters import Parameters, ScaleLimits
from ...train.schedule import Decay, Growth, Stop, active_degree, in_iterations, shuffled
from ...train.strategy import DefaultStrategy, Strategy
from ...views import Camera
from .photos import TrainingPhotos, scene_extent

if TYPE_CHECKING:
    from ...effects import Effect


@dataclass(frozen=True)
class RgbSettings:
    """How the photos are fitted. Rates are Adam's, as in 3DGS; means are multiplied by the scene's extent.

    Attributes:
        iterations: photos shown.
        long_side: photos are scaled down to this many pixels.
        growth: smaller images at first.
        structure_weight: λ of D-SSIM beside L1.
        mask_weight: of |alpha − mask| where the background is plain, which keeps it free of splats.
        degree: highest degree of the colour functions.
        degree_every: one degree more after this fraction of the iterations.
        decay: what the rates of splats, but that of means, are multiplied by on the way; 3DGS's stay as they are.
        decay_iterations: so many take it all the way; in fewer it falls by as much in each, so less in all, and in more
            all the way, but slower.
        strategy: densification: `DefaultStrategy` (3DGS), `McmcStrategy` or `MaskStrategy`.
        passes: each photo is shown at most so many times, 0 for no such limit: shown again and again, few photos are
            learnt by heart, and others between them are shown worse.
        splats_per_pair: at most so many splats times the square of how many photos there are, 0 for no such limit: each
            place has to be seen by several, or splats show what one photo has of its own.
        stop: ends the optimisation when photos set aside for this get no better; none if None.
        pixel_integration: splats are averaged over pixels (Analytic-Splatting, arXiv 2403.11056). The model has to be
            shown with `options` from then on, as with `low_pass` and `mip_filter`.
        low_pass, mip_filter: px² that splats are widened by in images, and whether they become fainter for it; see
            `core.render.splat`.
        effects: what the photos show besides the object, settings of `core.effects`; learnt with the splats.
    """

    iterations: int = 7000
    long_side: int = 800
    growth: Growth = field(default_factory=Growth)
    structure_weight: float = 0.2
    mask_weight: float = 0.1
    degree: int = 3
    degree_every: float = 0.1
    means_rate: Decay = Decay(1.6e-4, 1.6e-6)
    sh_rate: float = 2.5e-3
    opacity_rate: float = 0.05
    scale_rate: float = 0.005
    rotation_rate: float = 0.001
    decay: Decay = Decay(1.0)
    decay_iterations: int = 7000
    strategy: Strategy = field(default_factory=DefaultStrategy)
    passes: int = 0
    splats_per_pair: float = 0.0
    stop: Stop | None = None
    pixel_integration: bool = False
    low_pass: float = PUBLISHED_LOW_PASS
    mip_filter: bool = False
    effects: tuple[Effect, ...] = ()

    def for_photos(self, count: int) -> RgbSettings:
        """The settings for so many photos to train on: no more iterations and splats than these bear."""
        settings = in_iterations(self, int(min(self.iterations, self.most_iterations(count))))
        if self.splats_per_pair:
            most = max(1, round(self.splats_per_pair * count**2))
            settings = replace(settings, strategy=settings.strategy.at_most(most))
        return settings

    def most_iterations(self, count: int) -> float:
        """That so many photos to train on bear, however much time there is."""
        return max(1, self.passes * count) if self.passes else math.inf

    @property
    def options(self) -> SplatOptions:
        """How a model that is trained with these settings is drawn."""
        return SplatOptions(self.pixel_integration, self.low_pass, self.mip_filter)

    @property
    def renderers(self) -> tuple[str, ...]:
        """The kernels that a training takes; see `core.render.kernels.cpu.is_compiled`."""
        return ("splat", "splat_effects") if self.pixel_integration or self.strategy.masked else ("splat",)


class RgbTrainer:
    """Fits a set to photos; see `core.train.loop.Trainer`.

    Args:
        start: numpy set in the photo frame.
        photos: to train on.
        heldout: to measure on.
        background: (3,) colour behind the object, black if None.
        validation: photos set aside for `settings.stop`.

    Attributes:
        options: how the model is drawn, here and wherever it is shown or measured.
    """

    def __init__(
        self,
        start: GaussianSet,
        photos: TrainingPhotos,
        heldout: TrainingPhotos,
        background: np.ndarray | None,
        settings: RgbSettings,
        seed: int,
        kernel: str,
        validation: TrainingPhotos | None = None,
    ) -> None:
        self._photos, self.heldout, self._settings = photos, heldout, settings
        self._validation = validation
        self._seed, self._kernel = seed, kernel
        self.options = settings.options
        self._background = torch.as_tensor(np.zeros(3) if background is None else background, dtype=torch.float32)
        self.extent = scene_extent(photos.cameras)
        self.parameters = Parameters(
            start.with_sh_coefficients((settings.degree + 1) ** 2),
            ("means", "quats", "scales", "opacities", "sh_dc", "sh_rest"),
            limits=ScaleLimits(1e-6 * self.extent, self.extent),
        )
        self._densifier = settings.strategy.begin(self.parameters, self.extent, settings.iterations, seed)
        self.effects = None
        if settings.effects:
            from ...effects import PhotoEffects

            self.effects = PhotoEffects(settings.effects, photos.cameras, self.extent)

    def __len__(self) -> int:
        return len(self.parameters)

    def step(self, iteration: int) -> float:
        """One photo."""
        settings, fraction = self._settings, iteration / self._settings.iterations
        photo = self._choose(iteration)
        camera, target, mask = self._photos.read(photo, settings.growth.share(fraction))
        degree = active_degree(iteration, round(settings.degree_every * settings.iterations), settings.degree)
        current, masks = self.parameters.activate(), self._densifier.masks(iteration)

        def draw(gaussians: GaussianSet, camera: Camera, *masks: torch.Tensor) -> SplatImage:
            return self._draw(gaussians, camera, *masks, sh_degree=degree)

        per_splat = () if masks is None else (masks,)
        if self.effects:
            image = self.effects.render(photo, draw, current, camera, *per_splat)
        else:
            image = draw(current, camera, *per_splat)
        weight = settings.structure_weight
        if mask is None or settings.mask_weight <= 0:
            loss = image_loss(image.color, target, weight)
        else:
            loss = masked_loss(image.color, target, weight, image.alpha, mask, settings.mask_weight)
        penalty = self._densifier.penalty(current)
        if penalty is not None:
            loss = loss + penalty
        if self.effects:
            loss = loss + self.effects.penalty(photo)
        loss.backward()
        rates = self._rates(fraction)
        if not self.parameters.step(rates):
            if self.effects:
                self.effects.forget_gradients()
            return float("nan")
        if self.effects:
            self.effects.step(photo, fraction)
        info = image.info
        self._densifier.observe_pixels(info.screen_grad.numpy(), info.visible.numpy(), camera.width, camera.height)
        self._densifier.after_step(iteration, rates)
        return float(loss.detach())

    def measure(self, tick: Tick = unstopped) -> Measured:
        """Of some held-out photos, with effects fitted to each (`PhotoEffects.fitted`)."""
        return known({"photos": self._quality(self.heldout, some_of(len(self.heldout)), tick)})

    def validate(self, tick: Tick = unstopped) -> float | None:
        """Mean PSNR over the photos set aside for `settings.stop`."""
        photos = self._validation
        return None if photos is None else self._quality(photos, range(len(photos)), tick)

    def _quality(self, photos: TrainingPhotos, chosen: Iterable[int], tick: Tick) -> float | None:
        values = []
        current = self.parameters.to_set().to_torch()
        for index in chosen:
            tick()
            camera, target, _ = photos.read(int(index))
            with torch.no_grad():
                image = self._shown(current, camera, target, tick).color
            values.append(psnr(image.clamp(0, 1).numpy(), target.numpy(), 1.0))
        known = [value for value in values if value is not None]
        return float(np.mean(known)) if known else None

    def _shown(self, gaussians: GaussianSet, camera: Camera, target: torch.Tensor, tick: Tick) -> SplatImage:
        if self.effects:
            return self.effects.fitted(self._draw, gaussians, camera, target, tick=tick)
        return self._draw(gaussians, camera)

    def _draw(
        self, gaussians: GaussianSet, camera: Camera, *masks: torch.Tensor, sh_degree: int | None = None
    ) -> SplatImage:
        """As `splat`; `masks` are none or one tensor (N,)."""
        return splat(
            gaussians,
            camera,
            self._background,
            kernel=self._kernel,
            sh_degree=sh_degree,
            masks=masks[0] if masks else None,
            **vars(self.options),
        )

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        kept = {"parameters": self.parameters.state(), "densifier": self._densifier.state()}
        return {**kept, "effects": self.effects.state()} if self.effects else kept

    def restore(self, state: dict[str, Any]) -> None:
        """From a checkpoint."""
        self.parameters.restore(state["parameters"])
        self._densifier.restore(state["densifier"])
        if self.effects:
            self.effects.restore(state["effects"])

    def _choose(self, iteration: int) -> int:
        return shuffled(range(len(self._photos)), iteration, self._seed, 1)

    def _rates(self, fraction: float) -> dict[str, float]:
        settings = self._settings
        part = min(settings.iterations / max(settings.decay_iterations, 1), 1.0)
        share = settings.decay.to_the_power(part).at(fraction)
        return {
            "means": settings.means_rate.at(fraction) * self.extent,
            "quats": share * settings.rotation_rate,
            "scales": share * settings.scale_rate,
            "opacities": share * settings.opacity_rate,
            "sh_dc": share * settings.sh_rate,
            "sh_rest": share * settings.sh_rate / 20,
        }
