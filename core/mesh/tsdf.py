"""Depth maps fused into a truncated signed distance field (Curless and Levoy, SIGGRAPH 1996), and its surface."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..compiled import njit, prange
from ..threads import loops_only, wait_without_spinning
from ..views import Camera

if TYPE_CHECKING:
    import trimesh

wait_without_spinning()

_LEAST_SHARE = 0.01


class TsdfGrid:
    """A box of voxels that depth maps are averaged into.

    Args:
        low: (3,) the box's lowest corner.
        high: (3,) its highest corner.
        voxel: side of a voxel, in the same unit.
        truncation: signed distances are cut at ± this; what lies deeper behind a surface is not touched by its view.
    """

    def __init__(self, low: np.ndarray, high: np.ndarray, voxel: float, truncation: float) -> None:
        self.low, self.voxel, self.truncation = np.asarray(low, np.float64), float(voxel), float(truncation)
        nx, ny, nz = np.maximum(np.ceil((np.asarray(high) - self.low) / voxel).astype(int) + 1, 2)
        self.distance = np.zeros((nz, ny, nx), np.float32)
        self.weight = np.zeros((nz, ny, nx), np.float32)
        self.color = np.zeros((nz, ny, nx, 3), np.float32)

    def integrate(self, camera: Camera, depth: np.ndarray, color: np.ndarray) -> None:
        """Averages one view in.

        Args:
            camera: perspective.
            depth: (H, W) camera z; 0 where nothing is known.
            color: (H, W, 3) in 0..1.
        """
        intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float64)
        _integrate(
            self.distance,
            self.weight,
            self.color,
            self.low,
            self.voxel,
            self.truncation,
            np.asarray(camera.world_to_camera, np.float64),
            intrinsics,
            np.ascontiguousarray(depth, np.float32),
            np.ascontiguousarray(color, np.float32),
        )

    def mesh(self) -> trimesh.Trimesh:
        """The surface where the averaged distance is zero and all corners of a cell were seen, with vertex colours.

        Parts of under 1 % of the faces are dropped. Empty when there is no surface.
        """
        import trimesh
        from skimage.measure import marching_cubes

        seen = self.weight > 0
        known = self.distance[seen]
        if known.size == 0 or not known.min() < 0 < known.max():
            return trimesh.Trimesh()
        try:
            corners, faces, _, _ = marching_cubes(
                self.distance, 0.0, mask=_whole_cells(seen), gradient_direction="ascent"
            )
        except (ValueError, RuntimeError):
            # Both signs occur, but never side by side.
            return trimesh.Trimesh()
        index = np.clip(np.rint(corners).astype(int), 0, np.array(seen.shape) - 1)
        colors = np.clip(255 * self.color[tuple(index.T)], 0, 255).astype(np.uint8)
        vertices = self.low + self.voxel * corners[:, ::-1].astype(np.float64)
        mesh = trimesh.Trimesh(vertices, faces, vertex_colors=colors, process=False)
        return _largest(mesh)


def _whole_cells(seen: np.ndarray) -> np.ndarray:
    """Cells whose eight corners were all seen, each marked at its highest corner as scikit-image wants it."""
    whole = np.zeros(seen.shape, bool)
    both = seen[1:] & seen[:-1]
    both = both[:, 1:] & both[:, :-1]
    whole[1:, 1:, 1:] = both[:, :, 1:] & both[:, :, :-1]
    return whole


def _largest(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    import trimesh

    labels = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(mesh.faces))
    count = np.bincount(labels)
    mesh.update_faces(count[labels] >= _LEAST_SHARE * len(mesh.faces))
    mesh.remove_unreferenced_vertices()
    return mesh


@njit(parallel=loops_only(), cache=True, error_model="numpy")
def _integrate(
    distance: Any,
    weight: Any,
    color: Any,
    low: Any,
    voxel: Any,
    truncation: Any,
    world_to_camera: Any,
    intrinsics: Any,
    depth: Any,
    pixels: Any,
) -> None:
    nz, ny, nx = distance.shape
    height, width = depth.shape
    m = world_to_camera
    for k in prange(nz):
        for j in range(ny):
            for i in range(nx):
                x, y, z = low[0] + i * voxel, low[1] + j * voxel, low[2] + k * voxel
                deep = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
                if deep <= 0:
                    continue
                across = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]
                down = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]
                column = int(np.floor(intrinsics[0] * across / deep + intrinsics[2]))
                row = int(np.floor(intrinsics[1] * down / deep + intrinsics[3]))
                if column < 0 or row < 0 or column >= width or row >= height or depth[row, column] <= 0:
                    continue
                signed = depth[row, column] - deep
                if signed < -truncation:
                    continue
                before = weight[k, j, i]
                value = min(1.0, signed / truncation)
                distance[k, j, i] = (distance[k, j, i] * before + value) / (before + 1)
                for channel in range(3):
                    old = color[k, j, i, channel]
                    color[k, j, i, channel] = (old * before + pixels[row, column, channel]) / (before + 1)
                weight[k, j, i] = before + 1
