"""Chamfer distance between point sets, and hidden point removal to compare outer surfaces only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree

from .histogram import fibonacci_sphere


@dataclass(frozen=True)
class Chamfer:
    """How far two point sets lie apart.

    Attributes:
        mm: mean of the two mean nearest distances.
        squared_mm2: the same of squared distances.
        percent_of_diagonal: `mm` in percent of the second set's box diagonal.
    """

    mm: float
    squared_mm2: float
    percent_of_diagonal: float


def chamfer(first: np.ndarray, second: np.ndarray, keep: float = 1.0) -> Chamfer:
    """Two-way chamfer distance of points (N, 3) and (M, 3) in mm.

    Args:
        keep: share of the smallest distances of each way that counts; under 1 is the trimmed variant, which lets
            either set miss a part of the surface.

    Raises:
        ValueError: a set is empty or holds a value that is not finite, or `keep` is not in (0, 1].
    """
    first, second = np.asarray(first, np.float64), np.asarray(second, np.float64)
    for points in (first, second):
        if len(points) == 0 or not np.isfinite(points).all():
            raise ValueError("chamfer: both sets need at least one point, and only finite ones")
    if not 0 < keep <= 1:
        raise ValueError(f"chamfer: keep must be in (0, 1], not {keep}")
    there, back = cKDTree(second).query(first)[0], cKDTree(first).query(second)[0]

    def smallest(distance: np.ndarray) -> np.ndarray:
        return np.sort(distance)[: max(1, round(keep * len(distance)))]

    there, back = smallest(there), smallest(back)
    mean = 0.5 * float(there.mean() + back.mean())
    diagonal = float(np.linalg.norm(np.ptp(second, axis=0)))
    squared = 0.5 * float((there**2).mean() + (back**2).mean())
    return Chamfer(mean, squared, 100.0 * mean / diagonal if diagonal > 0 else 0.0)


def hidden_point_removal(points: np.ndarray, viewpoint: np.ndarray, radius: float = 100.0) -> np.ndarray:
    """Which points (N,) a viewpoint sees (Katz et al. 2007): those whose spherical flip lies on the convex hull.

    p̂ = p + 2(R − ‖p‖)p / ‖p‖ about the viewpoint; visible are the corners of the hull of {p̂, 0}. Points that all
    lie in one plane, or on one line, have no hull: they are joggled (Qhull's QJ), and where even that fails all
    count as visible.

    Args:
        points: (N, 3).
        viewpoint: (3,).
        radius: R in diameters of the set.
    """
    offset = np.asarray(points, np.float64) - np.asarray(viewpoint, np.float64)
    length = np.linalg.norm(offset, axis=1)
    visible = np.zeros(len(offset), bool)
    if len(offset) < 4:
        return ~visible
    diameter = max(float(np.linalg.norm(np.ptp(offset, axis=0))), float(length.max()), 1e-30)
    # A point at the viewpoint itself has no direction to flip along.
    usable = np.flatnonzero(length > 1e-12 * diameter)
    if len(usable) < 4:
        return ~visible
    reach = length[usable, None]
    flipped = offset[usable] + 2 * (radius * diameter - reach) * offset[usable] / reach
    candidates = np.concatenate([flipped / (radius * diameter), np.zeros((1, 3))])
    for options in ("Qt", "QJ"):
        try:
            corners = ConvexHull(candidates, qhull_options=options).vertices
            break
        except QhullError:
            continue
    else:
        return ~visible
    visible[usable[corners[corners < len(usable)]]] = True
    return visible


def outer_points(points: np.ndarray, views: int = 20, limit: int = 8000, seed: int = 0) -> np.ndarray:
    """The points that at least one of `views` viewpoints around the set sees (paper, "Ablation Study").

    Args:
        points: (N, 3); more than `limit` are thinned by a seeded draw.
        views: viewpoints on a sphere of 1.5 diameters around the set's middle.
    """
    points = np.asarray(points, np.float64)
    if len(points) > limit:
        points = points[np.sort(np.random.default_rng(seed).choice(len(points), limit, replace=False))]
    if len(points) == 0:
        return points
    low, high = points.min(axis=0), points.max(axis=0)
    distance = 1.5 * max(float(np.linalg.norm(high - low)), 1e-12)
    seen = np.zeros(len(points), bool)
    for direction in fibonacci_sphere(views):
        seen |= hidden_point_removal(points, 0.5 * (low + high) + distance * direction)
    return points[seen]
