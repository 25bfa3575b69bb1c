"""Line integrals through a voxel volume, for measuring volumes on held-out projections."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.ndimage import map_coordinates

from ..capture.model import Projections
from ..views import Detector
from ..volume import Volume
from .heldout import Figures, projection_peak
from .metrics import psnr

_STEPS_PER_VOXEL = 2.0


def line_integrals(volume: Volume, detector: Detector) -> np.ndarray:
    """(height, width) float32 integrals of the attenuation along the detector's rays, no unit.

    Trilinear values at the middles of steps of half the smallest voxel side, from where the first ray can enter the
    grid to where the last leaves it; outside of it there is air.
    """
    origins, directions = detector.rays()
    spacing, box = np.asarray(volume.spacing_mm, np.float64), volume.box_mm
    middle, radius = box.mean(axis=0), 0.5 * float(np.linalg.norm(box[1] - box[0]))
    along = ((middle - origins) * directions).sum(axis=-1)
    count = max(1, int(np.ceil(2 * radius * _STEPS_PER_VOXEL / spacing.min())))
    step = 2 * radius / count
    values = np.ascontiguousarray(volume.values, np.float32)
    total = np.zeros(along.shape)
    for index in range(count):
        points = origins + (along - radius + (index + 0.5) * step)[..., None] * directions
        place = (points - volume.origin_mm) / spacing
        total += map_coordinates(values, np.moveaxis(place[..., ::-1], -1, 0), order=1, mode="grid-constant")
    return (step * total).astype(np.float32)


def volume_projection_figures(volume: Volume, projections: Projections, tick: Callable[[], None]) -> Figures:
    """`heldout.projection_figures` of a volume: mean PSNR (dB) over the held-out projections.

    Args:
        tick: called between projections; may raise to stop.
    """
    peak, values = projection_peak(projections), []
    for index in np.flatnonzero(projections.held_out):
        tick()
        shown = line_integrals(volume, projections.detectors[index])
        values.append(psnr(shown, projections.images[index], peak))
    return {"psnr": float(np.mean(values)) if values else None, "count": len(values)}
