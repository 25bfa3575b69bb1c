"""A wide focal spot: each of its points throws a shadow of its own, and edges become half-shadows.

At the detector a half-shadow is as wide as the spot times M − 1, M the magnification of the edge (e.g. Buzug, Computed
Tomography, 2008, section 2.3); about the axis that is a Gaussian all over the image, on what arrives (e⁻ᵖ), not on the
line integrals p. An edge is seen from both sides, near to the source and far from it: half-shadows widen by (M − 1)²
of their square in between, edges that are smooth by themselves by M² alone, and what the detector smears not at all.
What is seen of it is taken out as Richardson (J. Opt. Soc. Am. 62(1), 1972) and Lucy (1974) do, before any fit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.spatial import cKDTree

from ..capture.detectors import project_points
from ..capture.model import Projections
from ..progress import Tick, unstopped
from ..told import Told
from ..views import Detector
from .finding import EffectFinding
from .look.edge_widths import ViewEdges, edge_points, rises, view_edges
from .rays import RayEvidence, arriving, of_another_unit

_NAME, _UNIT = "focal_spot", "px"
# As of blurred photos: half a pixel is a decibel of the FDK.
_THRESHOLD, _SURELY_NOT = 0.5, 2.0
# Two errors: what nearness to the source does to smooth edges is taken off before.
_SURE = 2.0
# Of the squared widths, the share that is under what the spot makes of sharp edges: others are two in one.
_USUAL = 40.0
# Widths come in steps of a tenth of a px².
_STEP_ERROR = 0.03
# How much nearer to the law of half-shadows than smooth edges are, on the way from theirs to it.
_BEYOND_SMOOTH = 0.1
_FEWEST_PAIRS, _FEWEST_EDGES, _MOST_PAIRS, _MOST_PIXELS = 8, 300, 30, 2_000_000
# Two views are opposite within this angle; an edge is the same within so many pixels and this cosine.
_OPPOSITE_RAD, _SAME_PX, _SAME_COS = 0.1, 1.5, 0.95
_BLOCKS = 10
# Magnifications that no part of the object has are errors of depth.
_MOST_LEVER = 2.0
_LEAST_MAGNIFIED = 1.02
_ROUNDS, _PAD = 20, 4.0
# Nothing is sharpened to let less light through than this, and what lets less through already stays.
_LEAST_LIGHT = 1e-12
# Line integrals that all but the very deepest are below.
_NEARLY_ALL = 99.0
_REWEIGHINGS, _LEAST_REST = 15, 0.2


class _Pairs(NamedTuple):
    """Edges seen from both sides, E of them: differences of squared widths, in squares of the pitch, and of levers,
    mean squared widths, and which pair of views each is of. A lever is (M − 1)² over that of the axis."""

    width2: np.ndarray
    lever: np.ndarray
    mean2: np.ndarray
    views: np.ndarray


def detect(evidence: RayEvidence) -> EffectFinding:
    """Deviation of the half-shadow of what is on the axis, in pixels of the detector, or the sides of squares as large
    where they are not square; the error is that of a jackknife.

    `numbers`: "sigma_mm", the same at the detector. They are there for edges of whatever blur: whoever asks for the
    effect by name has it taken out even if the object may be smooth.

    Raises:
        CaptureError: the projections cannot be reconstructed.
        Cancelled: through the evidence's reporter.
    """
    projections = evidence.projections
    if projections.detectors[0].parallel:
        return _unknown(Told("The source of a parallel beam has no focal spot that could be seen."))
    pairs = _opposite(projections, evidence.training)
    if len(pairs) < _FEWEST_PAIRS:
        few = "{count} pairs of opposite views are too few to see edges from both sides."
        return _unknown(Told(few, count=len(pairs)))
    chosen = sorted({view for pair in pairs for view in pair})
    unknown = of_another_unit(_deep(evidence, chosen))
    if unknown is not None:
        return _unknown(unknown)
    edges = _edges(evidence, chosen)
    count = sum(len(some.width2) for some in edges.values())
    if count < _FEWEST_EDGES:
        return _unknown(Told("{count} edges are too few to tell how sharp projections are.", count=count))
    widths2 = [np.concatenate([edges[view].width2 for view in pair]) for pair in pairs]
    blocks = np.array_split(np.arange(len(pairs)), _BLOCKS)
    without = [[some for number, some in enumerate(widths2) if number not in block] for block in blocks if block.size]
    if not all(any(map(len, some)) for some in without):
        return _unknown(Told("Nearly all edges are in a few views, too few to tell how sure their widths are."))
    others = [_usual(some) for some in without]
    strength = float(np.sqrt(max(_usual(widths2), 0.0)))
    error = max(_jackknife(np.array(others)), _STEP_ERROR) / max(2 * strength, _THRESHOLD)
    pitch = _pitch_mm(projections.detectors[0])
    if strength < _THRESHOLD:
        sure = strength + _SURELY_NOT * error < _THRESHOLD
        told = Told("The usual edge of a projection is blurred by {px:.2f} pixels", px=strength)
        why = Told(
            "under {least:g} that does not matter." if sure else "that is too near to what would matter.",
            least=_THRESHOLD,
        )
        reason = Told("{told}; {why}", told=told, why=why)
        return EffectFinding(_NAME, False if sure else None, strength, _UNIT, _THRESHOLD, reason, error)
    middle = projections.box_mm.mean(axis=0)
    axis = float(np.median([_magnified(projections.detectors[view], middle) for view in edges]))
    if axis < _LEAST_MAGNIFIED:
        return _unknown(Told("The object stands so near to the detector that a focal spot throws no half-shadow."))
    return _finding(strength, error, pitch, _matched(evidence, edges, pairs, axis), axis)


def corrected(projections: Projections, numbers: Mapping[str, Any], tick: Tick = unstopped) -> Projections:
    """The projections as a point would have made them, as far as noise lets that be seen."""
    sigma = _sigma_px(projections, numbers)
    pad = int(np.ceil(_PAD * sigma.max()))
    images = np.empty_like(projections.images)
    for index, image in enumerate(projections.images):
        tick()
        known = np.isfinite(image)
        arrived = np.pad(arriving(_filled(image, known).astype(np.float64)), pad, mode="edge")
        sharp, least = arrived.copy(), np.finfo(arrived.dtype).tiny
        for _ in range(_ROUNDS):
            # A large view takes seconds.
            tick()
            blurred = gaussian_filter(sharp, sigma, mode="nearest")
            sharp *= gaussian_filter(arrived / np.maximum(blurred, least), sigma, mode="nearest")
        sharp = np.maximum(sharp, np.minimum(arrived, _LEAST_LIGHT))
        inner = sharp[pad : pad + image.shape[0], pad : pad + image.shape[1]]
        images[index] = np.where(known, -np.log(inner), image)
    return replace(projections, images=images)


def drawn(image: np.ndarray, view: int, projections: Projections, numbers: Mapping[str, Any]) -> np.ndarray:
    """(height, width) of a rendered projection as the spot blurs it."""
    light = arriving(np.asarray(image, np.float64))
    return np.asarray(-np.log(gaussian_filter(light, _sigma_px(projections, numbers), mode="nearest")))


def _sigma_px(projections: Projections, numbers: Mapping[str, Any]) -> np.ndarray:
    """(2,) along columns and rows."""
    first = projections.detectors[0]
    return float(numbers["sigma_mm"]) / np.array([np.linalg.norm(first.v), np.linalg.norm(first.u)])


def _filled(image: np.ndarray, known: np.ndarray) -> np.ndarray:
    """An image whose unknown pixels are as the nearest known ones: anything else would be an edge."""
    if known.all() or not known.any():
        return np.where(known, image, 0.0)
    rows, columns = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return np.asarray(image[rows, columns])


def _opposite(projections: Projections, training: np.ndarray) -> list[tuple[int, int]]:
    """Pairs of training views from opposite sides, each view in one at most, spread over the turn."""
    left, found = [int(view) for view in training[np.argsort(projections.angles_rad[training], kind="stable")]], []
    while left:
        view = left.pop(0)
        if not left:
            break
        turned = projections.angles_rad[left] - projections.angles_rad[view]
        away = np.abs(np.mod(turned, 2 * np.pi) - np.pi)
        if away.min() < _OPPOSITE_RAD:
            found.append((view, left.pop(int(away.argmin()))))
    if len(found) > _MOST_PAIRS:
        found = [found[place] for place in np.linspace(0, len(found) - 1, _MOST_PAIRS).round().astype(int)]
    return found


def _deep(evidence: RayEvidence, views: list[int]) -> float:
    images = evidence.views.images[views]
    return float(np.percentile(np.where(np.isfinite(images), images, 0.0), _NEARLY_ALL))


def _edges(evidence: RayEvidence, views: list[int]) -> dict[int, ViewEdges]:
    """Edges of each view about the middle row, as many rows as can be looked at in some seconds."""
    images, peak = evidence.projections.images, evidence.projections.peak(evidence.training)
    height, width = images.shape[1:]
    rows = min(height, max(32, _MOST_PIXELS // (len(views) * width)))
    first, found = (height - rows) // 2, {}
    for view in views:
        evidence.reporter.check()
        band = images[view, first : first + rows]
        some = view_edges(_filled(band, np.isfinite(band)), peak)
        width2 = some.width2 / _pixels_across(some.across, evidence.projections.detectors[view])
        found[view] = some._replace(place=some.place + np.array([first, 0]), width2=width2)
    return found


def _pitch_mm(detector: Detector) -> float:
    """The side of a square as large as a pixel."""
    return float(np.sqrt(np.linalg.norm(detector.u) * np.linalg.norm(detector.v)))


def _pixels_across(across: np.ndarray, detector: Detector) -> np.ndarray:
    """(E,) the square of how many pixels such a square's side is, across edges of directions (E, 2) in pixels."""
    sides = np.array([np.linalg.norm(detector.v), np.linalg.norm(detector.u)])
    return np.asarray(1 + across**2 @ ((_pitch_mm(detector) / sides) ** 2 - 1))


