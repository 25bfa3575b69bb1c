"""What stands around the object where no plain background tells it apart: the room, and the table under it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from ...views import Camera
from ..initialize.hull import viewed_sphere

# A table that is a tenth of what is seen is hit by one trial in a thousand.
_TRIALS, _LOOKED_AT = 5000, 3000
# In radii of the viewed ball: how far off a table's plane its splats lie.
_FLAT = 0.02
# A table is this much of what is seen at least, and carries as much of itself; next to nothing lies under it, no camera
# does, and it is so much wider than what stands on it. The flat top of an object has the object under it, its underside
# the cameras.
_LEAST, _UNDER, _WIDER = 0.1, 0.03, 1.5
# Of points whose hull is compared the farthest are left out: floaters have the widest. And what is left as an object if
# less than this stays was no object.
_FLOATERS, _FEWEST = 0.05, 0.05


def on_the_object(points: np.ndarray, cameras: Sequence[Camera], seed: int = 0) -> np.ndarray:
    """Which points (N, 3) are of what the cameras look at, and neither of the room around nor of a table under it.

    The room is what lies outside of the ball that all cameras look at; a table is a plane that carries all else. Where
    next to nothing would be left, as of photos taken in passing, all are kept.

    Args:
        points, cameras: in one frame.
    """
    middle, radius = viewed_sphere(cameras)
    kept = np.linalg.norm(points - middle, axis=1) <= radius
    table = _table(points[kept], np.array([camera.center for camera in cameras]), radius, seed)
    if table is not None:
        normal, height = table
        kept &= points @ normal > height + 2 * _FLAT * radius
    return kept if kept.mean() > _FEWEST else np.ones(len(points), bool)


def _table(points: np.ndarray, cameras: np.ndarray, radius: float, seed: int) -> tuple[np.ndarray, float] | None:
    """Unit normal (3,) towards the cameras and height of the plane that all else stands on; None where there is none.

    The plane with most points among random ones (RANSAC, Fischler and Bolles 1981), then fitted to its points.
    """
    rng = np.random.default_rng([seed, 31])
    some = points[rng.permutation(len(points))[:_LOOKED_AT]]
    if len(some) < 50:
        return None
    best: tuple[int, np.ndarray, float] = (0, np.zeros(3), 0.0)
    for _ in range(_TRIALS):
        corners = some[rng.choice(len(some), 3, replace=False)]
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        length = float(np.linalg.norm(normal))
        if length > 1e-6 * radius**2:
            best = max(best, _standing(some, cameras, normal / length, corners[0], radius), key=lambda one: one[0])
    count, normal, height = best
    if count < _LEAST * len(some):
        return None
    for _ in range(3):
        on = some[np.abs(some @ normal - height) < _FLAT * radius]
        middle = on.mean(axis=0)
        normal = np.linalg.svd(on - middle, full_matrices=False)[2][2]
        normal = normal if (cameras.mean(axis=0) - middle) @ normal > 0 else -normal
        height = float(middle @ normal)
    above = some[some @ normal > height + 2 * _FLAT * radius]
    carries = len(above) > _LEAST * len(on)
    return (normal, height) if carries and _area(on, normal) > _WIDER * _area(above, normal) else None


def _standing(
    points: np.ndarray, cameras: np.ndarray, normal: np.ndarray, corner: np.ndarray, radius: float
) -> tuple[int, np.ndarray, float]:
    """How many points lie on a plane, 0 where it carries nothing; its normal towards the cameras, and its height."""
    if (cameras.mean(axis=0) - corner) @ normal < 0:
        normal = -normal
    height = float(corner @ normal)
    off = points @ normal - height
    carries = np.mean(off < -_FLAT * radius) < _UNDER and np.all(cameras @ normal > height)
    return (int(np.count_nonzero(np.abs(off) < _FLAT * radius)) if carries else 0), normal, height


def _area(points: np.ndarray, normal: np.ndarray) -> float:
    """Of the convex hull of most points seen along a normal."""
    away = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    points = points[away <= np.quantile(away, 1 - _FLOATERS)]
    side = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    side /= np.linalg.norm(side)
    try:
        return float(ConvexHull(np.stack([points @ side, points @ np.cross(normal, side)], axis=1)).volume)
    except (QhullError, ValueError):
        return 0.0
