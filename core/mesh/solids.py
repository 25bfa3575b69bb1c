"""The solids that a triangle mesh bounds: volumes, closedness, which inner surfaces belong to which. Numpy alone."""

from __future__ import annotations

import numpy as np

# Rays go along z after this turn: marching cubes put vertices on straight lines along the axes, and a ray through
# a vertex is counted wrongly.
_SKEW = np.linalg.qr(np.array([[0.9, 0.31, 0.17], [-0.23, 0.88, 0.41], [0.13, -0.37, 0.83]]))[0]


def volume_and_centroid(vertices: np.ndarray, faces: np.ndarray) -> tuple[float, np.ndarray]:
    """The volume that closed surfaces enclose, those of cavities taken off, and its centroid (3,).

    Args:
        vertices: (V, 3).
        faces: (F, 3), counter-clockwise from outside.

    Returns:
        The cube of the vertices' unit, and their unit; without any volume the mean vertex.
    """
    if len(faces) == 0:
        return 0.0, np.zeros(3)
    # Near the origin no digits are lost.
    middle = vertices[faces[:, 0]].mean(axis=0)
    corners = vertices[faces] - middle
    parts = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    volume = float(parts.sum())
    if abs(volume) < 1e-12:
        return 0.0, middle + corners.reshape(-1, 3).mean(axis=0)
    return volume, middle + parts @ corners.sum(axis=1) / (4 * volume)


def is_closed(faces: np.ndarray) -> bool:
    """Whether each edge is that of two triangles, in opposite directions: an oriented 2-manifold without border."""
    if len(faces) == 0:
        return False
    start, end = _edges(faces)
    count = int(faces.max()) + 1
    forth, back = np.sort(start * count + end), np.sort(end * count + start)
    return bool((np.diff(forth) > 0).all() and np.array_equal(forth, back))


def surface_labels(faces: np.ndarray) -> np.ndarray:
    """(F,) number of the connected surface, from 0, that each triangle belongs to."""
    count = int(faces.max(initial=-1)) + 1
    label = np.arange(count)
    start, end = _edges(faces)
    while True:
        a, b = label[start], label[end]
        if np.array_equal(a, b):
            break
        # Roots only: hooked to the smaller, then every path is made one step long.
        np.minimum.at(label, np.maximum(a, b), np.minimum(a, b))
        while not np.array_equal(label, label[label]):
            label = label[label]
    return np.unique(label[faces[:, 0]], return_inverse=True)[1].reshape(-1)


def solid_labels(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F,) number of the solid, from 0 for the largest, that each triangle bounds.

    A closed inner surface, whose enclosed volume is negative, belongs to the innermost solid around it: each doll of
    a matryoshka is one, with its cavity. An inner surface with nothing around it counts to the largest.
    """
    if len(faces) == 0:
        return np.zeros(0, np.int64)
    surfaces = surface_labels(faces)
    number = int(surfaces.max(initial=-1)) + 1
    corners = vertices[faces] - vertices[faces[:, 0]].mean(axis=0)
    parts = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    volumes = np.bincount(surfaces, parts, number)
    outer = [s for s in np.argsort(-volumes, kind="stable") if volumes[s] > 0]
    if not outer:
        return np.zeros(len(faces), np.int64)
    solid = np.zeros(number, np.int64)
    solid[outer] = np.arange(len(outer))
    cavities = np.flatnonzero(volumes <= 0)
    if len(cavities) and len(outer) > 1:
        solid[cavities] = _innermost(vertices, faces, surfaces, cavities, outer)
    return solid[surfaces]


def _innermost(
    vertices: np.ndarray, faces: np.ndarray, surfaces: np.ndarray, cavities: np.ndarray, outer: list[int]
) -> np.ndarray:
    """(C,) index into `outer`, surfaces in order of falling volume, of the smallest one around each cavity."""
    turned = vertices @ _SKEW.T
    triangles = turned[faces]
    order = np.argsort(surfaces, kind="stable")
    bounds = np.searchsorted(surfaces[order], np.arange(surfaces.max() + 2))
    # A point on each cavity's wall.
    points = triangles[order[bounds[cavities]]].mean(axis=1)
    found = np.zeros(len(cavities), np.int64)
    open_ = np.ones(len(cavities), bool)
    for rank in range(len(outer) - 1, -1, -1):
        own = triangles[order[bounds[outer[rank]] : bounds[outer[rank] + 1]]]
        low, high = own.min(axis=(0, 1)), own.max(axis=(0, 1))
        near = np.flatnonzero(open_ & ((points > low) & (points < high)).all(axis=1))
        for index in near[_inside(own, points[near])]:
            found[index], open_[index] = rank, False
    return found


def _inside(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(P,) whether points lie within a closed surface (F, 3, 3): a ray upwards crosses it an odd number of times."""
    low, high = triangles[:, :, :2].min(axis=1), triangles[:, :, :2].max(axis=1)
    result = np.zeros(len(points), bool)
    for index, point in enumerate(points):
        over = ((low <= point[:2]) & (high >= point[:2])).all(axis=1)
        a, b, c = (triangles[over, corner] - point for corner in range(3))
        u, v, w = _cross_xy(b, c), _cross_xy(c, a), _cross_xy(a, b)
        total = u + v + w
        hit = ((u >= 0) & (v >= 0) & (w >= 0)) | ((u <= 0) & (v <= 0) & (w <= 0))
        hit &= total != 0
        height = (u * a[:, 2] + v * b[:, 2] + w * c[:, 2])[hit] / total[hit]
        result[index] = np.count_nonzero(height > 0) % 2 == 1
    return result


def _cross_xy(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The directed edges' two ends, (3F,) each."""
    faces = faces.astype(np.int64)
    return faces.ravel(), faces[:, [1, 2, 0]].ravel()
