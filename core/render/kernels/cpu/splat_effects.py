"""`splat` for splats that are masked or integrated over pixels, as a torch function; see `cpu.splat` for the plain one.

The same bits on any number of threads.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ....gaussians import GaussianSet
from ....views import Camera
from ...splat import SplatInfo
from . import splat_effects_project as integrated
from . import splat_project as plain
from .splat import _array
from .splat_effects_raster import SHAPES, rasterize, rasterize_backward
from .splat_geometry import pack_view
from .splat_raster import DEPTH, L1, SUMS
from .tiles import bin_ellipses, depth_order, pairs_of_slots


def render(
    gaussians: GaussianSet,
    camera: Camera,
    background: Any,
    degree: int,
    masks: Tensor | None,
    pixel_integration: bool,
    low_pass: float,
    mip_filter: bool,
) -> tuple[Tensor, Tensor, Tensor, SplatInfo]:
    """Colour (H, W, 3), alpha (H, W), depth (H, W) and info; see `core.render.splat`."""
    fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    kept = torch.ones(len(gaussians)) if masks is None else masks
    parameters = [field.to(device="cpu", dtype=torch.float32) for field in (*fields, kept)]
    pose = torch.as_tensor(camera.world_to_camera).to(device="cpu", dtype=torch.float64)
    back = torch.zeros(3) if background is None else torch.as_tensor(background, dtype=torch.float32)
    info = SplatInfo(None, None)
    options = (pixel_integration, low_pass, mip_filter)
    color, alpha, depth = _Splat.apply(*parameters, pose, camera, back, degree, info, *options)
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
        masks: Tensor,
        pose: Tensor,
        camera: Camera,
        background: Tensor,
        degree: int,
        info: SplatInfo,
        pixel_integration: bool,
        low_pass: float,
        mip_filter: bool,
    ) -> tuple[Tensor, Tensor, Tensor]:
        arrays = tuple(_array(part) for part in (means, quats, scales, opacities, sh))
        view = pack_view(camera, pose.detach().numpy(), low_pass, mip_filter)
        if pixel_integration:
            centers, attributes, shapes, reach, radii = integrated.project(*arrays, view, degree)
        else:
            centers, attributes, reach, radii = plain.project(*arrays, view, degree)
            shapes = np.zeros((0, SHAPES), np.float32)
        visible = reach > 0
        order = depth_order(np.ascontiguousarray(attributes[:, DEPTH]), visible)
        tiles = bin_ellipses(centers, attributes[:, L1:], reach, order, camera.width, camera.height)
        color = np.empty((camera.height, camera.width, 3), np.float32)
        alpha = np.empty((camera.height, camera.width), np.float32)
        tables = attributes, shapes, _array(masks)
        depth, blended = rasterize(tiles.starts, tiles.splats, *tables, _array(background), color, alpha)
        info.visible, info.radii_px = torch.from_numpy(visible), torch.from_numpy(radii)
        ctx.info, ctx.pose_shape = info, pose.shape
        ctx.save_for_backward(means, quats, scales, opacities, sh)
        ctx.set_materialize_grads(False)
        ctx.view, ctx.tiles = (view, degree), tiles
        ctx.project_backward = (integrated if pixel_integration else plain).project_backward
        ctx.blending = (blended, *tables, color, alpha, depth)
        # Copies, because the caller may change what it gets in place before calling backward.
        return tuple(torch.from_numpy(image.copy()) for image in (color, alpha, depth))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> Any:  # type: ignore[override]
        tiles, pairs = ctx.tiles, len(ctx.tiles.splats)
        sums, mask_sums = np.zeros((pairs, SUMS), np.float32), np.zeros(pairs, np.float32)
        given = [
            np.zeros_like(image) if grad is None else _array(grad)
            for grad, image in zip(grads, ctx.blending[4:], strict=True)
        ]
        rasterize_backward(tiles.starts, tiles.splats, *ctx.blending, *given, sums, mask_sums)
        arrays = tuple(_array(part) for part in ctx.saved_tensors)
        *gradients, pose, screen = ctx.project_backward(
            *arrays, *ctx.view, sums, pairs_of_slots(tiles.slots), tiles.slot_starts
        )
        # `bincount` adds in float64, one pair after the other.
        to_masks = np.bincount(tiles.splats, mask_sums, len(arrays[0])).astype(np.float32)
        ctx.info.screen_grad = torch.from_numpy(screen)
        to_pose = None
        if ctx.needs_input_grad[6]:
            to_pose = torch.zeros(ctx.pose_shape, dtype=torch.float64)
            to_pose[:3] = torch.from_numpy(pose)
        found = (torch.from_numpy(gradient) for gradient in (*gradients, to_masks))
        return (*found, to_pose, None, None, None, None, None, None, None)
