"""The Numba splat renderer as a torch function: float32, on the processor, the same bits on any number of threads."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ....gaussians import GaussianSet
from ....views import Camera
from ...splat import SplatInfo
from .splat_geometry import pack_view
from .splat_project import project, project_backward
from .splat_raster import DEPTH, L1, SUMS, rasterize, rasterize_backward
from .tiles import bin_ellipses, depth_order, pairs_of_slots


def render(
    gaussians: GaussianSet, camera: Camera, background: Any, degree: int, low_pass: float, mip_filter: bool
) -> tuple[Tensor, Tensor, Tensor, SplatInfo]:
    """Colour (H, W, 3), alpha (H, W), depth (H, W) and info; see `core.render.splat`."""
    fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    parameters = [field.to(device="cpu", dtype=torch.float32) for field in fields]
    pose = torch.as_tensor(camera.world_to_camera).to(device="cpu", dtype=torch.float64)
    back = torch.zeros(3) if background is None else torch.as_tensor(background, dtype=torch.float32)
    info = SplatInfo(None, None)
    color, alpha, depth = _Splat.apply(*parameters, pose, camera, back, degree, low_pass, mip_filter, info)
    device = gaussians.means.device
    return color.to(device), alpha.to(device), depth.to(device), info


class _Splat(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        sh: Tensor,
        pose: Tensor,
        camera: Camera,
        background: Tensor,
        degree: int,
        low_pass: float,
        mip_filter: bool,
        info: SplatInfo,
    ) -> tuple[Tensor, Tensor, Tensor]:
        arrays = tuple(_array(part) for part in (means, quats, scales, opacities, sh))
        view = pack_view(camera, pose.detach().numpy(), low_pass, mip_filter)
        centers, attributes, reach, radii = project(*arrays, view, degree)
        visible = reach > 0
        order = depth_order(np.ascontiguousarray(attributes[:, DEPTH]), visible)
        tiles = bin_ellipses(centers, attributes[:, L1:], reach, order, camera.width, camera.height)
        color = np.empty((camera.height, camera.width, 3), np.float32)
        alpha = np.empty((camera.height, camera.width), np.float32)
        depth, blended = rasterize(tiles.starts, tiles.splats, attributes, _array(background), color, alpha)
        info.visible, info.radii_px = torch.from_numpy(visible), torch.from_numpy(radii)
        ctx.info, ctx.pose_shape = info, pose.shape
        ctx.save_for_backward(means, quats, scales, opacities, sh)
        ctx.set_materialize_grads(False)
        ctx.view = (view, degree)
        ctx.tiles = tiles
        ctx.blending = (blended, attributes, color, alpha, depth)
        # Copies, because the caller may change what it gets in place before calling backward.
        return tuple(torch.from_numpy(image.copy()) for image in (color, alpha, depth))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> Any:  # type: ignore[override]
        tiles = ctx.tiles
        sums = np.zeros((len(tiles.splats), SUMS), np.float32)
        images = ctx.blending[2:]
        # By numpy: torch wakes its threads for an image of zeros, which takes longer than to fill it.
        given = [
            np.zeros_like(image) if grad is None else _array(grad) for grad, image in zip(grads, images, strict=True)
        ]
        rasterize_backward(tiles.starts, tiles.splats, *ctx.blending, *given, sums)
        # Written tile by tile and read splat by splat: reads may wait for memory side by side, writes cannot.
        pairs = pairs_of_slots(tiles.slots)
        arrays = (_array(part) for part in ctx.saved_tensors)
        *gradients, pose, screen = project_backward(*arrays, *ctx.view, sums, pairs, tiles.slot_starts)
        ctx.info.screen_grad = torch.from_numpy(screen)
        to_pose = None
        if ctx.needs_input_grad[5]:
            to_pose = torch.zeros(ctx.pose_shape, dtype=torch.float64)
            to_pose[:3] = torch.from_numpy(pose)
        return (*(torch.from_numpy(gradient) for gradient in gradients), to_pose, None, None, None, None, None, None)


def _array(tensor: Tensor) -> np.ndarray:
    return np.ascontiguousarray(tensor.detach().numpy(), np.float32)
