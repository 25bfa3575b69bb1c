"""X-Gaussian (Cai et al. 2024, arXiv 2403.04116): projections as photos of splats that glow and hide one another.

Line integrals over the largest one trained on, one number for all projections, are taken for images in 0..1 on black
and fitted by alpha blending from front to back. Each splat has an opacity and one intensity, the same from all sides.
Its reader's faults are not followed: pixels have their true pitch, detectors their offsets and tilts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from ...capture.model import Projections
from ...capture.pinhole import camera_of
from ...evaluate.heldout import projection_peak, some_held_out
from ...evaluate.metrics import psnr
from ...gaussians import GaussianSet
from ...progress import Tick, unstopped
from ...render import section, splat
from ...sections import SectionView
from ...spherical_harmonics import C0
from ...train.loop import Measured, known
from ...train.losses import image_loss
from ...train.parameters import Parameters, ScaleLimits
from ...train.schedule import shuffled
from ...train.strategy import Densifier
from ...views import Camera
from .photos import scene_extent
from .xray import XraySettings


class XGaussianTrainer:
    """Fits a set to projections; see `core.train.loop.Trainer`.

    Args:
        start: numpy set in mm; its opacities and colours are trained on, its densities are of no use here.
        projections: those that are not held out are trained on, but for those that `settings.stop` sets aside.
        settings: with `model` "x_gaussian".

    Attributes:
        training, validation: indices of the projections trained on and of those set aside.

    Raises:
        CaptureError: a projection that no camera can show.
    """

    def __init__(
        self, start: GaussianSet, projections: Projections, settings: XraySettings, seed: int, kernel: str
    ) -> None:
        self._projections, self._settings, self._seed, self._kernel = projections, settings, seed, kernel
        shown = np.flatnonzero(~projections.held_out)
        aside = settings.stop.set_aside(len(shown)) if settings.stop else []
        self.training, self.validation = np.delete(shown, aside), shown[list(aside)]
        self._peak = projections.peak(self.training)
        self._cameras: list[Camera] = [camera_of(detector) for detector in projections.detectors]
        self.extent = self._scene_extent()
        self.parameters = Parameters(
            start.with_sh_coefficients(1),
            ("means", "quats", "scales", "opacities", "sh_dc"),
            limits=ScaleLimits(1e-6 * self.extent, self.extent),
        )
        self._densifier = Densifier(settings.strategy, self.parameters, self.extent, settings.iterations, seed)

    def __len__(self) -> int:
        return len(self.parameters)

    def step(self, iteration: int) -> float:
        """One projection."""
        settings = self._settings
        index = self._choose(iteration)
        camera = self._cameras[index]
        target = torch.from_numpy(self._projections.images[index] / np.float32(self._peak))
        image = splat(self.parameters.activate(), camera, kernel=self._kernel)
        # The other two colours only keep it company: their coefficients get no gradient.
        loss = image_loss(image.color[..., 0].contiguous(), target, settings.structure_weight)
        loss.backward()
        if not self.parameters.step(self._rates(iteration / settings.iterations)):
            return float("nan")
        info = image.info
        self._densifier.observe_pixels(info.screen_grad.numpy(), info.visible.numpy(), camera.width, camera.height)
        self._densifier.after_step(iteration)
        return float(loss.detach())

    def result(self) -> GaussianSet:
        """The current set; the intensity in all three colours, density 0 (see `with_density`)."""
        current = self.parameters.to_set()
        grey = np.repeat(current.sh[:, :, :1], 3, axis=2)
        return replace(current, sh=grey, density=np.zeros_like(current.density))

    def image(self, index: int) -> np.ndarray:
        """(height, width) float32, the line integrals that the splats show in a projection's place."""
        return projected(self.result(), self._cameras[index], self._peak, self._kernel)

    def measure(self, tick: Tick = unstopped) -> Measured:
        """Of some held-out projections; full scale is the largest value of all of them."""
        views, peak = some_held_out(self._projections), projection_peak(self._projections)
        return known({"projections": self._quality(views, peak, tick)})

    def validate(self, tick: Tick = unstopped) -> float | None:
        """Mean PSNR over the projections set aside; full scale is the largest value trained on."""
        return self._quality(self.validation, self._peak, tick)

    def _scene_extent(self) -> float:
        """As 3DGS has it; of a parallel beam, whose cameras may stand anywhere on their rays, the box's diagonal."""
        if self._projections.detectors[0].parallel:
            return float(np.linalg.norm(np.ptp(self._projections.box_mm, axis=0)))
        return scene_extent([self._cameras[i] for i in self.training])

    def _quality(self, indices: np.ndarray, peak: float, tick: Tick) -> float | None:
        values = []
        for index in indices:
            tick()
            if not np.isfinite(self._projections.images[index]).all():
                continue
            values.append(psnr(self.image(index), self._projections.images[index], peak))
        return float(np.mean(values)) if values else None

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"parameters": self.parameters.state(), "densifier": self._densifier.state()}

    def restore(self, state: dict[str, Any]) -> None:
        """From a checkpoint."""
        self.parameters.restore(state["parameters"])
        self._densifier.restore(state["densifier"])

    def _choose(self, iteration: int) -> int:
        return int(shuffled(self.training, iteration, self._seed, 2))

    def _rates(self, fraction: float) -> dict[str, float]:
        settings = self._settings
        return {
            "means": settings.means_rate.at(fraction) * self.extent,
            "quats": settings.rotation_rate.at(fraction),
            "scales": settings.scale_rate.at(fraction),
            "opacities": settings.opacity_rate,
            "sh_dc": settings.intensity_rate,
        }


