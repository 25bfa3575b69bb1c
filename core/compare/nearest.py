"""The distance from points to a mesh, exact for triangles of any size: a tree of boxes around neighbouring ones."""

from __future__ import annotations

import numpy as np

from ..compiled import njit

# Triangles of a leaf; deeper trees only have more boxes to look at.
_LEAF = 8


def distances_to(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N,) distances of points (N, 3) to the nearest of triangles (F, 3, 3), F ≥ 1; both in mm."""
    triangles = np.ascontiguousarray(triangles, np.float64)
    triangles = triangles[np.argsort(_along_a_curve(triangles.mean(axis=1)), kind="stable")]
    low, high = _boxes(triangles)
    return np.sqrt(_nearest(np.ascontiguousarray(points, np.float64), triangles, low, high))


def _along_a_curve(places: np.ndarray) -> np.ndarray:
    """(F,) Morton numbers of places (F, 3): what is near in their order is near in space."""
    low, extent = places.min(axis=0), max(float(np.ptp(places, axis=0).max()), 1e-30)
    cells = ((places - low) / extent * 1023).astype(np.uint64)
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        cells = (cells | (cells << np.uint64(shift))) & np.uint64(mask)
    return cells[:, 0] | (cells[:, 1] << np.uint64(1)) | (cells[:, 2] << np.uint64(2))


def _boxes(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners (2L, 3) of the boxes of a full binary tree: those of node i lie in 2i and 2i + 1, leaf j in L + j.

    A leaf without triangles has its lower corner at infinity and its upper one at minus infinity.
    """
    leaves = -(-len(triangles) // _LEAF)
    size = 1 << (leaves - 1).bit_length()
    low, high = np.full((2 * size, 3), np.inf), np.full((2 * size, 3), -np.inf)
    starts = np.arange(0, len(triangles), _LEAF)
    low[size : size + leaves] = np.minimum.reduceat(triangles.min(axis=1), starts, axis=0)
    high[size : size + leaves] = np.maximum.reduceat(triangles.max(axis=1), starts, axis=0)
    while size > 1:
        half = size // 2
        low[half:size] = np.minimum(low[size : 2 * size : 2], low[size + 1 : 2 * size : 2])
        high[half:size] = np.maximum(high[size : 2 * size : 2], high[size + 1 : 2 * size : 2])
        size = half
    return low, high


@njit(cache=True)
def _nearest(points, triangles, low, high):  # type: ignore[no-untyped-def]
    """(N,) squared distances; of two boxes the nearer is looked into first."""
    leaves = len(low) // 2
    found = np.empty(len(points))
    waiting, away = np.empty(64, np.int64), np.empty(64)
    for index in range(len(points)):
        point, best = points[index], np.inf
        waiting[0], away[0], count = 1, 0.0, 1
        while count:
            count -= 1
            if away[count] >= best:
                continue
            node = waiting[count]
            if node >= leaves:
                first = (node - leaves) * _LEAF
                for place in range(first, min(first + _LEAF, len(triangles))):
                    best = min(best, _to_triangle(point, triangles[place]))
                continue
            near, far = 2 * node, 2 * node + 1
            to_near, to_far = _to_box(point, low[near], high[near]), _to_box(point, low[far], high[far])
            if to_far < to_near:
                near, far, to_near, to_far = far, near, to_far, to_near
            waiting[count], away[count] = far, to_far
            waiting[count + 1], away[count + 1] = near, to_near
            count += 2
        found[index] = best
    return found


@njit(cache=True)
def _to_box(point, low, high):  # type: ignore[no-untyped-def]
    total = 0.0
    for k in range(3):
        beyond = max(low[k] - point[k], point[k] - high[k], 0.0)
        total += beyond * beyond
    return total


@njit(cache=True)
def _to_triangle(point, corners):  # type: ignore[no-untyped-def]
    """Squared: to the face where the point lies over it, else to the nearest edge."""
    normal = _cross(_minus(corners[1], corners[0]), _minus(corners[2], corners[0]))
    size = _dot(normal, normal)
    over, edges = size > 0.0, np.inf
    for k in range(3):
        start, along = corners[k], _minus(corners[(k + 1) % 3], corners[k])
        away = _minus(point, start)
        over = over and _dot(_cross(along, away), normal) >= 0.0
        share = min(max(_dot(away, along) / max(_dot(along, along), 1e-60), 0.0), 1.0)
        rest = (away[0] - share * along[0], away[1] - share * along[1], away[2] - share * along[2])
        edges = min(edges, _dot(rest, rest))
    if not over:
        return edges
    height = _dot(_minus(point, corners[0]), normal)
    return height * height / size


@njit(cache=True)
def _minus(a, b):  # type: ignore[no-untyped-def]
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@njit(cache=True)
def _dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def _cross(a, b):  # type: ignore[no-untyped-def]
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
