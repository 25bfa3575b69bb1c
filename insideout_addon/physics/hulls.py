"""Convex hulls: the shape that a body rolls and collides with."""

from __future__ import annotations

import bmesh
import numpy as np

from ...core.errors import SettingError
from ...core.gaussians import GaussianSet
from ...core.rotations import quats_to_matrices

# Where a splat's surface is taken to be, in standard deviations.
_SURFACE_SIGMAS = 1.6
# X-ray splats below this share of the densest hundredth are air.
_LEAST_DENSITY = 0.1
_MOST_ITERATIONS = 200


def convex_hull(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and triangles (F, 3) of the convex hull of points (P, 3), counter-clockwise from outside.

    Raises:
        SettingError: the points lie in a plane, so they enclose nothing.
    """
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
        raise SettingError("the model is flat, so it has no body; choose one with some thickness.")
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
