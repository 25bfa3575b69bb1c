"""Rays of single pixels, and where they cross a box. Numpy alone."""

from __future__ import annotations

import numpy as np

from ..views import Detector


def pixel_rays(detector: Detector, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions, each (R, 3) in mm, of pixels (R,) counted row by row; see `Detector.rays`."""
    rows, columns = np.divmod(np.asarray(pixels), detector.width)
    along = (columns + 0.5 - detector.width / 2)[:, None] * np.asarray(detector.u, np.float64)
    down = (rows + 0.5 - detector.height / 2)[:, None] * np.asarray(detector.v, np.float64)
    places = np.asarray(detector.center, np.float64) + along + down
    source = np.asarray(detector.source, np.float64)
    if detector.parallel:
        return places, np.broadcast_to(source / np.linalg.norm(source), places.shape)
    directions = places - source
    return np.broadcast_to(source, places.shape), directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def across_box(origins: np.ndarray, directions: np.ndarray, box_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances (R,) along whole lines where they enter and leave a box (2, 3); both 0 for lines that miss it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = ((side - origins) / directions for side in np.asarray(box_mm, np.float64))
    low, high = np.minimum(first, second), np.maximum(first, second)
    # A line in the plane of a side has 0 / 0 there, and that side does not bound it.
    near = np.where(np.isnan(low), -np.inf, low).max(axis=-1)
    far = np.where(np.isnan(high), np.inf, high).min(axis=-1)
    meets = far > near
    return np.where(meets, near, 0.0), np.where(meets, far, 0.0)