def projected(gaussians: GaussianSet, camera: Camera, peak: float, kernel: str = "cpu") -> np.ndarray:
    """(height, width) float32 line integrals that an X-Gaussian set shows; white stands for `peak`."""
    with torch.no_grad():
        return splat(gaussians.to_torch(), camera, kernel=kernel).color[..., 0].numpy() * np.float32(peak)


def intensity(gaussians: GaussianSet) -> np.ndarray:
    """(N,) the intensity of each splat, max(0, ½ + C₀·f) of its first colour coefficient f."""
    return np.maximum(0.5 + C0 * np.asarray(gaussians.sh)[:, 0, 0], 0.0).astype(np.float32)


def with_density(
    gaussians: GaussianSet, views: Sequence[SectionView], references: Sequence[np.ndarray], kernel: str = "cpu"
) -> GaussianSet:
    """The set with attenuations, which the model does not have, so that it can be cut like the others.

    Opacity · intensity is what a splat adds to a pixel through its middle when nothing lies before it. It is read in
    two ways: as a line integral, so that the density is it over √(2π) times the scale (the geometric mean of the
    three, as no direction is the one), and as a density itself. Each gets the one factor to mm⁻¹ that fits the
    sections of a reference best (least squares); the way that comes nearer is taken.

    Args:
        gaussians: numpy set of `XGaussianTrainer.result`.
        views: sections for training only, never held-out ones.
        references: of each view (H, W) attenuation in mm⁻¹, of the volume that the other models are given too.

    Raises:
        ValueError: a held-out section.
    """
    if any(view.held_out for view in views):
        raise ValueError("with_density: a held-out section was given to fit to")
    added = np.asarray(gaussians.opacities) * intensity(gaussians)
    scales = np.maximum(np.asarray(gaussians.scales, np.float64), 1e-12)
    across = np.sqrt(2 * np.pi) * np.exp(np.log(scales).mean(axis=1))
    fits = [
        _fitted(replace(gaussians, density=relative.astype(np.float32)), views, references, kernel)
        for relative in (added / across, added)
    ]
    return min(fits, key=lambda fit: fit[1])[0]


def _fitted(
    relative: GaussianSet, views: Sequence[SectionView], references: Sequence[np.ndarray], kernel: str
) -> tuple[GaussianSet, float]:
    """The set with its densities times the factor that fits sections best, and the sum of squares left of them."""
    tensors = relative.to_torch()
    shared = squared = whole = 0.0
    for view, reference in zip(views, references, strict=True):
        with torch.no_grad():
            cut = section(tensors, view.plane, "density", kernel).numpy().astype(np.float64)
        shared += float((cut * reference).sum())
        squared += float((cut**2).sum())
        whole += float((np.asarray(reference, np.float64) ** 2).sum())
    factor = max(shared, 0.0) / max(squared, 1e-30)
    scaled = replace(relative, density=(factor * relative.density).astype(np.float32))
    return scaled, whole - 2 * factor * shared + factor**2 * squared
