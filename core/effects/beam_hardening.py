"""Beam hardening: a tube's soft X-rays are taken away first, so thick parts attenuate less than thin ones promise.

Seen in what any view's total has to be. All line integrals of an object add up to a number that its other views
know: in parallel beams it is the same in all of them (Helgason and Ludwig's zeroth condition; Tang et al., Phys.
Med. Biol. 56, 2011, linearise with it). In a cone-beam it is that of the reprojected FDK, which is less sensitive to
pixels and windows than any ray of it. Views across the thick side of an object that hardens fall short. The curve
p + c p² (Herman, Phys. Med. Biol. 24, 1979) that makes them agree best is a ratio of two sums: FDK and projection
are linear. No mask, no length through a material, no number of materials is needed, which thin walls and metal in
plastic would get wrong.

Metal bends more than what is around it. To second order a beam makes of line integrals p_i of several materials
Σ p_i - ½ Var(Σ p_i g_i), where g_i(E) is an attenuation over its mean. What photoelectric absorption adds makes nearly
all of g_i - 1, the same function of the energy σ_i times, so that the variance is (Σ σ_i p_i)²: metal counts as
σ_metal / σ times as thick in one and the same curve, p + c (p + κ p_metal)², where c = σ² / 2. p_metal is projected
from an FDK's densest voxels (Joseph and Spital, J. Comput. Assist. Tomogr. 2, 1978; Kyriakou et al., Med. Phys. 37,
2010). Coefficients of p p_metal and p_metal² of their own cannot be told from views that do not agree: pixels and
voxels too coarse for edges of metal make clean scans disagree in the same way, and by more.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from ..capture.describe import MOST_CUT_OFF
from ..capture.model import Projections
from ..progress import Tick, unstopped
from ..threshold import air_threshold
from ..told import Told
from .finding import EffectFinding
from .rays import RayEvidence

_NAME, _UNIT = "beam_hardening", "% at the 95th percentile"
# Two thirds of 2 % are missing in the mass, half of it is cupping; what is less is within the errors of densities.
# The jackknife takes what the FDK itself gets wrong for noise: errors come out several times too large on exact scans,
# so that three of them are enough.
_THRESHOLD, _ERRORS, _SURELY_NOT = 2.0, 3.0, 2.0
_FEWEST_VIEWS, _BLOCKS = 16, 8
# The shadow: beyond a tenth of what nearly all rays lose.
_SHADOW, _NEARLY_ALL = 0.1, 99.0
# Of the 95th percentile; beyond it are few pixels to know a curve by, and starved ones.
_STRAIGHT = 1.5
# Blur of the images that the curve has to mend as well, over their longer side, and how much of their squares.
_SMOOTH, _LEAST_GAIN = 0.1, 0.03
# Deviation of metal's attenuation over its mean: titanium, steel, copper have 0.5 to 0.9 in tubes of 60 to 120 keV on
# average, less behind what hardens; and as how much thicker than anything else it counts at most.
_METAL_SPREAD, _MOST_THICKER = 0.7, 1.5
# What attenuates so many times as much as the middle of the object is taken for metal, if it has a share of all
# attenuation.
_METAL, _LEAST_METAL = 5.0, 0.002


def detect(evidence: RayEvidence) -> EffectFinding:
    """How far the line integrals of thick parts fall short of those of thin ones, in percent of what they should be.

    `numbers`: "curvature", c of the corrected c p² + p; "until", the p from which that goes on straight; "scale", which
    the corrected ones are multiplied with; none where thick parts attenuate more. Where there is metal in an object
    that hardens, "thicker" (M, height, width): by how much p counts as larger in the square, of coarse views; the
    strength and its error are those without it.
    The error is that of a jackknife over eighths of the circle.

    Raises CaptureError and Cancelled as `core.fdk_process.fdk`.
    """
    if evidence.cut_off > MOST_CUT_OFF:
        return _unknown(
            Told("The object leaves the detector at the side, so that nobody knows what its views add up to.")
        )
    order, images = _in_order(evidence), _finite(evidence.views.images)
    count = len(order)
    if count < _FEWEST_VIEWS:
        few = "{count} projections are too few to compare what they add up to; {least} are needed."
        return _unknown(Told(few, count=count, least=_FEWEST_VIEWS))
    shadow = images[order][images[order] > _SHADOW * np.percentile(images[order], _NEARLY_ALL)]
    if not shadow.size or shadow.max() <= 0:
        return _unknown(Told("The projections are empty."))
    thick, middle = float(np.percentile(shadow, 95)), float(np.median(shadow))
    first = images[order] - evidence.reprojected[order]
    second = _squares(evidence, order, images, thick)
    share, error = _straightening(_totals(first), _totals(second))
    found = _finding(share, error, thick, middle)
    if not found.found:
        return found
    if not _explains(share, first, second):
        reason = Told(
            "Views add up to what a hardened beam would give, and their images do not show it: it is something else."
        )
        return replace(found, found=None, reason=reason)
    factor = min(_METAL_SPREAD / np.sqrt(2 * share / thick) - 1, _MOST_THICKER)
    metal = _metal(evidence, images) if factor > 0 else None
    if metal is None:
        return found
    thicker = (factor * metal).astype(np.float16)
    share, error = _straightening(_totals(first), _totals(_squares(evidence, order, images + thicker, thick)))
    if share < _ERRORS * error:
        return found
    reason = Told(
        "{said} What is five times as dense, taken for metal, counts as {times:.1f} times as thick.",
        said=found.reason,
        times=1 + factor,
    )
    return replace(found, reason=reason, numbers={**_numbers(share, thick, middle), "thicker": thicker})


def _in_order(evidence: RayEvidence) -> np.ndarray:
    """Training views by their angles."""
    angles = evidence.projections.angles_rad[evidence.training]
    return np.asarray(evidence.training[np.argsort(angles, kind="stable")])


def _squares(evidence: RayEvidence, order: np.ndarray, images: np.ndarray, thick: float) -> np.ndarray:
    """What the square of all views' `images`, over `thick`, is in views of this `order`, less its reprojected FDK."""
    views = evidence.views
    squares = (_bend(images, _STRAIGHT * thick) / thick).astype(np.float32)
    volume = evidence.reconstructed(replace(views, images=squares))
    return np.asarray(squares[order] - evidence.project(volume, [views.detectors[index] for index in order]))


