"""`radiograph` in Warp: geometry in torch float64, pixels in float32."""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from ....views import Detector
from ..reference.radiograph import detector_pixels, detector_tensors
from .blocks import launch_blocks, pixels_of_a_thread, view
from .linear import split_pixels
from .radiograph_geometry import Rays, project
from .radiograph_raster import SUMS, Row, Sums, ray_kernels
from .sums import add_up
from .tiles import bin_boxes


def line_integrals(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    density: Tensor,
    detector: Detector,
    mode: str,
    cutoff_sigmas: float,
) -> Tensor:
    """(height, width) line integrals; see `core.render.radiograph`."""
    rays = project(means, quats, scales, density, detector, mode, cutoff_sigmas)
    image = _Integrate.apply(rays.numerator, rays.denominator, rays.amplitude, rays, detector, cutoff_sigmas**2)
    if rays.denominator is not None:
        # The pixels work with rays of their own length; see `radiograph_geometry`.
        source, center, u, v = detector_tensors(detector, rays.amplitude)
        length = (detector_pixels(detector, center, u, v) - source).norm(dim=-1)
        image = image * length.reshape(image.shape).to(image.dtype)
    return image.to(means.dtype)


class _Integrate(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        numerator: Tensor,
        denominator: Tensor | None,
        amplitude: Tensor,
        rays: Rays,
        detector: Detector,
        limit: float,
    ) -> Tensor:
        device = numerator.device
        tiles = bin_boxes(rays.boxes.int(), detector.width, detector.height)
        whole, rest = split_pixels(rays.reference)
        upper = rays.upper
        rows = [numerator[:, 0], numerator[:, 1, 1:], upper[:, 0], upper[:, 1, 1:], upper[:, 2, 2:], amplitude[:, None]]
        splats = (view(whole, wp.vec2i), view(rest, wp.vec2), view(torch.cat(rows, dim=1).float(), Row))
        size = (limit, detector.width, detector.height)
        pixels = pixels_of_a_thread(device)
        pairs = (view(tiles.starts), view(tiles.splats))
        image = torch.empty(detector.height, detector.width, device=device)
        inputs = [*pairs, *splats, *size, view(image)]
        launch_blocks(ray_kernels(pixels).integrate, tiles.count, pixels, inputs, device)
        ctx.save_for_backward(*([] if denominator is None else [denominator]))
        ctx.tiles, ctx.pixels, ctx.kept = tiles, pixels, (*pairs, view(tiles.slots), *splats, *size)
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Any:  # type: ignore[override]
        sums = torch.zeros(len(ctx.tiles.slots), SUMS, device=grad.device)
        inputs = [*ctx.kept, view(grad.float()), view(sums, Sums)]
        kernel = ray_kernels(ctx.pixels).integrate_backward
        launch_blocks(kernel, ctx.tiles.count, ctx.pixels, inputs, grad.device)
        totals = add_up(ctx.tiles.slot_starts, sums)
        to_numerator = -2 * totals[:, 1:7].reshape(-1, 2, 3)
        to_denominator = None
        if ctx.saved_tensors:
            (denominator,) = ctx.saved_tensors
            xx, xy, yy, x, y, one = totals[:, 7:].unbind(1)
            moments = torch.stack([xx, xy, x, xy, yy, y, x, y, one], dim=1).reshape(-1, 3, 3)
            to_denominator = 2 * denominator @ moments
        return to_numerator, to_denominator, totals[:, 0], None, None, None
