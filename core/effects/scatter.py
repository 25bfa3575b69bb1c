"""Scatter: X-rays that reach the detector by a detour, a smooth background that fills thick shadows up with light.

Rays scatter in proportion to p e⁻ᵖ, what they lose times what is left, and a broad Gaussian spreads that over the
detector (Ohnesorge, Flohr and Klingenbeck-Regn, European Radiology 9, 1999). It is seen where nothing else can be: in
air close to the shadow more arrives than far from it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.ndimage import binary_dilation, gaussian_filter, zoom

from ..capture.model import Projections
from .finding import EffectFinding
from .rays import RayEvidence

_NAME, _UNIT = "scatter", "% at the 95th percentile"
# As of beam hardening: what is less is within the errors of densities.
_THRESHOLD, _ERRORS = 2.0, 5.0
_WIDTHS = (0.05, 0.1, 0.15, 0.2, 0.3)
# The scattered light follows from what arrives without it, which is known better each time.
_ROUNDS = 6
_MOST_VIEWS, _FEWEST_VIEWS, _BLOCKS = 24, 4, 8
# Air: less than a twenty-fifth of what nearly all rays lose, and some pixels away from all that is not: blurred edges.
_AIR, _NEARLY_ALL, _MARGIN_PX = 0.04, 99.0, 4
_LEAST_AIR = 0.02
# Of what arrives, so much is not scattered at least: noise in black shadows must not become infinite.
_LEAST_PRIMARY = 0.02
# Pixels a side that smooth backgrounds are computed with.
_COARSE = 128


def detect(evidence: RayEvidence) -> EffectFinding:
    """How much of the line integrals of thick parts scattered rays take away, in percent of what they should be.

    `numbers`: "share" of what rays lose and could still get out that is scattered onto the detector; "width", standard
    deviation of its spread over the detector's longer side. Its error is that of a jackknife over the views.
    """
    every = max(1, -(-len(evidence.views.images) // _MOST_VIEWS))
    images = evidence.views.images[::every].astype(np.float64)
    images = np.where(np.isfinite(images), images, 0.0)
    if len(images) < _FEWEST_VIEWS:
        return _unknown(f"{len(images)} projections are too few to tell scattered light from noise.")
    shadow = gaussian_filter(images, (0, 1, 1)) > _AIR * np.percentile(images, _NEARLY_ALL)
    side = 2 * _MARGIN_PX + 1
    air = ~binary_dilation(shadow, np.ones((1, side, side), bool))
    if air.mean() < _LEAST_AIR or not shadow.any():
        return _unknown("The object's shadow leaves too little air beside it to see scattered light in.")
    arrived = np.exp(-images)
    share, width, primary = min((_fitted(arrived, air, width) for width in _WIDTHS), key=lambda fit: fit[3])[:3]
    source = _spread(primary, width)
    error = _error(source, arrived, air)
    depth = -np.log(primary)
    thick = depth >= np.percentile(depth[shadow], 95)
    behind = float(np.median(np.log1p(max(share, 0.0) * source[thick] / primary[thick]) / depth[thick]))
    return _finding(share, width, error, 100 * behind)


def corrected(projections: Projections, numbers: Mapping[str, Any]) -> Projections:
    """Projections without the scattered light."""
    share, width = float(numbers["share"]), float(numbers["width"])
    images = np.empty_like(projections.images)
    for index, image in enumerate(projections.images):
        arrived = np.exp(-np.where(np.isfinite(image), image, 0.0).astype(np.float64))[None]
        without = np.where(np.isfinite(image), -np.log(_primary(arrived, share, width)[0]), image)
        images[index] = without
    return replace(projections, images=images)


def _fitted(arrived: np.ndarray, air: np.ndarray, width: float) -> tuple[float, float, np.ndarray, float]:
    """Share, width, the unscattered light (M, height, width), and mean square of what is left in air."""
    primary, share, left = arrived, 0.0, np.inf
    for _ in range(_ROUNDS):
        source = _spread(primary, width)
        share, constant = _line(source[air], arrived[air] - 1)
        left = float(np.mean((arrived[air] - 1 - constant - share * source[air]) ** 2))
        primary = _without(arrived, max(share, 0.0) * source)
    return share, width, primary, left


def _primary(arrived: np.ndarray, share: float, width: float) -> np.ndarray:
    primary = arrived
    for _ in range(_ROUNDS):
        primary = _without(arrived, share * _spread(primary, width))
    return primary


def _without(arrived: np.ndarray, scattered: np.ndarray) -> np.ndarray:
    return np.maximum(arrived - scattered, _LEAST_PRIMARY * arrived)


def _spread(primary: np.ndarray, width: float) -> np.ndarray:
    """(M, height, width) p e⁻ᵖ of the unscattered light, blurred; nothing scatters from beyond the detector."""
    source = np.maximum(-np.log(primary), 0) * primary
    count, height, across = source.shape
    block = max(1, max(height, across) // _COARSE)
    padded = np.pad(source, ((0, 0), (0, -height % block), (0, -across % block)))
    rows, columns = padded.shape[1] // block, padded.shape[2] // block
    coarse = padded.reshape(count, rows, block, columns, block).mean(axis=(2, 4))
    deviation = width * max(height, across) / block
    smooth = gaussian_filter(coarse, (0, deviation, deviation), mode="constant")
    if block == 1:
        return np.asarray(smooth)
    fine = zoom(smooth, (1, block, block), order=1, mode="nearest", grid_mode=True)
    return np.asarray(fine[:, :height, :across])


def _line(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Slope and constant. Air far off need not be 1: flat fields fade, noise makes logarithms a little large."""
    middle = x.mean()
    slope = float((x - middle) @ y / max(float((x - middle) @ (x - middle)), 1e-30))
    return slope, float(y.mean() - slope * middle)


def _error(source: np.ndarray, arrived: np.ndarray, air: np.ndarray) -> float:
    """Standard error of the share, by leaving out an eighth of the views at a time."""
    every = np.arange(len(source))
    blocks = np.array_split(every, min(_BLOCKS, len(every)))
    kept = [np.setdiff1d(every, block) for block in blocks]
    shares = [_line(source[some][air[some]], arrived[some][air[some]] - 1)[0] for some in kept]
    return float(np.sqrt((len(blocks) - 1) * np.var(shares)))


def _finding(share: float, width: float, error: float, behind: float) -> EffectFinding:
    sure = share >= _ERRORS * error
    percent = behind * error / share if share > 0 else None
    numbers = {"share": share, "width": width}
    lifted = f"Air beside the object is lit up by scattered X-rays, which take {behind:.1f} % off the thick parts"
    if behind >= _THRESHOLD and sure:
        reason = f"{lifted}; from {_THRESHOLD:g} % that makes the inside look hollow."
        return EffectFinding(_NAME, True, behind, _UNIT, _THRESHOLD, reason, percent, numbers)
    if behind < _THRESHOLD:
        reason = f"Scattered X-rays take {behind:.1f} % off the thick parts; less than {_THRESHOLD:g} % does no harm."
    else:
        reason = f"Air beside the object is no brighter than noise allows ({share:.3f} of {error:.3f} give or take)."
    return EffectFinding(_NAME, False, behind, _UNIT, _THRESHOLD, reason, percent, numbers if share > 0 else {})


def _unknown(reason: str) -> EffectFinding:
    return EffectFinding(_NAME, None, None, _UNIT, _THRESHOLD, reason)