def _metal(evidence: RayEvidence, images: np.ndarray) -> np.ndarray | None:
    """(M, height, width) how much of all coarse views' line integrals is metal's; None where there is hardly any."""
    volume = evidence.volume
    values = volume.values
    object_ = values[values > air_threshold(values)]
    if not object_.size:
        return None
    middle = np.median(object_)
    dense = np.where(values > _METAL * middle, values, np.float32(0))
    if dense.sum() < _LEAST_METAL * np.maximum(values, 0).sum():
        return None
    # Streaks must not make more of a ray than it has lost.
    seen = evidence.project(replace(volume, values=dense), evidence.views.detectors)
    return np.clip(seen, 0.0, np.maximum(images, 0.0))


def _finite(images: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(images), images, np.float32(0))


def corrected(projections: Projections, numbers: Mapping[str, Any], tick: Tick = unstopped) -> Projections:
    """Projections whose line integrals grow with the thickness of a material, not more slowly.

    Where the scale of densities lies cannot be told from the projections: no number in them says at which energy an
    attenuation is to be. Rays of the median line integral keep theirs, and so does the middle of the object; thin
    parts alone would have the attenuation of the unhardened beam, a tenth more in a soft one.
    """
    curvature, scale, until = (float(numbers[name]) for name in ("curvature", "scale", "until"))
    images = np.empty_like(projections.images)
    for index, image in enumerate(projections.images):
        tick()
        images[index] = scale * (image + curvature * _bend(image + _thicker(numbers, index, image.shape), until))
    return replace(projections, images=images)


def drawn(image: np.ndarray, view: int, projections: Projections, numbers: Mapping[str, Any]) -> np.ndarray:
    """(height, width) of a rendered projection as the hardened beam has it: `corrected` the other way round."""
    curvature, scale, until = (float(numbers[name]) for name in ("curvature", "scale", "until"))
    thicker = _thicker(numbers, view, image.shape)
    straight = np.asarray(image, np.float64) / scale + thicker
    # p of p + c p², in the form that loses no digits where c p is small; below 0 nothing is bent.
    within = 2 * straight / (1 + np.sqrt(1 + 4 * curvature * np.maximum(straight, 0.0)))
    beyond = (straight + curvature * until**2) / (1 + 2 * curvature * until)
    return np.where(straight < 0, straight, np.where(within <= until, within, beyond)) - thicker


