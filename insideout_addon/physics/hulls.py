"""Convex hulls: the shape that a body rolls and collides with."""

from __future__ import annotations

from collections.abc import Generator
from itertools import product

import bmesh
import numpy as np

from ...core.errors import SettingError
from ...core.gaussians import GaussianSet
from ...core.rotations import quats_to_matrices
from ...core.steps import part_of_work, run_through

# Where a splat's surface is taken to be, in standard deviations.
_SURFACE_SIGMAS = 1.6
# X-ray splats below this share of the densest hundredth are air.
_LEAST_DENSITY = 0.1
_MOST_ITERATIONS = 200
# Points whose hull is made at once, and those that are looked at together to leave out what is inside.
_AT_A_TIME, _LOOKED_AT = 1 << 14, 1 << 16
# Of the points' size, how far inside a point is to be so that rounding cannot have put it there.
_INSIDE = 1e-5
# The points that reach farthest these ways leave most of the others inside.
_WAYS = np.array([way for way in product((-2, -1, 0, 1, 2), repeat=3) if max(map(abs, way)) == 2], np.float64)


def convex_hull(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and triangles (F, 3) of the convex hull of points (P, 3), counter-clockwise from outside.

    Raises:
        SettingError: the points lie in a plane, so they enclose nothing.
    """
    return run_through(hull_in_steps(points))


def hull_in_steps(points: np.ndarray) -> Generator[float, None, tuple[np.ndarray, np.ndarray]]:
    """As `convex_hull`, with breaks that tell the share that is done.

    Of many points the inner ones are left out first (Akl and Toussaint, Information Processing Letters 7(5), 1978), and
    of the others the corners of the hulls of parts have the same hull as all of them.
    """
    if len(points) > _AT_A_TIME:
        points = yield from part_of_work(_outer_in_steps(points), 0.0, 0.3)
        parts = []
        for first in range(0, len(points), _AT_A_TIME):
            parts.append(_corners(points[first : first + _AT_A_TIME]))
            yield 0.3 + 0.6 * min(first / len(points) + _AT_A_TIME / len(points), 1.0)
        points = np.concatenate(parts)
    vertices, faces = _hull(points)
    if len(faces) < 4:
        raise SettingError("the model is flat, so it has no body; choose one with some thickness.")
    return vertices, faces


def _outer_in_steps(points: np.ndarray) -> Generator[float, None, np.ndarray]:
    """The points (P, 3) without most of those that lie inside of others."""
    farthest = []
    for number, way in enumerate(_WAYS, 1):
        farthest.append(np.argmax(points @ way))
        yield 0.5 * number / len(_WAYS)
    vertices, faces = _hull(points[np.unique(farthest)])
    if len(faces) < 4:
        return points
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    most = (normals * corners[:, 0]).sum(axis=1) - _INSIDE * float(np.ptp(vertices, axis=0).max())
    kept = []
    for first in range(0, len(points), _LOOKED_AT):
        some = points[first : first + _LOOKED_AT]
        kept.append(some[(some @ normals.T > most).any(axis=1)])
        yield 0.5 + 0.5 * min((first + _LOOKED_AT) / len(points), 1.0)
    return np.concatenate(kept)


def _corners(points: np.ndarray) -> np.ndarray:
    """Those of points (P, 3) that their hull goes through; all of them where they lie in a plane."""
    vertices, faces = _hull(points)
    return points if len(faces) < 4 else vertices


def _hull(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`convex_hull`; of points in a plane there are fewer than four faces."""
    mesh = bmesh.new()
    try:
        for point in points.tolist():
            mesh.verts.new(point)
        found = bmesh.ops.convex_hull(mesh, input=mesh.verts, use_existing_faces=False)
        faces = [part for part in found["geom"] if isinstance(part, bmesh.types.BMFace)]
        bmesh.ops.triangulate(mesh, faces=faces)
        mesh.verts.index_update()
        triangles = np.array([[vertex.index for vertex in face.verts] for face in mesh.faces], np.int64).reshape(-1, 3)
        places = np.array([vertex.co for vertex in mesh.verts], np.float64).reshape(-1, 3)
    finally:
        mesh.free()
    if len(triangles) < 4:
        return places, triangles
    used, faces = np.unique(triangles, return_inverse=True)
    vertices, faces = places[used], faces.reshape(-1, 3)
    corners = vertices[faces] - vertices.mean(axis=0)
    inwards = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) < 0
    faces[inwards] = faces[inwards, ::-1]
    return vertices, faces


def hulls_are_apart(a: np.ndarray, b: np.ndarray, gap: float) -> bool:
    """Whether a plane with more than `gap` between its sides parts the convex hulls of points (A, 3) and (B, 3).

    Gilbert's iteration (SIAM J. Control 4(1), 1966) towards the shortest vector between them; where it takes long
    they touch as good as not.
    """
    between = a.mean(axis=0) - b.mean(axis=0)
    for _ in range(_MOST_ITERATIONS):
        length = np.linalg.norm(between)
        if length <= gap:
            return False
        nearest = a[np.argmin(a @ between)] - b[np.argmax(b @ between)]
        if nearest @ between > gap * length:
            return True
        step = nearest - between
        share = -(between @ step) / max(step @ step, 1e-300)
        if not share > 1e-9:
            return False
        between = between + min(share, 1.0) * step
    return False


def splat_surface(gaussians: GaussianSet) -> np.ndarray:
    """(P, 3) the ends of the axes of a model's splats, which its hull goes through; mm.

    Splats with density if there are any, without those of next to none, which float in air.
    """
    gaussians = gaussians.select(np.isfinite(gaussians.means).all(axis=1))
    solid = gaussians.density > _LEAST_DENSITY * np.percentile(gaussians.density, 99)
    body = gaussians.select(solid) if solid.any() else gaussians
    axes = (quats_to_matrices(body.quats) * (_SURFACE_SIGMAS * body.scales)[:, None, :]).swapaxes(1, 2)
    return np.concatenate([body.means[:, None] + axes, body.means[:, None] - axes]).reshape(-1, 3)
