"""The X-ray half of `internal`: densities towards sections, then display opacities towards material."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ...capture.model import Projections
from ...gaussians import GaussianSet
from ...render import radiograph, section
from ...train.losses import image_loss, zero_one
from ...train.schedule import shuffled
from ..refine import train_only
from .targets import SectionSeries, soft_material

# Views of each kind that the balance of the two terms is measured on.
_BALANCE_VIEWS = 6
_HAZE = np.float32(0.05)


class DensityLoss:
    """One section and one projection an iteration, each with (1 − λs) L1 + λs D-SSIM of images scaled to about 0..1.

    The projection keeps held-out projections from getting worse: sections of an FDK volume carry its noise and
    streaks, and a set that followed them alone would follow those too.

    The zero-one term of the paper's loss is not here: attenuation takes every value, so densities stay free
    (see `DisplayLoss`).

    Args:
        series: the volume's sections.
        projections: line integrals; None for a volume without projections.
        projection_weight: of the projection's term beside the section's, both relative to what they were at the
            start (`balance`).
        structure_weight: λs.
        kernel: of the renderers.
        seed: of the order.
    """

    def __init__(
        self,
        series: SectionSeries,
        projections: Projections | None,
        projection_weight: float,
        structure_weight: float,
        kernel: str,
        seed: int,
    ) -> None:
        self._series, self._projections = series, projections
        self._projection_weight, self._structure_weight = projection_weight, structure_weight
        self._kernel, self._seed = kernel, seed
        self._training: list[int] = []
        self._full_scale, self._factor = 1.0, 1.0
        if projections is not None:
            self._training = np.flatnonzero(~projections.held_out).tolist()
            self._full_scale = projections.peak(self._training)

    def balance(self, start: GaussianSet) -> float:
        """Brings both terms to one size, as they are for the numpy set `start`, and returns the projection's factor.

        After `surface` the set fits projections many times better than sections. Unbalanced, the larger section
        term would win at the cost of the projections.
        """
        if not self._training:
            return 0.0
        tensors, places = start.to_torch(), range(_BALANCE_VIEWS)
        with torch.no_grad():
            sections = [float(self._section_loss(tensors, i)) for i in places]
            projections = [float(self._projection_loss(tensors, i)) for i in places]
        # A projection with holes says nothing of its size.
        finite = [loss for loss in projections if np.isfinite(loss)]
        if finite:
            self._factor = float(np.mean(sections)) / max(float(np.mean(finite)), 1e-12)
        return self._factor

    def __call__(self, gaussians: GaussianSet, iteration: int) -> Tensor:
        total = self._section_loss(gaussians, iteration)
        weight = self._factor * self._projection_weight
        if self._training and weight > 0:
            total = total + weight * self._projection_loss(gaussians, iteration)
        return total

    def _section_loss(self, gaussians: GaussianSet, iteration: int) -> Tensor:
        view = self._series.view(iteration)
        cut = section(gaussians, view.plane, "density", kernel=self._kernel)
        return self._compare(cut, self._series.density(view), self._series.scale)

    def _projection_loss(self, gaussians: GaussianSet, iteration: int) -> Tensor:
        assert self._projections is not None
        index = shuffled(self._training, iteration, self._seed)
        lines = radiograph(gaussians, self._projections.detectors[index], kernel=self._kernel)
        target = torch.from_numpy(np.asarray(self._projections.images[index], np.float32))
        return self._compare(lines, target, self._full_scale)

    def _compare(self, image: Tensor, target: Tensor, full_scale: float) -> Tensor:
        image, target = image / full_scale, target / full_scale
        return image_loss(image, target, self._structure_weight)


class DisplayLoss:
    """Display opacities: the section's occupancy towards the volume's material, and each opacity towards 0 or 1.

    Shape and density of the splats get no gradient from here.
    """

    def __init__(self, series: SectionSeries, structure_weight: float, zero_one_weight: float, kernel: str) -> None:
        self._series = series
        self._structure_weight, self._zero_one_weight = structure_weight, zero_one_weight
        self._kernel = kernel

    def __call__(self, gaussians: GaussianSet, iteration: int) -> Tensor:
        solid = train_only(gaussians, "opacities")
        view = self._series.view(iteration)
        shown = section(solid, view.plane, "occupancy", kernel=self._kernel)
        target = self._series.material(view)
        difference = image_loss(shown, target, self._structure_weight)
        return difference + self._zero_one_weight * zero_one(solid.opacities)


def start_display(gaussians: GaussianSet, series: SectionSeries) -> GaussianSet:
    """The numpy set with display opacities from the volume's material at each centre, between 0.002 and 0.98.

    `surface` gives radiative splats no opacity that means anything. Starting short of 0 and 1 they can still be
    learnt; air starts lower, because many faint splats one behind the other make a haze.
    """
    material = soft_material(series.volume.sample(gaussians.means), series.threshold)
    return replace(gaussians, opacities=(0.002 + 0.978 * material).astype(np.float32))


def clear_haze(gaussians: GaussianSet) -> GaussianSet:
    """The numpy set with display opacities under 0.05 set to 0: what the zero-one loss was taking them to."""
    return replace(gaussians, opacities=np.where(gaussians.opacities < _HAZE, 0, gaussians.opacities))
