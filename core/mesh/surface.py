"""Isosurfaces of an attenuation volume, inner ones kept."""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from ..errors import SettingError
from ..threshold import air_threshold
from ..volume import Volume
from .local_level import move_to_local_level

if TYPE_CHECKING:
    import trimesh

# What encloses less than a voxel is noise; pores of four are real, and who looks for pores wants them.
_SMALLEST_VOXELS = 1.0


def extract_mesh(
    volume: Volume, level_mm_inv: float | None = None, smallest_mm3: float | None = None
) -> trimesh.Trimesh:
    """All surfaces between air and material, outer and inner, by marching cubes.

    Without a level it is `air_threshold` that decides what is air, and then each vertex moves to where the attenuation
    is half way between air and the material that is there (`move_to_local_level`). The mesh is closed, also where
    material reaches the volume's border. Normals point out of the material, so the walls of a cavity face into the
    cavity, and the enclosed volume is that of the material.

    Args:
        volume: attenuation in mm⁻¹.
        level_mm_inv: a level in mm⁻¹ that all of the surface is to lie at.
        smallest_mm3: surfaces that enclose less (islands or bubbles of noise) are dropped; a voxel when None.

    Returns:
        Vertices in mm in the world frame.

    Raises:
        SettingError: nothing in the volume lies on either side of the level, or the volume is constant.
    """
    import trimesh
    from skimage.measure import marching_cubes

    values = np.nan_to_num(volume.values, nan=0.0, posinf=0.0, neginf=0.0)
    level = air_threshold(values) if level_mm_inv is None else float(level_mm_inv)
    if not np.isfinite(level):
        raise SettingError("the volume is the same everywhere, so it has no surface; check the projections.")
    if not values.min() < level < values.max():
        raise SettingError(
            "no surface at {level:g} mm⁻¹: the volume's values go from {lowest:.4g} to {highest:.4g} mm⁻¹; "
            "choose a level between them.",
            level=level,
            lowest=values.min(),
            highest=values.max(),
        )
    # A node exactly on the level makes zero-area triangles; a hair above it does not.
    values = np.where(values == level, np.nextafter(np.float32(level), np.float32(np.inf)), values)
    padded = _closed(values, level)
    spacing = np.asarray(volume.spacing_mm, np.float64)
    corners, faces, _, _ = marching_cubes(padded, level, spacing=tuple(spacing[::-1]), gradient_direction="descent")
    vertices = corners[:, ::-1].astype(np.float64) + (np.asarray(volume.origin_mm) - spacing)
    faces = _without_empty_pockets(faces)
    smallest = _SMALLEST_VOXELS * float(np.prod(spacing)) if smallest_mm3 is None else smallest_mm3
    kept = _without_specks(vertices, faces, smallest)
    if len(kept) == 0:
        raise SettingError(
            "every surface at {level:g} mm⁻¹ is smaller than {smallest:g} mm³; lower smallest_mm3.",
            level=level,
            smallest=smallest,
        )
    mesh = trimesh.Trimesh(vertices, kept, process=False)
    mesh.remove_unreferenced_vertices()
    if level_mm_inv is None:
        # FDK undershoots beside metal; air is not less than nothing.
        least_air = Volume(np.maximum(values, 0.0), volume.spacing_mm, volume.origin_mm)
        mesh.vertices = move_to_local_level(np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals), least_air)
    return mesh


def _closed(values: np.ndarray, level: float) -> np.ndarray:
    """The values in a frame that mirrors them at the level: material that reaches the border ends at the faces of its
    last voxels."""
    padded = np.pad(values, 1, mode="edge")
    frame = np.ones(padded.shape, bool)
    frame[1:-1, 1:-1, 1:-1] = False
    padded[frame] = np.minimum(padded[frame], 2 * level - padded[frame])
    return padded


def _without_empty_pockets(faces: np.ndarray) -> np.ndarray:
    """The faces without pockets that enclose nothing.

    Where both cells beside an ambiguous face of the grid close it, each with two triangles over another diagonal, the
    four lie in one plane, and two of their edges have two faces too many: the mesh would not be closed. That is rare:
    once in one of ten meshes of some 500,000 triangles.
    """
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2).astype(np.int64)
    codes = edges[..., 0] << 32 | edges[..., 1]
    distinct, counts = np.unique(codes, return_counts=True)
    crowded = distinct[counts == 4]
    if not len(crowded):
        return faces
    beside: dict[int, list[int]] = {int(code): [] for code in crowded}
    for face, corner in np.argwhere(np.isin(codes, crowded)).tolist():
        beside[int(codes[face, corner])].append(face)
    pockets: set[int] = set()
    for code, around in beside.items():
        ends = {code >> 32, code & 0xFFFFFFFF}
        third = sorted(set(faces[around].ravel().tolist()) - ends)
        for opposite in (low << 32 | high for low, high in combinations(third, 2)):
            # A face of the pocket is at one of the two edges, with a corner of the other.
            four = ends | {opposite >> 32, opposite & 0xFFFFFFFF}
            near = {face for face in around + beside.get(opposite, []) if four.issuperset(faces[face].tolist())}
            if len(near) == 4:
                pockets |= near
    return np.delete(faces, sorted(pockets), axis=0)


def _without_specks(vertices: np.ndarray, faces: np.ndarray, smallest_mm3: float) -> np.ndarray:
    """The faces of connected surfaces that enclose at least `smallest_mm3`."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    links = coo_matrix((np.ones(len(edges), bool), (edges[:, 0], edges[:, 1])), shape=(len(vertices),) * 2)
    count, label = connected_components(links, directed=False)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    enclosed = np.bincount(label[faces[:, 0]], np.einsum("ij,ij->i", a, np.cross(b, c)) / 6, count)
    return faces[np.abs(enclosed)[label[faces[:, 0]]] >= smallest_mm3]
