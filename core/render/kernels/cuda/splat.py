"""The Warp splat renderer as a torch function: projection in float64, pixels in float32."""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from ....gaussians import GaussianSet
from ....views import Camera
from ...splat import SplatInfo
from .blocks import launch_blocks, moved, pixels_of_a_thread, view
from .splat_projection import lens_of, project, project_backward
from .splat_raster import SUMS, Sums, blend_kernels
from .sums import add_up
from .tiles import bin_ellipses


def render(
    gaussians: GaussianSet, camera: Camera, background: Any, degree: int, low_pass: float, mip_filter: bool
) -> tuple[Tensor, Tensor, Tensor, SplatInfo]:
    """Colour (H, W, 3), alpha (H, W), depth (H, W) and info; see `core.render.splat`."""
    device = gaussians.means.device
    shaped = [getattr(gaussians, name).double() for name in ("means", "quats", "scales", "opacities")]
    pose = moved(torch.as_tensor(camera.world_to_camera), device, torch.float64)
    back = torch.zeros(3, device=device) if background is None else torch.as_tensor(background)
    info = SplatInfo(None, None)
    parameters = (*shaped, gaussians.sh.float(), pose, moved(back, device, torch.float32))
    color, alpha, depth = _Splat.apply(*parameters, camera, degree, low_pass, mip_filter, info)
    return color, alpha, depth, info


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
        background: Tensor,
        camera: Camera,
        degree: int,
        low_pass: float,
        mip_filter: bool,
        info: SplatInfo,
    ) -> tuple[Tensor, Tensor, Tensor]:
        device, size = means.device, (camera.width, camera.height)
        parameters = (means, quats, scales, opacities, sh, pose)
        lens = lens_of(camera, low_pass, mip_filter)
        projected = project(parameters, lens, degree)
        info.visible, info.radii_px = projected.visible, projected.radii
        order = torch.sort(projected.depths, stable=True).indices
        tiles = bin_ellipses(projected.centers, projected.factors, projected.reach, order, *size)
        splats = projected.of_pixels()
        color = torch.empty(camera.height, camera.width, 3, device=device)
        alpha, depth = torch.empty_like(color[..., 0]), torch.empty_like(color[..., 0])
        blended = torch.zeros(tiles.count, dtype=torch.int32, device=device)
        images = (view(color, wp.vec3), view(alpha), view(depth), view(blended))
        pixels = pixels_of_a_thread(device)
        pairs = (view(tiles.starts), view(tiles.splats))
        inputs = [*pairs, *splats, view(background[None], wp.vec3), *size, *images]
        launch_blocks(blend_kernels(pixels).blend, tiles.count, pixels, inputs, device)
        ctx.save_for_backward(*parameters)
        ctx.projection, ctx.order = (lens, degree), order
        ctx.tiles, ctx.pixels, ctx.info = tiles, pixels, info
        ctx.kept = (*pairs, view(tiles.slots), *splats, *size, *images)
        # Copies, because the caller may change what it gets in place before calling backward.
        return color.clone(), alpha.clone(), depth.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> Any:  # type: ignore[override]
        to_color, to_alpha, to_depth = (grad.float() for grad in grads)
        (lens, degree), tiles, device = ctx.projection, ctx.tiles, to_color.device
        sums = torch.zeros(len(tiles.slots), SUMS, device=device)
        of_images = (view(to_color, wp.vec3), view(to_alpha), view(to_depth))
        inputs = [*ctx.kept, *of_images, view(sums, Sums)]
        launch_blocks(blend_kernels(ctx.pixels).blend_backward, tiles.count, ctx.pixels, inputs, device)
        totals = add_up(tiles.slot_starts, sums)
        want_pose = ctx.needs_input_grad[5]
        gradients, to_centers = project_backward(
            ctx.saved_tensors, lens, degree, ctx.order, tiles.slot_starts, totals, want_pose
        )
        # Where the rest of what is known of the splats has been taken.
        ctx.info.screen_grad = to_centers.to(ctx.info.visible.device)
        return (*gradients, *([] if want_pose else [None]), None, None, None, None, None, None)
