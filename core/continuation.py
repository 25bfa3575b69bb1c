"""Projections of an object that is wider than the detector, continued at both sides for filtered backprojection.

Hsieh et al., Med. Phys. 31(9), 2004: what was cut off is taken for a cylinder of water that goes on from the border as
high and as steep as the measured row ends there. A row that stops in the middle of the object has a step in it, which
the ramp filter makes a bright rim and a hollow middle of.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .views import Detector

# Columns at a border that say how high and how steep a row ends, as a share of its width.
_BORDER, _FEWEST = 0.05, 3
_NEARLY_ALL = 99.0


def continued(detectors: list[Detector], images: np.ndarray, share: float) -> tuple[list[Detector], np.ndarray]:
    """Wider detectors about the same middle, and their images: the measured ones between two continuations.

    The cylinders have the attenuation of one as wide as the detector whose middle takes as much as nearly all rays do;
    where a row ends in air, nothing is added.

    Args:
        images: (M, height, width) line integrals, rows at right angles to the axis of rotation.
        share: how far a continuation may reach beyond either side, of the width.

    Returns:
        M detectors and (M, height, width + 2 · extra) float32.
    """
    count, height, width = images.shape
    extra = int(np.ceil(share * width))
    wide = np.zeros((count, height, width + 2 * extra), np.float32)
    wide[:, :, extra : extra + width] = images
    finite = images[np.isfinite(images)]
    density = max(float(np.percentile(finite, _NEARLY_ALL)) if finite.size else 0.0, 0.0) / width
    if density > 0:
        wide[:, :, extra + width :] = _beyond(images, extra, density)
        wide[:, :, :extra] = _beyond(images[:, :, ::-1], extra, density)[:, :, ::-1]
    return [replace(detector, width=width + 2 * extra) for detector in detectors], wide


def _beyond(images: np.ndarray, extra: int, density: float) -> np.ndarray:
    """(M, height, extra) what follows after the last column.

    Squares of a cylinder's line integrals 2 μ √(R² − x²) are a parabola of curvature 4 μ².

    Args:
        density: μ, of a pixel's width.
    """
    columns = min(max(_FEWEST, round(_BORDER * images.shape[2])), images.shape[2])
    last = np.where(np.isfinite(images[:, :, -columns:]), images[:, :, -columns:], 0.0).astype(np.float64)
    place = np.arange(columns) - 0.5 * (columns - 1)
    slope = (last @ place) / max(float(place @ place), 1.0)
    # A row that still rises goes on level: how far it would rise, nobody knows.
    height = np.maximum(last.mean(axis=2) + slope * place[-1], 0.0)
    slope = np.minimum(slope, 0.0)
    away = np.arange(1, extra + 1)
    squares = height[..., None] ** 2 + 2 * (height * slope)[..., None] * away - 4 * density**2 * away**2
    return np.asarray(np.sqrt(np.maximum(squares, 0.0)), np.float32)
