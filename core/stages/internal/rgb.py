"""The photo half of `internal`: splats onto the outer contour, colours frozen, photos kept as good as they were."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from ...gaussians import GaussianSet
from ...render import section
from ...sections import SectionView
from ...train.losses import image_loss, zero_one
from ..photo_series import PhotoSeries
from .targets import SectionSeries

# Contours further than this many median spacings from every splat were never photographed: no splat is to be
# stretched over them.
_REACH_SPACINGS = 4.0


class ContourLoss:
    """One section and one photo an iteration.

    Section: occupancy against the band along the outer contour; occupancy instead of brightness because colours are
    frozen. The band pulls splats onto the contour, the rest of the section empties the inside. Photo: the usual
    (1 − λs) L1 + λs D-SSIM, which keeps what the contour knows nothing of. Opacities are pushed to 0 or 1.

    Args:
        gaussians: the numpy set at the start; it tells which contours photos have seen.
        spacing_mm: median distance of neighbouring splats.
        series: the volume's sections.
        photos: training photos with cameras in the world frame.
        section_weight: of the section's term; the photo's is 1.
        structure_weight, zero_one_weight: λs, λz.
        kernel: of the renderers.
    """

    def __init__(
        self,
        gaussians: GaussianSet,
        spacing_mm: float,
        series: SectionSeries,
        photos: PhotoSeries,
        section_weight: float,
        structure_weight: float,
        zero_one_weight: float,
        kernel: str,
    ) -> None:
        self._seen = cKDTree(gaussians.means[gaussians.opacities > 0.1])
        self._reach = _REACH_SPACINGS * max(spacing_mm, float(np.max(series.volume.spacing_mm)))
        self._series, self._photos = series, photos
        self._section_weight, self._structure_weight = section_weight, structure_weight
        self._zero_one_weight, self._kernel = zero_one_weight, kernel

    def __call__(self, gaussians: GaussianSet, iteration: int) -> Tensor:
        view = self._series.view(iteration)
        target = self._series.edge(view)
        weight = target.weight * self._photographed(view, target.band)
        occupancy = section(gaussians, view.plane, "occupancy", kernel=self._kernel) * weight
        total = self._section_weight * self._compare(occupancy, target.band * weight)
        index, camera, photo = self._photos.training(iteration)
        seen = self._photos.draw_training(gaussians, index, camera, self._kernel)
        total = total + self._compare(seen.color, photo)
        return total + self._zero_one_weight * zero_one(gaussians.opacities)

    def _compare(self, image: Tensor, target: Tensor) -> Tensor:
        return image_loss(image, target, self._structure_weight)

    def _photographed(self, view: SectionView, band: Tensor) -> Tensor:
        """(H, W) 0 on parts of the band that no splat is near, else 1."""
        where = band.numpy() > 0
        weight = np.ones(where.shape, np.float32)
        if where.any():
            distance, _ = self._seen.query(view.plane.points()[where], distance_upper_bound=self._reach)
            weight[where] = np.isfinite(distance)
        return torch.from_numpy(weight)
