"""Poses of a camera that moves while it takes a photo."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ..gaussians import GaussianSet
from ..views import Camera

MOTION, MIDDLE = slice(0, 6), slice(6, 12)
"""Of a photo's numbers: the motion in all, then the change of the pose at its middle. Both turn first."""


def row_poses(world_to_camera: Any, numbers: Tensor, times: Tensor, extent: float) -> Tensor:
    """World to camera (T, 4, 4) at times 0..1 of a readout, float64; differentiable in the numbers.

    About the middle a readout turns at an even rate about one axis, which is the slerp of its ends, and moves
    straight.

    Args:
        world_to_camera: (4, 4) given pose, of the middle.
        numbers: (12,) turn in radians and shift in extents over the whole readout, then of the middle from the given
            pose, all in the camera's axes.
        times: (T,).
    """
    given = torch.as_tensor(world_to_camera).detach().to("cpu", torch.float64)
    since = (times.double() - 0.5)[:, None]
    (turn, shift), (turn_middle, shift_middle) = numbers[MOTION].split(3), numbers[MIDDLE].split(3)
    middle = given[:3, :3].T @ _rotations(turn_middle[None])[0]
    center = given[:3, :3].T @ (extent * shift_middle - given[:3, 3])
    rotations = (middle @ _rotations(since * turn)).transpose(1, 2)
    centers = center + (since * extent * shift) @ middle.T
    moved = -(rotations @ centers[:, :, None])
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).expand(len(since), 1, 4)
    return torch.cat([torch.cat([rotations, moved], dim=2), last], dim=1)


def _rotations(turns: Tensor) -> Tensor:
    """(T, 3, 3) of rotation vectors (T, 3) in radians."""
    x, y, z = turns.unbind(1)
    zero = torch.zeros_like(x)
    return torch.linalg.matrix_exp(torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).reshape(-1, 3, 3))


def farthest_way(gaussians: GaussianSet, cameras: Sequence[Camera]) -> float:
    """The farthest that a splat in view moves in pixels between two poses of a camera."""
    with torch.no_grad():
        (first, near), (last, also_near) = (_centers(gaussians, camera) for camera in cameras)
        size = torch.tensor([cameras[0].width, cameras[0].height], dtype=torch.float64)
        shown = (((first >= 0) & (first <= size)) | ((last >= 0) & (last <= size))).all(1) & ~near & ~also_near
        return float((last - first)[shown].norm(dim=1).max()) if bool(shown.any()) else 0.0


def _centers(gaussians: GaussianSet, camera: Camera) -> tuple[Tensor, Tensor]:
    """(N, 2) pixels of the splats' centres, and (N,) whether they are too near to be drawn."""
    pose = torch.as_tensor(camera.world_to_camera)
    local = gaussians.means.detach().to("cpu", torch.float64) @ pose[:3, :3].T + pose[:3, 3]
    depth = torch.ones_like(local[:, 2:]) if camera.orthographic else local[:, 2:]
    focal, principal = torch.tensor([camera.fx, camera.fy]), torch.tensor([camera.cx, camera.cy])
    return local[:, :2] / depth * focal + principal, local[:, 2] <= camera.near
