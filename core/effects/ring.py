"""Rings: pixels that say a little more or less than they should, the same in all views, which an FDK draws as circles.

Over a full turn the rays that end in a pixel and those that end in its mirror image about the axis are the two rulings
of the same hyperboloids, so that their means over all views are equal, whatever the object, one of revolution too (of
parallel beams: they are the same rays). What is odd in the mean view is the pixels' own and tells how large all of it
is. The rings of an FDK are the even part, which looks like a body of revolution: a fit tells that (`ring_offsets`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import convolve1d

from ..capture.detectors import project_points
from ..capture.model import Projections
from ..fdk import coverage
from ..progress import Tick, unstopped
from ..told import Told
from .finding import EffectFinding
from .rays import RayEvidence

_NAME, _UNIT = "ring", "% of the peak"
# 60 dB; held-out projections of what is well fitted have 42 dB, but what all views share does not average out.
_THRESHOLD, _ERRORS, _SURELY_NOT = 0.1, 5.0, 2.0
_FEWEST_VIEWS, _FEWEST_COLUMNS = 16, 16
# Edges, and a detector off its place, make the mean view odd, too; Immerkaer's mask takes smooth things away.
_MASK, _MASK_NORM, _ALIKE = np.array([1.0, -2.0, 1.0]), 6.0, 4.0
_TO_DEVIATION = 1.4826
# Relative standard error of the square of a median deviation of n independent numbers, times the root of n.
_OF_SQUARE = 2.33


def detect(evidence: RayEvidence) -> EffectFinding:
    """Deviation of what pixels add to all line integrals alike, in percent of the largest.

    Noise is what differs between the mean of every other view and that of the rest.

    `numbers`: "deviation", the same as a line integral; "offsets" join it once a fit has told them. There are none
    under the threshold, whoever asks.

    Raises Cancelled through the evidence's reporter.
    """
    projections, training = evidence.projections, evidence.training
    if len(training) < _FEWEST_VIEWS:
        return _unknown(Told("{count} projections are too few to tell pixels from the object.", count=len(training)))
    turned = coverage(projections, np.full(len(projections.detectors), True))["angular_range_deg"]
    if turned < 360:
        part = "Views over {degrees:.0f} degrees do not show the object from both sides of each pixel."
        return _unknown(Told(part, degrees=turned))
    middle = projections.box_mm.mean(axis=0)
    axis = float(np.median([project_points(projections.detectors[index], middle)[0] for index in training]))
    height, width = projections.images.shape[1:]
    first, last = max(0, round(2 * axis) - width), min(width, round(2 * axis))
    if last - first < _FEWEST_COLUMNS or height < _MASK.size:
        return _unknown(Told("Too few pixels have a mirror image beside the axis of rotation."))
    order = training[np.argsort(projections.angles_rad[training], kind="stable")]
    means = [_mean(evidence, order[start::2])[:, first:last] for start in (0, 1)]
    # Half of the squares are in the even part.
    both, noise = (2 * _odd_square(0.5 * (means[0] + sign * means[1])) for sign in (1, -1))
    independent = height * (last - first) / 2 / _ALIKE
    return _finding(_Squares(both, noise, independent), projections.peak(training))


def corrected(projections: Projections, numbers: Mapping[str, Any], tick: Tick = unstopped) -> Projections:
    """The projections less the pixels' "offsets" (height, width); themselves as long as there are none."""
    if "offsets" not in numbers:
        return projections
    tick()
    return replace(projections, images=projections.images - np.asarray(numbers["offsets"], np.float32))


class _Squares(NamedTuple):
    """Squared deviation of what pixels have in the mean view and of the noise in it, and of how many numbers."""

    both: float
    noise: float
    independent: float


def _mean(evidence: RayEvidence, chosen: np.ndarray) -> np.ndarray:
    """(height, width) mean of some views; what is not finite counts as nothing."""
    total = np.zeros(evidence.projections.images.shape[1:])
    for index in chosen:
        evidence.reporter.check()
        image = evidence.projections.images[index]
        total += np.where(np.isfinite(image), image, 0.0)
    return total / len(chosen)


def _odd_square(mean: np.ndarray) -> float:
    odd = 0.5 * (mean - mean[:, ::-1])
    rough = convolve1d(convolve1d(odd, _MASK, axis=0), _MASK, axis=1) / _MASK_NORM
    return float((_TO_DEVIATION * np.median(np.abs(rough))) ** 2)


def _finding(squares: _Squares, peak: float) -> EffectFinding:
    excess = squares.both - squares.noise
    unsure = _OF_SQUARE / np.sqrt(squares.independent) * float(np.hypot(squares.both, squares.noise))
    size = float(np.sqrt(max(excess, 0.0)))
    strength, error = 100 * size / peak, 100 * unsure / max(2 * size, float(np.sqrt(unsure)), 1e-12) / peak
    told = Told("Pixels add {percent:.2g} % of the peak to all views alike", percent=strength)
    found = bool(strength >= _THRESHOLD and excess >= _ERRORS * unsure)
    numbers = {"deviation": size} if strength >= _THRESHOLD else {}
    if found:
        reason = Told("{told}, which makes rings: take a new flat field.", told=told)
        return EffectFinding(_NAME, True, strength, _UNIT, _THRESHOLD, reason, error, numbers)
    if strength + _SURELY_NOT * error < _THRESHOLD:
        reason = Told("{told}; from {least:g} % on that makes rings.", told=told, least=_THRESHOLD)
        return EffectFinding(_NAME, False, strength, _UNIT, _THRESHOLD, reason, error)
    reason = Told("{told}; that may be noise.", told=told)
    return EffectFinding(_NAME, None, strength, _UNIT, _THRESHOLD, reason, error, numbers)


def _unknown(reason: Told) -> EffectFinding:
    return EffectFinding(_NAME, None, None, _UNIT, _THRESHOLD, reason)
