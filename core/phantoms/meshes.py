"""Triangle meshes of tabulated distances."""

from __future__ import annotations

import numpy as np
from skimage.measure import marching_cubes

from .distance_grid import DistanceGrid


def surface_mesh(grid: DistanceGrid) -> tuple[np.ndarray, np.ndarray]:
    """Where the distance is zero: vertices (V, 3) float32 in mm and faces (F, 3) int32, seen from outside
    counterclockwise; none of either where the grid holds no solid."""
    if not grid.values.min() < 0 < grid.values.max():
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)
    vertices, faces, _, _ = marching_cubes(grid.values, 0.0, spacing=(grid.spacing,) * 3)
    return (vertices[:, ::-1] + grid.origin).astype(np.float32), faces[:, ::-1].astype(np.int32)
