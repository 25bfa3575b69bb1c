"""The Warp splat renderer as a torch function: projection in torch float64, pixels in float32."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from ....gaussians import GaussianSet
from ....views import Camera
from ...splat import SplatInfo
from ..reference.splat import ALPHA_MIN, Projected, _info, project, view_colors
from .blocks import launch_blocks, pixels_of_a_thread, view
from .splat_raster import SUMS, Sums, blend_kernels
from .sums import add_up
from .tiles import bin_ellipses

# Added to a splat's reach where tiles are chosen, so that rounding never leaves a pixel out.
_SLACK = 1e-3
_FARTHEST_PIXEL = 1 << 30


def render(
    gaussians: GaussianSet, camera: Camera, background: Any, degree: int, low_pass: float
) -> tuple[Tensor, Tensor, Tensor, SplatInfo]:
    """Colour (H, W, 3), alpha (H, W), depth (H, W) and info; see `core.render.splat`."""
    means = gaussians.means
    shaped = {name: getattr(gaussians, name).double() for name in ("means", "quats", "scales", "opacities")}
    gaussians = replace(gaussians, sh=gaussians.sh[:, : (degree + 1) ** 2], **shaped)
    pose = torch.as_tensor(camera.world_to_camera).to(gaussians.means)
    projected = project(gaussians, camera, pose, low_pass=low_pass)
    chosen = projected.index
    sh = gaussians.sh[chosen].float()
    colors = view_colors(means[chosen].float(), sh, camera, pose.float(), degree)
    opacities = gaussians.opacities[chosen]

    info = _info(projected, opacities, camera, len(gaussians))
    info.radii_px = info.radii_px.clamp_max(torch.finfo(torch.float32).max).float()
    if projected.centers.requires_grad:
        projected.centers.register_hook(lambda grad: _keep_screen_grad(info, chosen, grad))

    back = torch.zeros(3) if background is None else torch.as_tensor(background)
    features = torch.cat([colors, projected.z[:, None].float()], dim=1)
    color, alpha, depth = _Blend.apply(
        projected.centers,
        projected.factors,
        opacities,
        features,
        back.to(means.device, torch.float32),
        projected,
        camera,
    )
    return color, alpha, depth, info


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        centers: Tensor,
        factors: Tensor,
        opacities: Tensor,
        features: Tensor,
        background: Tensor,
        projected: Projected,
        camera: Camera,
    ) -> tuple[Tensor, Tensor, Tensor]:
        shapes = torch.cat([factors, opacities[:, None]], dim=1).float()
        drawable = (torch.cat([shapes, features], dim=1)).isfinite().all(1)
        reach = torch.sqrt(2 * torch.log(opacities / ALPHA_MIN).clamp_min(0)) + _SLACK
        tiles = bin_ellipses(centers, factors, torch.where(drawable, reach, 0.0), camera.width, camera.height)
        # Pixel (row i, column j) has its centre at j + 0.5.
        whole = (centers - 0.5).round().clamp(-_FARTHEST_PIXEL, _FARTHEST_PIXEL)
        splats = (
            view(whole.int(), wp.vec2i), view(((centers - 0.5) - whole).float(), wp.vec2),
            view(shapes, wp.vec4), view(features, wp.vec4),
        )  # fmt: skip
        device = centers.device
        color = torch.empty(camera.height, camera.width, 3, device=device)
        alpha, depth = torch.empty_like(color[..., 0]), torch.empty_like(color[..., 0])
        blended = torch.zeros(tiles.count, dtype=torch.int32, device=device)
        size = (camera.width, camera.height)
        images = (view(color, wp.vec3), view(alpha), view(depth), view(blended))
        pixels = pixels_of_a_thread(device)
        pairs = (view(tiles.starts), view(tiles.splats))
        inputs = [*pairs, *splats, view(background[None], wp.vec3), *size, *images]
        launch_blocks(blend_kernels(pixels).blend, tiles.count, pixels, inputs, device)
        ctx.save_for_backward(factors, opacities)
        ctx.tiles, ctx.pixels, ctx.kept = tiles, pixels, (*pairs, view(tiles.slots), *splats, *size, *images)
        # Copies, because the caller may change what it gets in place before calling backward.
        return color.clone(), alpha.clone(), depth.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> Any:  # type: ignore[override]
        to_color, to_alpha, to_depth = (grad.float() for grad in grads)
        factors, opacities = ctx.saved_tensors
        sums = torch.zeros(len(ctx.tiles.slots), SUMS, device=factors.device)
        of_images = (view(to_color, wp.vec3), view(to_alpha), view(to_depth))
        inputs = [*ctx.kept, *of_images, view(sums, Sums)]
        launch_blocks(blend_kernels(ctx.pixels).blend_backward, ctx.tiles.count, ctx.pixels, inputs, factors.device)
        totals = add_up(ctx.tiles.slot_starts, sums)
        l1, k, l2 = factors.unbind(1)
        h, hp, hq, hpp, hpq, hqq = totals[:, :6].unbind(1)
        # log α = log o − ½ (p² + q²) with p = l1·dx + k·dy and q = l2·dy.
        to_centers = torch.stack([l1 * hp, k * hp + l2 * hq], dim=1)
        to_factors = -torch.stack([(hpp - k / l2 * hpq) / l1, hpq / l2, hqq / l2], dim=1)
        return to_centers, to_factors, h / opacities, totals[:, 6:].float(), None, None, None


def _keep_screen_grad(info: SplatInfo, index: Tensor, grad: Tensor) -> None:
    info.screen_grad = torch.zeros(len(info.visible), 2, device=grad.device)
    info.screen_grad[index] = grad.detach().float()
