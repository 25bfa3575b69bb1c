"""`radiograph` in Warp: geometry in float64, pixels in float32."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ....views import Detector
from ..reference.radiograph import detector_pixels
from .blocks import launch_blocks, moved, pixels_of_a_thread, view
from .radiograph_projection import AFFINE, CONE, PARALLEL, Beam, project, project_backward
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
    splats = [value.double() for value in (means, quats, scales, density)]
    vectors = _vectors(detector, means.device)
    kind = PARALLEL if detector.parallel else AFFINE if mode == "affine" else CONE
    image = _Integrate.apply(*splats, vectors, (detector.width, detector.height), kind, float(cutoff_sigmas))
    if kind == CONE:
        # The pixels work with rays of their own length; see `radiograph_projection`.
        source, center, u, v = vectors
        length = (detector_pixels(detector, center, u, v) - source).norm(dim=-1)
        image = image * length.reshape(image.shape).to(image.dtype)
    return image.to(means.dtype)


def _vectors(detector: Detector, device: torch.device) -> Tensor:
    """(4, 3) float64: source (unit direction of a parallel beam), center, u and v."""
    vectors = [torch.as_tensor(value) for value in (detector.source, detector.center, detector.u, detector.v)]
    source, *rest = (vector.to(vectors[0].device, torch.float64) for vector in vectors)
    if detector.parallel:
        source = source / source.norm()
    return moved(torch.stack([source, *rest]), device, torch.float64)


class _Integrate(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        density: Tensor,
        vectors: Tensor,
        size: tuple[int, int],
        kind: int,
        cutoff: float,
    ) -> Tensor:
        device, (width, height) = means.device, size
        beam = Beam()
        beam.kind, beam.width, beam.height, beam.cutoff = kind, float(width), float(height), cutoff
        # A splat without density shows nothing, but can still grow.
        beam.keep_empty = ctx.needs_input_grad[3]
        parameters = (means, quats, scales, density, vectors)
        rays = project(parameters, beam)
        tiles = bin_boxes(rays.boxes, width, height)
        pixels = pixels_of_a_thread(device)
        inputs = [view(tiles.starts), view(tiles.splats), *rays.of_pixels(Row), cutoff**2, width, height]
        image = torch.empty(height, width, device=device)
        launch_blocks(ray_kernels(pixels).integrate, tiles.count, pixels, [*inputs, view(image)], device)
        ctx.save_for_backward(*parameters)
        ctx.beam, ctx.tiles, ctx.pixels = beam, tiles, pixels
        ctx.kept = (*inputs[:2], view(tiles.slots), *inputs[2:])
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Any:  # type: ignore[override]
        tiles = ctx.tiles
        sums = torch.zeros(len(tiles.slots), SUMS, device=grad.device)
        inputs = [*ctx.kept, view(grad.float()), view(sums, Sums)]
        launch_blocks(ray_kernels(ctx.pixels).integrate_backward, tiles.count, ctx.pixels, inputs, grad.device)
        totals = add_up(tiles.slot_starts, sums)
        want_vectors = ctx.needs_input_grad[4]
        gradients = project_backward(ctx.saved_tensors, ctx.beam, tiles.slot_starts, totals, want_vectors)
        return (*gradients, *([] if want_vectors else [None]), None, None, None)
