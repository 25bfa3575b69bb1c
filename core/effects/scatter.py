"""Scatter: X-rays that reach the detector by a detour, a smooth background that fills thick shadows up with light.

Rays scatter in proportion to p e⁻ᵖ, what they lose times what is left, and a broad Gaussian spreads that over the
detector (Ohnesorge, Flohr and Klingenbeck-Regn, European Radiology 9, 1999). It is seen where nothing else can be: a
pixel of air gets more light in views in which the shadow is close. What a pixel has in all views is the flat field's, a
fading one or a heel of the tube, and what all pixels of a view have is the tube's: neither counts. Foam or a post that
lets nearly all light through counts as air and changes with the view, too, but is not as smooth as what is scattered.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation, gaussian_filter, zoom

from ..capture.model import Projections
from ..progress import Tick, unstopped
from ..told import Told
from .finding import EffectFinding
from .rays import RayEvidence, arriving, of_another_unit

_NAME, _UNIT = "scatter", "% at the 95th percentile"
# As of beam hardening: what is less is within the errors of densities.
_THRESHOLD, _ERRORS, _SURELY_NOT = 2.0, 5.0, 2.0
_WIDTHS, _USUAL_WIDTH = (0.05, 0.1, 0.15, 0.2, 0.3), 0.15
# The scattered light follows from what arrives without it, which is known better each time.
_ROUNDS = 6
_MOST_VIEWS, _FEWEST_VIEWS, _BLOCKS = 24, 4, 8
# Air: less than a twenty-fifth of what nearly all rays lose, and some pixels away from all that is not: blurred edges.
_AIR, _NEARLY_ALL, _MARGIN_PX = 0.04, 99.0, 4
_LEAST_AIR = 0.02
# More pixels of air than that at the very same brightest value were cut off there, and scattered light with them.
_MOST_CUT = 0.05
# Cells, so many along the longer side, that the model of scattered light leaves something in, alike in those two apart:
# noise, a detector's blurred one as well, is not. Of what scattered light explains, so much may be left; where more is,
# by so many errors, there is something else.
_CELLS, _APART = 32, 2
_MOST_LEFT, _SURELY_LEFT = 0.5, 3.0
# Means of pixels and of views are taken off in turn.
_TURNS = 4
# Of what arrives, so much is not scattered at least: noise in black shadows must not become infinite.
_LEAST_PRIMARY = 0.02
# Line integrals behind which single precision has digits left, what is not scattered of that light included.
_DEEPEST_SINGLE = 80.0
# Pixels a side that smooth backgrounds are computed with.
_COARSE = 128


def detect(evidence: RayEvidence) -> EffectFinding:
    """How much of the line integrals of thick parts scattered rays take away, in percent of what they should be.

    `numbers`: "share" of what rays lose and could still get out that is scattered onto the detector; "width", standard
    deviation of its spread over the detector's longer side. Its error is that of a jackknife over the views.
    """
    order = evidence.training[np.argsort(evidence.projections.angles_rad[evidence.training], kind="stable")]
    chosen = order[:: max(1, -(-len(order) // _MOST_VIEWS))]
    if len(chosen) < _FEWEST_VIEWS:
        return _unknown(Told("{count} projections are too few to tell scattered light from noise.", count=len(chosen)))
    images = evidence.views.images[chosen].astype(np.float64)
    images = np.where(np.isfinite(images), images, 0.0)
    size_mm = _size_mm(evidence.projections)
    deep = float(np.percentile(images, _NEARLY_ALL))
    unknown = of_another_unit(deep)
    if unknown is not None:
        return _unknown(unknown)
    level = _AIR * deep
    shadow = gaussian_filter(images, (0, 1, 1)) > level
    side = 2 * _MARGIN_PX + 1
    air = ~binary_dilation(shadow, np.ones((1, side, side), bool))
    if air.mean() < _LEAST_AIR or not shadow.any():
        return _unknown(Told("The object's shadow leaves too little air beside it to see scattered light in."))
    if _cut(evidence.projections.images, chosen, level) > _MOST_CUT:
        return _unknown(
            Told("The air of the projections is cut off at its brightest value, and scattered light with it.")
        )
    arrived = arriving(images)
    light = _changes(arrived, air)
    fits = {width: _fitted(arrived, light, air, width, size_mm) for width in _WIDTHS}
    width = min(fits, key=lambda each: fits[each].left)
    error = _error(_spread(fits[width].primary, width, size_mm), arrived, air)
    if fits[width].share < _ERRORS * error:
        # Noise chooses any width; what is there at most is asked of the usual one.
        width = _USUAL_WIDTH
        error = _error(_spread(fits[width].primary, width, size_mm), arrived, air)
    share, primary = fits[width].share, fits[width].primary
    source = _spread(primary, width, size_mm)
    depth = -np.log(primary)
    thick = depth >= np.percentile(depth[shadow], 95)

    def behind(share: float) -> float:
        """Percent that it takes off the thick parts."""
        return 100 * float(np.median(np.log1p(max(share, 0.0) * source[thick] / primary[thick]) / depth[thick]))

    taken = behind(share)
    percent = behind(max(share, 0.0) + error) - taken
    finding = _finding(share, width, error, taken, percent)
    if finding.found and _local(light, share * _changes(source, air)):
        unlike = (
            "{told}; but what lights the air up is not as smooth as scattered light: something thin, such as foam or a "
            "holder, may stand in it."
        )
        return replace(finding, found=None, reason=Told(unlike, told=_told(taken, percent)))
    return finding


def corrected(projections: Projections, numbers: Mapping[str, Any], tick: Tick = unstopped) -> Projections:
    """Projections without the scattered light."""
    share, width = float(numbers["share"]), float(numbers["width"])
    images, size_mm = np.empty_like(projections.images), _size_mm(projections)
    for index, image in enumerate(projections.images):
        tick()
        known = np.where(np.isfinite(image), image, np.float32(0))
        # In single precision nothing would be left of less light.
        arrived = arriving(known if known.max(initial=0.0) < _DEEPEST_SINGLE else known.astype(np.float64))
        without = _without(arrived, _scattered(arrived, share, width, size_mm))
        images[index] = np.where(np.isfinite(image), -np.log(without), image)
    return replace(projections, images=images)


def drawn(image: np.ndarray, view: int, projections: Projections, numbers: Mapping[str, Any]) -> np.ndarray:
    """(height, width) of a rendered projection with the light that is scattered onto it."""
    primary = arriving(np.asarray(image, np.float64))
    source = _spread(primary[None], float(numbers["width"]), _size_mm(projections))[0]
    return np.asarray(-np.log(primary + float(numbers["share"]) * source))


class _Fit(NamedTuple):
    """Share, the unscattered light (M, height, width), and mean square of what is left in air."""

    share: float
    primary: np.ndarray
    left: float


def _size_mm(projections: Projections) -> tuple[float, float]:
    """Height and width of the detector."""
    first = projections.detectors[0]
    return first.height * float(np.linalg.norm(first.v)), first.width * float(np.linalg.norm(first.u))


def _cut(images: np.ndarray, chosen: np.ndarray, level: float) -> float:
    """The share of pixels of air that have the brightest value of all."""
    brightest = min(float(np.nanmin(images[index])) for index in chosen)
    same = sum(int(np.count_nonzero(images[index] == brightest)) for index in chosen)
    return same / max(sum(int(np.count_nonzero(images[index] <= level)) for index in chosen), 1)


def _fitted(
    arrived: np.ndarray, light: np.ndarray, air: np.ndarray, width: float, size_mm: tuple[float, float]
) -> _Fit:
    """`light`: what changes of `arrived` from view to view."""
    primary, share, left = arrived, 0.0, np.inf
    for _ in range(_ROUNDS):
        source = _spread(primary, width, size_mm)
        changes = _changes(source, air)
        share = _slope(changes, light)
        left = float(np.mean((light[air] - share * changes[air]) ** 2))
        primary = _without(arrived, max(share, 0.0) * source)
    return _Fit(share, primary, left)


def _scattered(arrived: np.ndarray, share: float, width: float, size_mm: tuple[float, float]) -> np.ndarray:
    """(height, width) of an image: it is smooth, so that it is computed with few pixels and enlarged once."""
    height, across = arrived.shape
    block = max(1, max(height, across) // _COARSE)
    padded = np.pad(arrived, ((0, -height % block), (0, -across % block)), mode="edge")
    rows, columns = padded.shape[0] // block, padded.shape[1] // block
    coarse = padded.reshape(rows, block, columns, block).mean(axis=(1, 3), dtype=np.float64)[None]
    size_mm = size_mm[0] * rows * block / height, size_mm[1] * columns * block / across
    primary = light = coarse
    for _ in range(_ROUNDS):
        light = share * _spread(primary, width, size_mm)
        primary = _without(coarse, light)
    if block == 1:
        return np.asarray(light[0])
    fine = zoom(light[0].astype(np.float32), block, order=1, mode="nearest", grid_mode=True)
    return np.asarray(fine[:height, :across])


def _without(arrived: np.ndarray, scattered: np.ndarray) -> np.ndarray:
    return np.maximum(arrived - scattered, _LEAST_PRIMARY * arrived)


def _spread(primary: np.ndarray, width: float, size_mm: tuple[float, float]) -> np.ndarray:
    """(M, height, width) p e⁻ᵖ of the unscattered light, blurred; nothing scatters from beyond the detector."""
    source = np.maximum(-np.log(primary), 0) * primary
    down, along = (width * max(size_mm) * count / mm for count, mm in zip(source.shape[1:], size_mm, strict=True))
    return np.asarray(gaussian_filter(source, (0, down, along), mode="constant"))


def _changes(values: np.ndarray, air: np.ndarray) -> np.ndarray:
    """(M, height, width) what air has beyond its pixels' means over views and views' over pixels; else 0."""
    left = np.where(air, values, 0.0)
    for _ in range(_TURNS):
        for axes in ((0,), (1, 2)):
            mean = left.sum(axis=axes, keepdims=True) / np.maximum(air.sum(axis=axes, keepdims=True), 1)
            left = np.where(air, left - mean, 0.0)
    return left


def _local(light: np.ndarray, explained: np.ndarray) -> bool:
    """Whether much of what changes in air (M, height, width) is not what scattered light explains of it, but local."""
    side = max(2, max(light.shape[1:]) // _CELLS)
    # Of a low, wide detector cells are lower, so that there are some one above the other.
    down, across = (min(side, max(count // (_APART + 1), 1)) for count in light.shape[1:])
    left, own = _in_cells(light - explained, down, across), _in_cells(explained, down, across)
    total, variance, allowed = 0.0, 0.0, 0.0
    for axis in (1, 2):
        alike = _with_next(left, axis)
        total += float(alike.sum())
        variance += float((alike**2).sum())
        allowed += _MOST_LEFT * float(_with_next(own, axis).sum())
    return bool(total - _SURELY_LEFT * np.sqrt(variance) > allowed)


def _in_cells(values: np.ndarray, down: int, across: int) -> np.ndarray:
    """(M, rows, columns) means of cells of so many pixels a side; the rest at the border is left out."""
    rows, columns = values.shape[1] // down, values.shape[2] // across
    whole = values[:, : rows * down, : columns * across]
    return np.asarray(whole.reshape(len(values), rows, down, columns, across).mean(axis=(2, 4)))


def _with_next(cells: np.ndarray, axis: int) -> np.ndarray:
    """Products of cells with those `_APART` further along an axis."""
    cells = np.moveaxis(cells, axis, -1)
    return np.asarray(cells[..., :-_APART] * cells[..., _APART:])


def _slope(x: np.ndarray, y: np.ndarray) -> float:
    return float(np.vdot(x, y)) / max(float(np.vdot(x, x)), 1e-30)


def _error(source: np.ndarray, arrived: np.ndarray, air: np.ndarray) -> float:
    """Standard error of the share, by leaving out an eighth of the views at a time."""
    every = np.arange(len(source))
    blocks = np.array_split(every, min(_BLOCKS, len(every)))
    kept = [np.setdiff1d(every, block) for block in blocks]
    shares = [_slope(_changes(source[some], air[some]), _changes(arrived[some], air[some])) for some in kept]
    return float(np.sqrt((len(blocks) - 1) * np.var(shares)))


def _finding(share: float, width: float, error: float, behind: float, percent: float) -> EffectFinding:
    """`percent`: one error of `behind`."""
    told = _told(behind, percent)
    numbers = {"share": share, "width": width} if share > 0 else {}
    found: bool | None = bool(behind >= _THRESHOLD and share >= _ERRORS * error)
    if found:
        reason = Told("{told}; from {least:g} % on that makes the inside look hollow.", told=told, least=_THRESHOLD)
    elif behind + _SURELY_NOT * percent < _THRESHOLD:
        reason = Told("{told}; less than {least:g} % does no harm.", told=told, least=_THRESHOLD)
    else:
        unclear = "{told}; that is too uncertain to tell from what lights the air up in all views alike."
        found, reason = None, Told(unclear, told=told)
    return EffectFinding(_NAME, found, behind, _UNIT, _THRESHOLD, reason, percent, numbers)


def _told(behind: float, percent: float) -> Told:
    said = "Scattered X-rays take {percent:.1f} % off the thick parts, give or take {error:.1f} %"
    return Told(said, percent=behind, error=percent)


def _unknown(reason: Told) -> EffectFinding:
    return EffectFinding(_NAME, None, None, _UNIT, _THRESHOLD, reason)
