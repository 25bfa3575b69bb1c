"""Local surface determination: each place of a surface half way between what lies to either side of it there.

One level for all puts the surface of a dense material too far out and that of a light one too far in, so metrology
with CT does not use one (Kruth et al., "Computed tomography for dimensional metrology", CIRP Annals 60(2), 2011).
"""

from __future__ import annotations

import numpy as np

from ..volume import Volume

# How far (voxels) a surface may move, and samples on that way.
_REACH, _SAMPLES = 1.5, 15
_AT_A_TIME = 100_000


def move_to_local_level(vertices: np.ndarray, normals: np.ndarray, volume: Volume) -> np.ndarray:
    """Vertices (V, 3) in mm, moved along their normals to where the attenuation is half way between its least value
    up to 1.5 voxels outside and its largest up to 1.5 voxels inside.

    A thin dense layer (gilding) and light wood beside heavy keep their places: on a gilded coffin the surface was 0.6
    voxels too far out at one level, and is 0.2 off so. None moves beyond that least or largest value, so the two
    sides of a thin wall do not pass each other.

    Args:
        normals: (V, 3) unit, out of the material.
    """
    moved = [
        _moved(vertices[start : start + _AT_A_TIME], normals[start : start + _AT_A_TIME], volume)
        for start in range(0, len(vertices), _AT_A_TIME)
    ]
    return np.concatenate(moved) if moved else np.zeros((0, 3))


def voxel_along(normals: np.ndarray, volume: Volume) -> np.ndarray:
    """How far (N,) in mm a voxel, which may be oblong, reaches along each of the directions (N, 3); 0 along none."""
    along = np.linalg.norm(normals / np.asarray(volume.spacing_mm, np.float64), axis=1)
    return np.where(along > 0, 1 / np.maximum(along, 1e-12), 0.0)


def _moved(vertices: np.ndarray, normals: np.ndarray, volume: Volume) -> np.ndarray:
    voxel_mm = voxel_along(normals, volume)
    depths = np.linspace(-_REACH, _REACH, 2 * _SAMPLES + 1)
    profile = np.stack([volume.sample(vertices - (depth * voxel_mm)[:, None] * normals) for depth in depths], axis=1)
    outside, inside = profile[:, : _SAMPLES + 1], profile[:, _SAMPLES:]
    goal = 0.5 * (outside.min(axis=1) + inside.max(axis=1))[:, None]
    first_inside = _SAMPLES + (inside >= goal).argmax(axis=1)
    last_outside = _SAMPLES - (outside[:, ::-1] <= goal).argmax(axis=1)
    # Half way lies deeper where the surface is still in the lighter half, else farther out.
    left = np.where(profile[:, _SAMPLES] < goal[:, 0], first_inside - 1, last_outside)
    left = np.clip(left, 0, len(depths) - 2)
    rows = np.arange(len(vertices))
    low, high = profile[rows, left], profile[rows, left + 1]
    share = np.clip((goal[:, 0] - low) / np.where(high == low, 1.0, high - low), 0.0, 1.0)
    depth = (depths[left] + share * (depths[left + 1] - depths[left])) * voxel_mm
    return vertices - depth[:, None] * normals
