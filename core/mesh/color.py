"""Vertex colours: the photos' near the surface they show, the density's below."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..colormap import density_colors
from ..gaussians import GaussianSet
from ..rotations import quats_to_matrices
from ..spherical_harmonics import C0
from ..threshold import large_attenuation
from ..volume import Volume
from .local_level import voxel_along

if TYPE_CHECKING:
    import trimesh

_LEAST_OPACITY = 0.1
_NEIGHBOURS = 64
# Splats are taken to be at least this thick, in edges of the mesh: their sheet and the mesh differ by about that.
_THICKNESS = 0.4
# A vertex is painted where the splats' opacities there, by their Gaussians, add up to this.
_LEAST_COVER = 0.02
_CHUNK = 20_000


def color_mesh(
    mesh: trimesh.Trimesh,
    rgb: GaussianSet | None,
    volume: Volume | None = None,
    thickness_mm: float | None = None,
) -> trimesh.Trimesh:
    """The mesh with a colour at each vertex.

    A vertex that visible RGB splats cover takes their mean colour, weighted by opacity and by their Gaussians there: a
    large splat on an even patch paints as far as it reaches. Deeper ones take the colour of the attenuation behind the
    wall's face, or mid-grey without a volume, so that no outside colour is made up for the inside (the paper's k-NN
    paints it all).

    Args:
        mesh: vertices in mm in the world frame.
        rgb: splats of the photos, numpy, in the world frame; None when there are none.
        thickness_mm: least standard deviation of splats along each axis; when None, 0.4 of the mesh's median edge.
    """
    colors = _inner_colors(mesh, volume)
    visible = rgb.select(rgb.opacities > _LEAST_OPACITY) if rgb is not None else None
    if visible is not None and len(visible) > 0:
        if thickness_mm is None:
            thickness_mm = _THICKNESS * float(np.median(mesh.edges_unique_length))
        painted, cover = _paint(np.asarray(mesh.vertices, np.float64), visible, thickness_mm)
        colors = np.where(cover[:, None] > _LEAST_COVER, painted, colors)
    colored = mesh.copy()
    rgba = np.column_stack([np.round(255 * colors), np.full(len(colors), 255)]).astype(np.uint8)
    colored.visual.vertex_colors = rgba
    return colored


def _paint(points: np.ndarray, splats: GaussianSet, thickness_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean colours (N, 3) of the splats at points (N, 3), and the sums of opacities (N,) that they are weighted by."""
    from scipy.spatial import cKDTree

    centers = np.asarray(splats.means, np.float64)
    scales = np.maximum(np.asarray(splats.scales, np.float64), max(thickness_mm, 1e-9))
    whiten = quats_to_matrices(np.asarray(splats.quats, np.float64)).swapaxes(1, 2) / scales[:, :, None]
    own = np.clip(0.5 + C0 * np.asarray(splats.sh[:, 0], np.float64), 0, 1)
    opacities = np.asarray(splats.opacities, np.float64)
    tree, count = cKDTree(centers), min(_NEIGHBOURS, len(centers))
    painted, cover = np.zeros((len(points), 3)), np.zeros(len(points))
    for first in range(0, len(points), _CHUNK):
        part = points[first : first + _CHUNK]
        index = tree.query(part, k=count)[1].reshape(-1, count)
        apart = np.einsum("nkij,nkj->nki", whiten[index], part[:, None] - centers[index])
        weight = opacities[index] * np.exp(-0.5 * (apart**2).sum(axis=-1))
        total = weight.sum(axis=1)
        cover[first : first + _CHUNK] = total
        mean = (weight[..., None] * own[index]).sum(axis=1) / np.maximum(total, 1e-12)[:, None]
        painted[first : first + _CHUNK] = mean
    return painted, cover


def _inner_colors(mesh: trimesh.Trimesh, volume: Volume | None) -> np.ndarray:
    if volume is None:
        return np.full((len(mesh.vertices), 3), 0.6)
    behind = mesh.vertices - voxel_along(mesh.vertex_normals, volume)[:, None] * mesh.vertex_normals
    return density_colors(volume.sample(behind), 0.0, large_attenuation(volume.values))
