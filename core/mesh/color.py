"""Vertex colours: the photos' near the surface they show, the density's below."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..colormap import density_colors
from ..gaussians import GaussianSet
from ..spherical_harmonics import C0
from ..volume import Volume

if TYPE_CHECKING:
    import trimesh

_LEAST_OPACITY = 0.1
_NEIGHBOURS = 6


def color_mesh(
    mesh: trimesh.Trimesh,
    rgb: GaussianSet | None,
    volume: Volume | None = None,
    near_mm: float | None = None,
) -> trimesh.Trimesh:
    """The mesh with a colour at each vertex.

    A vertex within `near_mm` of a visible RGB splat takes the mean colour of its nearest splats, weighted by
    opacity and nearness. Deeper ones take the colour of the attenuation behind the wall's face, or mid-grey
    without a volume, so that no outside colour is made up for the inside (the paper's k-NN paints it all).

    Args:
        mesh: vertices in mm in the world frame.
        rgb: splats of the photos, numpy, in the world frame; None when there are none.
        near_mm: when None, twice the median distance between neighbouring splats, or twice the median edge of the
            mesh if that is longer.
    """
    from scipy.spatial import cKDTree

    colors = _inner_colors(mesh, volume)
    visible = rgb.select(rgb.opacities > _LEAST_OPACITY) if rgb is not None else None
    if visible is not None and len(visible) > 0:
        centres = np.asarray(visible.means, np.float64)
        tree = cKDTree(centres)
        if near_mm is None:
            near_mm = 2.0 * max(_median_spacing(tree, centres), float(np.median(mesh.edges_unique_length)))
        count = min(_NEIGHBOURS, len(centres))
        distance, index = tree.query(mesh.vertices, k=count, distance_upper_bound=near_mm)
        distance, index = distance.reshape(-1, count), index.reshape(-1, count)
        found = np.isfinite(distance)
        index = np.where(found, index, 0)
        nearness = np.exp(-0.5 * (np.where(found, distance, 0) / max(0.4 * near_mm, 1e-9)) ** 2)
        weight = np.where(found, nearness * visible.opacities[index], 0.0)
        total = weight.sum(axis=1)
        own = np.clip(0.5 + C0 * np.asarray(visible.sh[:, 0], np.float64), 0, 1)
        painted = (weight[..., None] * own[index]).sum(axis=1) / np.maximum(total, 1e-12)[:, None]
        colors = np.where(total[:, None] > 0, painted, colors)
    colored = mesh.copy()
    rgba = np.column_stack([np.round(255 * colors), np.full(len(colors), 255)]).astype(np.uint8)
    colored.visual.vertex_colors = rgba
    return colored


def _inner_colors(mesh: trimesh.Trimesh, volume: Volume | None) -> np.ndarray:
    if volume is None:
        return np.full((len(mesh.vertices), 3), 0.6)
    behind = mesh.vertices - float(np.mean(volume.spacing_mm)) * mesh.vertex_normals
    return density_colors(volume.sample(behind), 0.0, float(np.percentile(volume.values, 99.9)))


def _median_spacing(tree: object, centres: np.ndarray) -> float:
    if len(centres) < 2:
        return 1.0
    # A sample is enough for a median.
    some = centres[:: max(len(centres) // 5000, 1)]
    return float(np.median(tree.query(some, k=2)[0][:, 1]))  # type: ignore[attr-defined]
