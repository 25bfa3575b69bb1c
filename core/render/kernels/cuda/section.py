"""`section` in Warp: geometry in float64, pixels in float32."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ....views import Plane
from ..reference.section import LEAST_WEIGHT
from .blocks import launch_blocks, pixels_of_a_thread, view
from .section_projection import project, project_backward, slab_of
from .section_raster import GEOMETRY_SUMS, Row, section_kernels
from .sums import add_up
from .tiles import bin_boxes


def density_on_plane(
    means: Tensor, quats: Tensor, scales: Tensor, density: Tensor, plane: Plane, cutoff_sigmas: float
) -> Tensor:
    """(height, width) Σ ρ·w; see `core.render.section`."""
    values = torch.ones_like(density[:, None])
    return _draw(means, quats, scales, density, values, plane, False, cutoff_sigmas)[..., 0]


def occupancy_on_plane(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, plane: Plane, cutoff_sigmas: float
) -> Tensor:
    """(height, width) 1 − Π(1 − o·w)."""
    values = torch.ones_like(opacities[:, None])
    return 1 - _draw(means, quats, scales, opacities, values, plane, True, cutoff_sigmas)[..., 0]


def color_on_plane(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    plane: Plane,
    cutoff_sigmas: float,
) -> Tensor:
    """(height, width, 3) Σ o·w·c / Σ o·w."""
    values = torch.cat([colors, torch.ones_like(colors[:, :1])], dim=-1)
    total = _draw(means, quats, scales, opacities, values, plane, False, cutoff_sigmas)
    return total[..., :3] / total[..., 3:].clamp(min=LEAST_WEIGHT)


def _draw(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    amount: Tensor,
    values: Tensor,
    plane: Plane,
    product: bool,
    cutoff_sigmas: float,
) -> Tensor:
    splats = [value.double() for value in (means, quats, scales, amount)]
    image = _Draw.apply(*splats, values.float(), plane, product, cutoff_sigmas)
    return image.to(means.dtype)


class _Draw(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        amount: Tensor,
        values: Tensor,
        plane: Plane,
        product: bool,
        cutoff: float,
    ) -> Tensor:
        device, channels = means.device, values.shape[1]
        parameters, slab = (means, quats, scales, amount), slab_of(plane, cutoff, ctx.needs_input_grad[3])
        cuts = project(parameters, slab)
        tiles = bin_boxes(cuts.boxes, plane.width, plane.height)
        pixels = pixels_of_a_thread(device)
        kernels = section_kernels(pixels, channels, product)
        splats = (*cuts.of_pixels(Row), view(values, kernels.channels))
        size = (cutoff, plane.width, plane.height)
        pairs = (view(tiles.starts), view(tiles.splats))
        image = torch.empty(plane.height, plane.width, channels, device=device)
        inputs = [*pairs, *splats, *size, view(image, kernels.channels)]
        launch_blocks(kernels.draw, tiles.count, pixels, inputs, device)
        ctx.save_for_backward(*parameters)
        ctx.slab, ctx.tiles, ctx.pixels, ctx.kernels = slab, tiles, pixels, kernels
        ctx.kept = (*pairs, view(tiles.slots), *splats, *size)
        ctx.empty = image.clone() if product else None
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Any:  # type: ignore[override]
        incoming = grad.float() if ctx.empty is None else -grad.float() * ctx.empty
        sums = torch.zeros(len(ctx.tiles.slots), GEOMETRY_SUMS + grad.shape[2], device=grad.device)
        inputs = [*ctx.kept, view(incoming, ctx.kernels.channels), view(sums, ctx.kernels.sums)]
        launch_blocks(ctx.kernels.draw_backward, ctx.tiles.count, ctx.pixels, inputs, grad.device)
        totals = add_up(ctx.tiles.slot_starts, sums)
        gradients = project_backward(ctx.saved_tensors, ctx.slab, ctx.tiles.slot_starts, totals)
        return (*gradients, totals[:, GEOMETRY_SUMS:].float(), None, None, None)
