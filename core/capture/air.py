"""What readings of a detector show of air: whether there is any, which makes them readings, and how bright it is."""

from __future__ import annotations

import numpy as np

# Share of the pixels of readings that noise brings below 0 where hardly anything gets through.
_FEW = 1e-3
# Shares of the beam are up to 1 and noise; of readings that are as small, air is clearly below. Borders that show it
# are about as bright as the brightest percent, which is noise; as bright in half of all rows, and of all views, as in
# each other; and as far as a twelfth of the way across.
_MOST_TRANSMITTED, _LEAST_AIR = 1.1, 0.98
_AS_BRIGHT, _AS_EVEN, _AS_FLAT, _PART_OF_AIR = 0.85, 0.05, 0.03, 12


def look_like_intensities(images: np.ndarray) -> bool:
    """Whether air is bright, as in raw readings, and not near zero, as in line integrals.

    Air is seen along the left and right border. The object lies below it in a reading, above it in a line integral.
    Where there is no air, noise goes below 0 in line integrals; of readings a few pixels behind metal do.
    """
    air = float(np.median(_borders(images)))
    low, high = np.percentile(images, [0.5, 99.5])
    return bool(np.mean(images < 0) < _FEW and air - low > high - air and air > 0.3 * high)


def air_level(images: np.ndarray) -> np.ndarray:
    """(M, 1, 1) reading of air in each projection: what both borders show where they are evenly bright, else the median
    of its brightest percent, which noise makes brighter than air; or 1 for transmissions.

    Those are numbers up to 1, but so are readings that were divided by the most that they can be, whose air is less
    than 1. Where no air is known by the borders, such numbers count as transmissions.
    """
    # A percentile of all at once would copy all of them.
    bright = np.array([np.percentile(image, 99.5) for image in images])
    air = _air_beside(images, bright)
    if images.max() <= _MOST_TRANSMITTED and (air is None or np.median(air) >= _LEAST_AIR):
        air = np.ones(len(images))
    return (bright if air is None else air).astype(np.float32).reshape(-1, 1, 1)


def _air_beside(images: np.ndarray, bright: np.ndarray) -> np.ndarray | None:
    """(M,) median of the left and right border in each view; None unless they are about as bright as anything there,
    and evenly so."""
    borders = _borders(images)
    air = np.median(borders, axis=(1, 2))
    if np.min(air) <= 0 or np.median(air / np.maximum(bright, 1e-12)) < _AS_BRIGHT:
        return None
    for profile in (air, np.median(borders, axis=(0, 2))):
        low, middle, high = np.percentile(profile, [25, 50, 75])
        if high - low > _AS_EVEN * middle:
            return None
    # Towards the middle, too: an object that fills the detector is thickest there.
    columns = max(images.shape[2] // _PART_OF_AIR, 2)
    for side in (images[:, :, :columns], images[:, :, : -columns - 1 : -1]):
        outer, inner = float(np.median(side[:, :, 0])), float(np.median(side[:, :, 1:]))
        if abs(inner - outer) > _AS_FLAT * outer:
            return None
    return air


def _borders(images: np.ndarray) -> np.ndarray:
    """(M, H, c) pixels along the left and right border, where air is if it is anywhere."""
    columns = max(images.shape[2] // 25, 1)
    return np.concatenate([images[:, :, :columns], images[:, :, -columns:]], axis=2)