def _thicker(numbers: Mapping[str, Any], view: int, shape: tuple[int, ...]) -> np.ndarray | np.float32:
    """(height, width) of a view's "thicker", read between its coarse pixels; 0 where there is no metal."""
    if "thicker" not in numbers:
        return np.float32(0)
    coarse = np.asarray(numbers["thicker"][view], np.float32)
    block, (height, width) = shape[0] // coarse.shape[0], coarse.shape
    read = cv2.resize(coarse, (block * width, block * height), interpolation=cv2.INTER_LINEAR)
    # Pixels beyond the last whole block.
    return np.pad(read, ((0, shape[0] - len(read)), (0, shape[1] - read.shape[1])), mode="edge")


def _bend(images: np.ndarray, until: float) -> np.ndarray:
    """Squares of what is above 0, beyond `until` along their tangent: a starved pixel must not become a hundred."""
    within = np.clip(images, 0.0, until)
    return within**2 + 2 * until * np.maximum(images - until, 0.0)


def _totals(images: np.ndarray) -> np.ndarray:
    """(M,) what views add up to, less the mean, which the FDK's window may change."""
    totals = images.sum(axis=(1, 2), dtype=np.float64)
    return np.asarray(totals - totals.mean())


def _straightening(first: np.ndarray, second: np.ndarray) -> tuple[float, float]:
    """Least squares c of first + c second = 0, and its standard error with neighbouring views left out together."""

    def best(kept: np.ndarray) -> float:
        return -float(first[kept] @ second[kept]) / max(float(second[kept] @ second[kept]), 1e-30)

    every = np.arange(len(first))
    left_out = [best(np.setdiff1d(every, block)) for block in np.array_split(every, _BLOCKS)]
    error = np.sqrt((_BLOCKS - 1) * np.var(left_out))
    return best(every), float(error)


def _explains(share: float, first: np.ndarray, second: np.ndarray) -> bool:
    """Whether the curve makes smooth images agree, too, with what the FDK of all says they should be.

    An object that is cut off, or blurred at its edges, also makes views add up to too little, but not there.
    """
    width = _SMOOTH * max(first.shape[1:])
    before, change = (gaussian_filter(images, (0, width, width)) for images in (first, second))
    gain = 1 - float(((before + share * change) ** 2).sum()) / max(float((before**2).sum()), 1e-30)
    return gain > _LEAST_GAIN


def _finding(share: float, error: float, thick: float, middle: float) -> EffectFinding:
    # p is short of p (1 + c) by c / (1 + c) of it.
    strength, percent = 100 * share / max(1 + share, 0.1), 100 * error / max(1 + share, 0.1) ** 2
    numbers = _numbers(share, thick, middle)
    found: bool | None = bool(strength >= _THRESHOLD and strength >= _ERRORS * percent)
    told = Told(
        "Thick parts attenuate {percent:.1f} % less than thin ones promise, give or take {error:.1f} %"
        if strength >= 0
        else "Thick parts attenuate {percent:.1f} % more than thin ones promise, give or take {error:.1f} %",
        percent=abs(strength),
        error=percent,
    )
    if found:
        reason = Told("{told}; from {least:g} % that makes the inside look hollow.", told=told, least=_THRESHOLD)
    elif strength <= -_THRESHOLD and strength <= -_ERRORS * percent:
        other = "{told}; no beam does that: views are missing, or something is outside of the box."
        found, reason = None, Told(other, told=told)
    elif strength + _SURELY_NOT * percent >= _THRESHOLD:
        unclear = "{told}; that is too uncertain to tell: the object looks alike from all sides."
        found, reason = None, Told(unclear, told=told)
    else:
        reason = Told("{told}; from {least:g} % less, it would count.", told=told, least=_THRESHOLD)
    return EffectFinding(_NAME, found, strength, _UNIT, _THRESHOLD, reason, percent, numbers if strength > 0 else {})


def _numbers(share: float, thick: float, middle: float) -> dict[str, float]:
    curvature = share / thick
    return {"curvature": curvature, "scale": 1 / (1 + curvature * middle), "until": _STRAIGHT * thick}


def _unknown(reason: Told) -> EffectFinding:
    return EffectFinding(_NAME, None, None, _UNIT, _THRESHOLD, reason)
