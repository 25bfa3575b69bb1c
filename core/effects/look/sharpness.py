"""How sharp the edges of photos are, and what lies there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from ...views import Camera

# Slopes are measured on images that are blurred by these: no raw pixel is looked at, so noise hardly matters.
_BLURS_PX = (1.0, 1.5, 2.0)
# Of full scale; fainter edges are noise and shading.
_FAINTEST = 0.06
# How far brightness may not turn back from an edge, and how little of its slope counts as that.
_REACH_PX, _TURNED = 4.0, 0.1
# What is blurred more is no edge.
_WIDEST_PX2 = 40.0


class Edges(NamedTuple):
    """Pixels (E, 2) on edges, columns and rows; the directions (E,) in rad across them; and the squares (E,) in px² of
    the deviations that steps would be blurred with to look like them."""

    place: np.ndarray
    direction: np.ndarray
    width2: np.ndarray


def edges(image: np.ndarray) -> Edges:
    """Where the brightness of an image (H, W, 3) in 0..1 rises most along its slope.

    A step of contrast C that is blurred by σ, and by s on top, rises by C / √(2π (σ² + s²)) a pixel: over several s the
    inverse squares of that are a line, whose constant over its slope is σ².
    """
    grey = np.asarray(image, np.float64).mean(axis=2)
    slopes = [_slope(grey, blur) for blur in _BLURS_PX]
    across, down = slopes[0]
    steep = np.hypot(across, down)
    contrast = steep * np.sqrt(2 * np.pi) * _BLURS_PX[0]
    rows, columns = np.nonzero((contrast > _FAINTEST) & _ridge(across, down, steep))
    alone = _alone(across, down, rows, columns)
    rows, columns = rows[alone], columns[alone]
    inverse = np.array([1 / np.hypot(*(part[rows, columns] for part in slope)) ** 2 for slope in slopes])
    # Relative errors of slopes are alike.
    weight, along = 1 / inverse**2, np.square(_BLURS_PX)[:, None]
    total = weight.sum(axis=0)
    middle, height = (weight * along).sum(axis=0) / total, (weight * inverse).sum(axis=0) / total
    rise = (weight * (along - middle) * inverse).sum(axis=0) / (weight * (along - middle) ** 2).sum(axis=0)
    width2 = height / np.where(rise > 0, rise, np.nan) - middle
    known = np.isfinite(width2) & (width2 < _WIDEST_PX2)
    place = np.stack([columns, rows], axis=1)[known]
    return Edges(place, np.arctan2(down, across)[rows, columns][known], width2[known])


def _slope(grey: np.ndarray, blur: float) -> tuple[np.ndarray, np.ndarray]:
    """Along rows and down columns."""
    return gaussian_filter(grey, blur, (0, 1)), gaussian_filter(grey, blur, (1, 0))


def _alone(across: np.ndarray, down: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Whether brightness does not turn back within reach of an edge: the other side of a line would narrow it."""
    steep = np.hypot(across, down)[rows, columns]
    step = np.stack([down[rows, columns], across[rows, columns]]) / steep
    turned: np.ndarray = np.zeros(len(rows), bool)
    for way in (-_REACH_PX, -0.75 * _REACH_PX, -0.5 * _REACH_PX, 0.5 * _REACH_PX, 0.75 * _REACH_PX, _REACH_PX):
        place = np.stack([rows, columns]) + way * step
        there = [map_coordinates(part, place, order=1, mode="nearest") for part in (down, across)]
        turned |= there[0] * step[0] + there[1] * step[1] < -_TURNED * steep
    return ~turned


def _ridge(across: np.ndarray, down: np.ndarray, steep: np.ndarray) -> np.ndarray:
    """Whether the slope is steeper than a pixel before and behind (Canny's maxima), away from the border."""
    height, width = steep.shape
    size = np.maximum(steep, 1e-12)
    step = np.stack([down / size, across / size])
    place = np.mgrid[:height, :width].astype(np.float64)
    sides = [map_coordinates(steep, place + sign * step, order=1, mode="nearest") for sign in (-1, 1)]
    inner = np.zeros_like(steep, bool)
    inner[3:-3, 3:-3] = True
    return inner & (steep >= sides[0]) & (steep > sides[1])


def front(points: np.ndarray, camera: Camera, cell_px: float, behind: float) -> tuple[np.ndarray, np.ndarray]:
    """Which of the points (P, 3) nothing nearer covers in an image, as places in them, and their depths.

    Args:
        cell_px: points closer to each other in the image than about this cover each other.
        behind: how much farther away a point is that is covered.
    """
    matrix = np.asarray(camera.world_to_camera, np.float64)
    depth = points @ matrix[2, :3] + matrix[2, 3]
    columns, rows, inside = camera.pixels_of(points)
    shown = np.flatnonzero(inside)
    shape = int(camera.height // cell_px) + 3, int(camera.width // cell_px) + 3
    cell = (rows[shown] // cell_px).astype(int) + 1, (columns[shown] // cell_px).astype(int) + 1
    nearest = np.full(shape, np.inf)
    np.minimum.at(nearest, cell, depth[shown])
    around = np.min([np.roll(nearest, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=0)
    bare = depth[shown] <= around[cell] + behind
    return shown[bare], depth[shown][bare]
