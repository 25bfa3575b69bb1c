"""How far views are from what a volume made of them shows, for each of the six ways an object can move.

As in projection matching with rigid poses of each view (e.g. Ouadah et al., Phys. Med. Biol. 61(20), 2016). An FDK
shows in a view much of what that view says itself, wrong or not. What is negative, and what lies beside the object's
shadow in a tenth of the views, is no object: without that the volume disagrees with views that are off.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from ...capture.model import Projections
from ...views import Detector
from ...volume import Volume
from ..rays import RayEvidence
from .reproject import BLUR_PX, MARGIN, ROBUST, WEIGHINGS
from .trajectory import Motion

WAYS = 6
# How far the object is moved to see what that does, and views whose shadows tell where there is none.
_TRIED_PX = 0.5
_SHADOW, _SHADOW_BLUR_PX, _CARVED_BY = 0.04, 0.7, 36
_BESIDE = 0.1


@dataclass(frozen=True, eq=False)
class Says:
    """What N views say of where the object is, once brightness, blur and size are what they may be.

    Attributes:
        weight: (N, 6, 6) mm⁻², inverse covariance of shifts along x, y, z and of turns about them times `reach_mm`.
        pull: (N, 6) mm⁻¹; weight⁻¹ · pull is how far a view would move the object.
        left: (N,) rms of what is not explained before anything is moved, line integrals.
    """

    weight: np.ndarray
    pull: np.ndarray
    left: np.ndarray


def views_say(
    evidence: RayEvidence, volume: Volume, used: np.ndarray, motion: Motion, reach_mm: float, pixel_mm: float
) -> Says:
    """What views say of a volume that stands as `motion` has it.

    Args:
        used: (N,) indices of views.
        motion: of these.
        pixel_mm: of a pixel of the views at the object.
    """
    views = evidence.views
    detectors, tried = [views.detectors[index] for index in used], _TRIED_PX * pixel_mm
    moved = motion.seen_by(detectors)
    for way in range(WAYS):
        moved += motion.further(way, tried, reach_mm).seen_by(detectors)
    drawn = evidence.project(volume, moved).reshape(WAYS + 1, len(used), *views.images.shape[1:])
    said = []
    for place, (index, detector) in enumerate(zip(used, detectors, strict=True)):
        evidence.reporter.check()
        own = drawn[:, place].astype(np.float64)
        weight, pull, left = _fit(views.images[index], own[0], (own[1:] - own[0]) / tried)
        blind = np.cross(detector.u, detector.v)
        said.append((*_without_depth(weight, pull, blind / np.linalg.norm(blind)), left))
    weights, pulls, lefts = zip(*said, strict=True)
    return Says(np.stack(weights), np.stack(pulls), np.array(lefts))


def _without_depth(weight: np.ndarray, pull: np.ndarray, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A shift along the beam, (3,), is hardly seen, and what seems to be seen of it is mostly something else."""
    across = np.eye(WAYS)
    across[:3, :3] -= np.outer(along, along)
    return across @ weight @ across, across @ pull


def _fit(image: np.ndarray, drawn: np.ndarray, changes: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """(6, 6) weight and (6,) pull of one view, robustly, and the rms of what is left.

    Args:
        changes: (6, height, width) of the drawn image, a mm.
    """

    def blurred(part: np.ndarray) -> np.ndarray:
        return gaussian_filter(np.asarray(part, np.float64), BLUR_PX)

    def inner(part: np.ndarray) -> np.ndarray:
        return part[MARGIN:-MARGIN, MARGIN:-MARGIN].ravel()

    model = blurred(drawn)
    by_row, by_column = np.gradient(model)
    height, width = model.shape
    y, x = (np.arange(count) + 0.5 - count / 2 for count in (height, width))
    # An FDK is softer than its views; the brightness and the size may be off, too.
    free = (model, np.gradient(by_column, axis=1), np.gradient(by_row, axis=0), x * by_column + y[:, None] * by_row)
    columns = np.stack([*(inner(blurred(change)) for change in changes), *(inner(part) for part in free)], axis=1)
    wanted = inner(blurred(image) - model)
    size = np.maximum(np.sqrt((columns**2).sum(axis=0)), 1e-12)
    columns, weights = columns / size, np.ones(len(wanted))
    for _ in range(WEIGHINGS):
        normal = (columns * weights[:, None]).T @ columns + 1e-9 * np.eye(columns.shape[1])
        towards = columns.T @ (weights * wanted)
        rest = wanted - columns @ np.linalg.solve(normal, towards)
        spread = max(1.4826 * float(np.median(np.abs(rest))), 1e-12)
        weights = np.minimum(1.0, ROBUST * spread / np.maximum(np.abs(rest), 1e-12))
    # Blurring makes neighbours alike: as many numbers are independent as blurred pixels fit into the image.
    variance = 4 * np.pi * BLUR_PX**2 * float((weights * rest**2).sum() / weights.sum())
    taken = np.linalg.solve(normal[WAYS:, WAYS:], np.column_stack([normal[WAYS:, :WAYS], towards[WAYS:]]))
    scale = size[:WAYS] / max(variance, 1e-30)
    weight = (normal[:WAYS, :WAYS] - normal[:WAYS, WAYS:] @ taken[:, :WAYS]) * np.outer(scale, size[:WAYS])
    pull = (towards[:WAYS] - normal[:WAYS, WAYS:] @ taken[:, WAYS]) * scale
    return weight, pull, float(np.sqrt((wanted**2).mean()))


def carved(volume: Volume, views: Projections, used: np.ndarray) -> Volume:
    """The volume without negative values and without what lies beside the shadow in a tenth of the views or more.

    Args:
        used: (N,) indices of views that have a say.
    """
    values = np.maximum(volume.values, 0.0)
    places = np.argwhere(values > 0)
    points = (places[:, ::-1] * np.asarray(volume.spacing_mm) + np.asarray(volume.origin_mm)).astype(np.float32)
    chosen = used[np.unique(np.linspace(0, len(used) - 1, min(len(used), _CARVED_BY)).astype(int))]
    level = _SHADOW * float(np.percentile(views.images[chosen], 99.5))
    beside = np.zeros(len(points), np.int32)
    for index in chosen:
        air = gaussian_filter(views.images[index], _SHADOW_BLUR_PX) < level
        columns, rows, on = _pixels(views.detectors[index], points)
        beside += on & air[rows, columns]
    gone = places[beside >= _BESIDE * len(chosen)]
    values[tuple(gone.T)] = 0.0
    return Volume(values.astype(np.float32), volume.spacing_mm, volume.origin_mm)


def _pixels(detector: Detector, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Column and row (P,) of points (P, 3) on a detector with a source, and which of them are on it."""
    u, v, source = (np.asarray(part, np.float64) for part in (detector.u, detector.v, detector.source))
    axes = np.stack([u / (u @ u), v / (v @ v), np.cross(u, v)], axis=1)
    middle = (np.asarray(detector.center, np.float64) - source) @ axes
    across = points @ axes.astype(np.float32) - (source @ axes).astype(np.float32)
    reach = middle[2] / across[:, 2]
    columns = np.floor(across[:, 0] * reach - middle[0] + 0.5 * detector.width).astype(np.int32)
    rows = np.floor(across[:, 1] * reach - middle[1] + 0.5 * detector.height).astype(np.int32)
    on = (columns >= 0) & (columns < detector.width) & (rows >= 0) & (rows < detector.height)
    return np.where(on, columns, 0), np.where(on, rows, 0), on