def _matched(evidence: RayEvidence, edges: dict[int, ViewEdges], pairs: list[tuple[int, int]], axis: float) -> _Pairs:
    projections, rising = evidence.projections, rises(evidence.volume)
    known, lever = {}, {}
    for view, some in edges.items():
        evidence.reporter.check()
        detector = projections.detectors[view]
        points = edge_points(evidence.volume, rising, detector, some)
        lever[view] = ((_magnified(detector, points) - 1) / (axis - 1)) ** 2
        kept = np.abs(lever[view] - 1) < _MOST_LEVER
        edges[view], lever[view], known[view] = some.some(kept), lever[view][kept], points[kept]
    parts: list[np.ndarray] = []
    for number, (one, other) in enumerate(pairs):
        if len(edges[one].place) == 0 or len(edges[other].place) == 0:
            continue
        seen = project_points(projections.detectors[other], known[one])
        away, nearest = cKDTree(edges[other].place[:, ::-1] + 0.5).query(seen)
        # From behind, left is right.
        alike = np.abs((edges[one].across * [1, -1] * edges[other].across[nearest]).sum(axis=1))
        same = (away < _SAME_PX) & (alike > _SAME_COS)
        here, there = edges[one].width2[same], edges[other].width2[nearest[same]]
        levers = lever[one][same] - lever[other][nearest[same]]
        parts.append(np.stack([here - there, levers, 0.5 * (here + there), np.full(len(here), number)]))
    return _Pairs(*np.concatenate([np.zeros((4, 0)), *parts], axis=1))


