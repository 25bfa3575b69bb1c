"""Meshes against the true surfaces, outer and inner, and how their normals are spread."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import ndimage

from ..evaluate.histogram import normal_histogram, spherical_occupancy, total_variation
from ..mesh.surface import extract_mesh
from ..phantoms.truth import Surface
from ..threshold import air_threshold
from ..volume import Volume
from .nearest import distances_to
from .truth import Truth

if TYPE_CHECKING:
    import trimesh

BINS = (42, 242)
_SAMPLES = 10_000
_PATCHES = 8
_LEAST_FACES = 20


@dataclass(frozen=True, eq=False)
class Surfaces:
    """An object's true surfaces in mm.

    Attributes:
        outer: what the air around the object touches.
        inner: all others: walls of cavities, and parts inside of cavities; None where there are none.
        inner_left_out: share of the true inner area that is not in `inner`, see `facing_air`; None where surfaces were
            taken from voxels, and where there are none inside.
    """

    outer: trimesh.Trimesh
    inner: trimesh.Trimesh | None
    inner_left_out: float | None = None

    @property
    def whole(self) -> trimesh.Trimesh:
        import trimesh

        return self.outer if self.inner is None else trimesh.util.concatenate([self.outer, self.inner])


def surfaces_of(volume: Volume) -> Surfaces:
    """The surfaces of a volume, by marching cubes.

    A connected surface is outer when most of its area faces air that is connected to the border of the volume.

    Raises:
        SettingError: the volume has no surface.
    """
    import trimesh

    level = air_threshold(volume.values)
    mesh = extract_mesh(volume)
    air = np.pad(volume.values < level, 1, constant_values=True)
    regions, _ = ndimage.label(air)
    outside = regions == regions[0, 0, 0]
    before = mesh.triangles_center + 0.75 * float(np.min(volume.spacing_mm)) * mesh.face_normals
    index = np.rint((before - volume.origin_mm) / volume.spacing_mm).astype(np.int64)[:, ::-1] + 1
    index = np.clip(index, 0, np.array(outside.shape) - 1)
    faces_outside = outside[tuple(index.T)]
    parts = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(mesh.faces))
    area = np.bincount(parts, mesh.area_faces)
    share = np.bincount(parts, mesh.area_faces * faces_outside) / np.maximum(area, 1e-30)
    is_outer = (share > 0.5)[parts]
    outer = mesh.submesh([is_outer], append=True) if is_outer.any() else mesh
    inner = None if is_outer.all() or not is_outer.any() else mesh.submesh([~is_outer], append=True)
    return Surfaces(outer, inner)


def true_surfaces(truth: Truth) -> Surfaces | None:
    """The surfaces that a synthetic capture tells, those inside as far as they face air, else `surfaces_of`; all face
    away from the material.

    Returns:
        None where they are unknown, see `Truth.surface_unknown`.

    Raises:
        SettingError: a volume that surfaces have to be taken from has none.
    """
    import trimesh

    if truth.surface_unknown:
        return None
    if truth.outer is None:
        return surfaces_of(truth.volume)

    def mesh_of(surface: Surface) -> trimesh.Trimesh:
        return trimesh.Trimesh(surface.vertices.astype(np.float64), surface.faces, process=False)

    if truth.inner is None or len(truth.inner.faces) == 0:
        return Surfaces(mesh_of(truth.outer), None)
    return Surfaces(mesh_of(truth.outer), *facing_air(mesh_of(truth.inner), truth.volume))


def facing_air(surface: trimesh.Trimesh, volume: Volume) -> tuple[trimesh.Trimesh | None, float]:
    """The faces of a true surface that a volume's `air_threshold` lies between the two sides of, turned to the air.

    A mesh of what is not air has no surface where two materials meet. A phantom's cavity is a part of air, whose faces
    are turned to the material around it.

    Returns:
        Those faces, None if there are none; and the share of the surface's area that the others have.
    """
    import trimesh

    level = air_threshold(volume.values)
    # Half a voxel of either side is mixed; the wall may be a voxel thin.
    reach = 0.75 * float(np.min(volume.spacing_mm)) * surface.face_normals
    ahead, behind = (volume.sample(surface.triangles_center + side * reach) for side in (1, -1))
    kept = (np.minimum(ahead, behind) < level) & (np.maximum(ahead, behind) > level)
    area = surface.area_faces
    left_out = float(area[~kept].sum() / max(area.sum(), 1e-30))
    if not kept.any():
        return None, 1.0
    faces = np.where((ahead > behind)[:, None], surface.faces[:, ::-1], surface.faces)
    return trimesh.Trimesh(surface.vertices, faces, process=False).submesh([kept], append=True), left_out


def mesh_figures(mesh: trimesh.Trimesh, true: Surfaces, voxel_mm: float) -> dict[str, Any]:
    """How near a mesh in mm comes to the true surfaces, and the spread of its normals.

    Args:
        voxel_mm: length of a voxel, the unit of the figures that end in `_voxels`.

    Returns:
        `watertight`, `faces`; `outer` and `inner`, each with mean and 95th percentile in mm and voxels of the distance
        `from_truth` (true points to the mesh) and `to_truth` (the mesh's points to the truth, each counted with the
        true surface it is nearest to); `inner_found`, the share of the true inner surfaces within a voxel of the mesh,
        None where there are none; `normals` by number of bins: `occupancy` of the whole mesh, `patch_mean` and
        `patch_median` over the parts of the mesh in cubes of an eighth of its longest side, and the `total_variation`
        between its histogram and the true one.
    """
    rng = np.random.default_rng(23)
    points = sample(mesh, rng)
    inner = None if true.inner is None else distances(true.inner, points)
    outer = distances(true.outer, points)
    nearest_outer = np.ones(len(points), bool) if inner is None else outer <= inner
    figures: dict[str, Any] = {"watertight": bool(mesh.is_watertight), "faces": len(mesh.faces)}
    figures["outer"] = {
        "from_truth": _summary(distances(mesh, sample(true.outer, rng)), voxel_mm),
        "to_truth": _summary(outer[nearest_outer], voxel_mm),
    }
    figures |= {"inner": None, "inner_found": None}
    if true.inner is not None and inner is not None:
        missed = distances(mesh, sample(true.inner, rng))
        figures["inner"] = {
            "from_truth": _summary(missed, voxel_mm),
            "to_truth": _summary(inner[~nearest_outer], voxel_mm),
        }
        figures["inner_found"] = float((missed <= voxel_mm).mean())
    figures["normals"] = {str(bins): normals_of(mesh, bins, true.whole) for bins in BINS}
    return figures


def sample(mesh: trimesh.Trimesh, rng: np.random.Generator, count: int = _SAMPLES) -> np.ndarray:
    """(count, 3) points drawn evenly over a mesh's surface."""
    area = np.cumsum(mesh.area_faces)
    faces = np.searchsorted(area, rng.random(count) * area[-1])
    corners = mesh.triangles[np.minimum(faces, len(mesh.faces) - 1)]
    u, v = rng.random((2, count, 1))
    fold = u + v > 1
    u, v = np.where(fold, 1 - u, u), np.where(fold, 1 - v, v)
    return corners[:, 0] + u * (corners[:, 1] - corners[:, 0]) + v * (corners[:, 2] - corners[:, 0])


