"""How wide the edges of projections are, and where on the object they lie."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import convolve1d, gaussian_filter, map_coordinates

from ...views import Detector
from ...volume import Volume

# Slopes are measured under these Gaussians: no raw pixel is looked at.
_BLURS_PX = np.array([0.7, 1.0, 1.4, 2.0])
# Fainter edges, over the peak and over the noise, are none.
_FAINTEST, _NOISE = 0.03, 8.0
# A step blurred by w rises as (w² + s²)^-½ under a Gaussian s; an outline, where p grows as a square root, as its root.
_POWERS = (0.5, 0.25)
_WIDTHS2 = np.linspace(-0.4, 9.0, 95)
_WIDEST2 = 8.0
_BORDER_PX = 3
# Samples of a ray, and the Gaussian in voxels that the volume is blurred with.
_SAMPLES, _VOLUME_BLUR = 64, 0.7
# What rises in more places of a ray than so far apart, over the box's half diagonal, has no one depth.
_MOST_SPREAD = 0.3
# Immerkaer's mask for noise, as of `noise`.
_MASK, _MASK_NORM = np.array([1.0, -2.0, 1.0]), 6.0
_TO_DEVIATION = 1.4826


class ViewEdges(NamedTuple):
    """Edges of one view: rows and columns (E, 2) of pixels; unit vectors (E, 2) across them, down and right; squared
    widths (E,) in px², less than 0 where noise has it so."""

    place: np.ndarray
    across: np.ndarray
    width2: np.ndarray

    def some(self, kept: np.ndarray) -> ViewEdges:
        """Those that are kept, a mask or indices."""
        return ViewEdges(self.place[kept], self.across[kept], self.width2[kept])


def view_edges(image: np.ndarray, peak: float) -> ViewEdges:
    """The ridges of the slope of an image (H, W) of line integrals, as Canny's, and how wide each edge is."""
    image = np.asarray(image, np.float64)
    slopes = [(gaussian_filter(image, blur, (1, 0)), gaussian_filter(image, blur, (0, 1))) for blur in _BLURS_PX]
    steep = [np.hypot(*slope) for slope in slopes]
    size = np.maximum(steep[1], 1e-12)
    step = np.stack([part / size for part in slopes[1]])
    at = np.indices(image.shape, np.float64)
    before, after = (map_coordinates(steep[1], at + way * step, order=1, mode="nearest") for way in (-1, 1))
    rough = convolve1d(convolve1d(image, _MASK, axis=0), _MASK, axis=1) / _MASK_NORM
    # What is left of a pixel's noise in one component of the slope under a Gaussian of 1 px.
    noise = _TO_DEVIATION * float(np.median(np.abs(rough))) / np.sqrt(8 * np.pi)
    contrast = np.sqrt(2 * np.pi) * steep[1]
    ridge = (contrast > _FAINTEST * peak) & (steep[1] > _NOISE * noise) & (steep[1] >= before) & (steep[1] > after)
    inner = np.zeros_like(ridge)
    inner[_BORDER_PX:-_BORDER_PX, _BORDER_PX:-_BORDER_PX] = True
    rows, columns = np.nonzero(ridge & inner)
    place, across = np.stack([rows, columns], axis=1), step[:, rows, columns].T
    tops = np.stack([_top(one, place, across) for one in steep], axis=1)
    found = ViewEdges(place, across, _width2(np.log(np.maximum(tops, 1e-12))))
    return found.some(found.width2 < _WIDEST2)


def _top(steep: np.ndarray, place: np.ndarray, across: np.ndarray) -> np.ndarray:
    """(E,) the top of the parabola through a ridge and both of its sides."""
    before, here, after = (
        map_coordinates(steep, (place + way * across).T, order=3, mode="nearest") for way in (-1, 0, 1)
    )
    bend, rise = before - 2 * here + after, 0.5 * (before - after)
    away = np.clip(np.where(bend < 0, rise / np.where(bend < 0, bend, -1.0), 0.0), -1.0, 1.0)
    return np.asarray(here - 0.5 * rise * away)


def _width2(logs: np.ndarray) -> np.ndarray:
    """(E,) squared widths that explain best how slopes (their logarithms, (E, B)) fall under broader Gaussians."""
    logs = logs - logs.mean(axis=1, keepdims=True)
    models = np.concatenate([-power * np.log(_WIDTHS2[:, None] + _BLURS_PX**2) for power in _POWERS])
    models -= models.mean(axis=1, keepdims=True)
    # |l − m|² without l², which is the same for all.
    away = (models**2).sum(axis=1) - 2 * logs @ models.T
    return np.asarray(np.tile(_WIDTHS2, len(_POWERS))[away.argmin(axis=1)])


def edge_points(volume: Volume, gradient: np.ndarray, detector: Detector, edges: ViewEdges) -> np.ndarray:
    """(E, 3) mm, where on its ray each edge lies: where the volume rises along the edge's direction; NaN where that is
    in several places.

    Args:
        gradient: of `rises`.
    """
    u, v = np.asarray(detector.u, np.float64), np.asarray(detector.v, np.float64)
    source, low_high = np.asarray(detector.source, np.float64), volume.box_mm
    column, row = edges.place[:, 1] + 0.5 - detector.width / 2, edges.place[:, 0] + 0.5 - detector.height / 2
    way = np.asarray(detector.center, np.float64) + column[:, None] * u + row[:, None] * v - source
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    wide, high = float(np.linalg.norm(u)), float(np.linalg.norm(v))
    # What rises by so much a pixel rises the more a mm the smaller the pixel is that way.
    normal = edges.across[:, 1:] * u / wide + edges.across[:, :1] * v / high * (wide / high)
    radius = 0.5 * float(np.linalg.norm(low_high[1] - low_high[0]))
    middle = way @ (low_high.mean(axis=0) - source)
    far = middle[:, None] + np.linspace(-radius, radius, _SAMPLES)
    points = source + far[..., None] * way[:, None]
    index = ((points - volume.origin_mm) / volume.spacing_mm)[..., ::-1].reshape(-1, 3).T
    parts = [map_coordinates(part, index, order=1, mode="constant").reshape(far.shape) for part in gradient]
    weight = sum(part * normal[:, axis, None] for axis, part in enumerate(parts)) ** 2
    total = np.maximum(weight.sum(axis=1), 1e-30)
    mean = (weight * far).sum(axis=1) / total
    spread = np.sqrt((weight * (far - mean[:, None]) ** 2).sum(axis=1) / total)
    found: np.ndarray = source + mean[:, None] * way
    found[(spread > _MOST_SPREAD * radius) | (weight.sum(axis=1) <= 0)] = np.nan
    return found


def rises(volume: Volume) -> np.ndarray:
    """(3, Z, Y, X) how a volume, blurred a little, rises along x, y and z, in mm⁻²."""
    along_zyx = np.gradient(gaussian_filter(volume.values, _VOLUME_BLUR), *np.asarray(volume.spacing_mm)[::-1])
    return np.stack(along_zyx[::-1])