def _magnified(detector: Detector, points: np.ndarray) -> np.ndarray:
    """(...,) how many times as large things at `points` (..., 3) are at the detector."""
    source = np.asarray(detector.source, np.float64)
    normal: np.ndarray = np.cross(np.asarray(detector.u, np.float64), np.asarray(detector.v, np.float64))
    return np.asarray(((np.asarray(detector.center, np.float64) - source) @ normal) / ((points - source) @ normal))


def _slope(width2: np.ndarray, lever: np.ndarray) -> float:
    """Least absolute differences of a line through 0."""
    slope = 0.0
    for _ in range(_REWEIGHINGS):
        weight = lever / np.maximum(np.abs(width2 - slope * lever), _LEAST_REST)
        slope = float(weight @ width2) / max(float(weight @ lever), 1e-12)
    return slope


def _usual(widths2: list[np.ndarray]) -> float:
    return float(np.percentile(np.concatenate(widths2), _USUAL))


def _jackknife(others: np.ndarray) -> float:
    return float(np.sqrt((len(others) - 1) * np.var(others)))


def _finding(strength: float, error: float, pitch: float, same: _Pairs, axis: float) -> EffectFinding:
    sigma_mm = strength * pitch
    numbers = {"sigma_mm": sigma_mm}
    # A disc is four of its deviations wide.
    told = Told(
        "The usual edge of a projection is blurred by {px:.2f} pixels; a focal spot {mm:.2g} mm wide would do that",
        px=strength,
        mm=4 * sigma_mm / (axis - 1),
    )

    def finding(found: bool | None, why: Told) -> EffectFinding:
        reason = Told("{told}, {why}", told=told, why=why)
        return EffectFinding(_NAME, found, strength, _UNIT, _THRESHOLD, reason, error, numbers)

    if len(same.width2) < _FEWEST_EDGES:
        return finding(None, Told("but too few edges are seen from both sides to tell it from a smooth object."))
    mean2, slope = float(np.median(same.mean2)), _slope(same.width2, same.lever)
    of_blocks = np.array_split(np.unique(same.views), _BLOCKS)
    kept = [~np.isin(same.views, block) for block in of_blocks]
    unsure = _jackknife(np.array([_slope(same.width2[each], same.lever[each]) for each in kept]))
    # d log M² over d log (M − 1)².
    smooth = (axis - 1) / axis
    least = (smooth + _BEYOND_SMOOTH * (1 - smooth)) * mean2
    if slope - _SURE * unsure > least:
        return finding(True, Told("and edges are the wider the nearer they are to the source, as half-shadows are."))
    why = Told("but they are hardly wider near to the source: the object may be smooth, or the detector smears.")
    return finding(None, why)


def _unknown(reason: Told) -> EffectFinding:
    return EffectFinding(_NAME, None, None, _UNIT, _THRESHOLD, reason)