def distances(mesh: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """(N,) distance of points (N, 3) to the mesh's triangles."""
    return distances_to(mesh.triangles, points)


def _summary(distance: np.ndarray, voxel_mm: float) -> dict[str, float] | None:
    if len(distance) == 0:
        return None
    mean, high = float(distance.mean()), float(np.percentile(distance, 95))
    return {"mean_mm": mean, "p95_mm": high, "mean_voxels": mean / voxel_mm, "p95_voxels": high / voxel_mm}


def normals_of(mesh: trimesh.Trimesh, bins: int, true: trimesh.Trimesh | None = None) -> dict[str, Any]:
    """The spread of a mesh's normals: see `mesh_figures`; without `true` no distance to the true histogram."""
    found = normal_histogram(mesh.face_normals, bins, mesh.area_faces)
    patches = patch_occupancy(mesh, bins)
    figures: dict[str, Any] = {
        "occupancy": spherical_occupancy(found),
        "patch_mean": float(np.mean(patches)) if patches else None,
        "patch_median": float(np.median(patches)) if patches else None,
        "total_variation": None,
    }
    if true is not None:
        expected = normal_histogram(true.face_normals, bins, true.area_faces)
        figures["total_variation"] = total_variation(found, expected)
    return figures


def patch_occupancy(mesh: trimesh.Trimesh, bins: int) -> list[float]:
    """Spherical occupancy of the parts of a mesh in cubes of an eighth of its longest side; of 20 faces at least."""
    low, high = mesh.bounds
    side = float((high - low).max()) / _PATCHES or 1.0
    cells = np.clip(((mesh.triangles_center - low) / side).astype(np.int64), 0, _PATCHES - 1)
    _, part = np.unique(cells @ np.array([_PATCHES**2, _PATCHES, 1]), return_inverse=True)
    order = np.argsort(part, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(part[order])) + 1)
    normals, areas = mesh.face_normals, mesh.area_faces
    return [
        spherical_occupancy(normal_histogram(normals[group], bins, areas[group]))
        for group in groups
        if len(group) >= _LEAST_FACES and (areas[group] > 0).any()
    ]
