"""`section` on the CPU: density, occupancy and colour of cuts and slabs in Numba behind one autograd function."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ....views import Plane
from ..reference.section import LEAST_WEIGHT
from .bands import list_bands, padded_width
from .section_geometry import project
from .section_raster import rasterize, rasterize_backward


def cpu_density(
    means: Tensor, quats: Tensor, scales: Tensor, density: Tensor, plane: Plane, cutoff_sigmas: float
) -> Tensor:
    """(height, width) Σ ρ·w; see `core.render.section`."""
    values = torch.ones(len(means), 1)
    return _Rasterize.apply(means, quats, scales, density, values, plane, False, cutoff_sigmas)[0]


def cpu_occupancy(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, plane: Plane, cutoff_sigmas: float
) -> Tensor:
    """(height, width) 1 − Π(1 − o·w)."""
    values = torch.ones(len(means), 1)
    return 1 - _Rasterize.apply(means, quats, scales, opacities, values, plane, True, cutoff_sigmas)[0]


def cpu_color(
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
    total = _Rasterize.apply(means, quats, scales, opacities, values, plane, False, cutoff_sigmas)
    return (total[:3] / total[3:].clamp(min=LEAST_WEIGHT)).permute(1, 2, 0)


class _Rasterize(torch.autograd.Function):
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
        cutoff_sigmas: float,
    ) -> Tensor:
        k2 = float(cutoff_sigmas) ** 2
        shape = tuple(_array(value) for value in (means, quats, scales))
        frame = np.stack([np.asarray(vector, np.float64) for vector in (plane.origin, plane.u, plane.v, plane.normal)])
        thickness = max(float(plane.thickness_mm), 0.0)
        size = (plane.width, plane.height)
        table, reference, boxes = project(*shape, _array(amount), frame, thickness, *size, k2, ctx.needs_input_grad[3])
        channels = values.detach().numpy().astype(np.float32)
        bands = list_bands(boxes, plane.height)
        image = rasterize(table, reference, boxes, *bands, channels, product, k2, *size)
        image = np.ascontiguousarray(image[:, :, : plane.width])
        ctx.kept = (*shape, frame, thickness, table, reference, boxes, k2, *size)
        ctx.channels, ctx.product, ctx.image = channels, product, image if product else None
        ctx.dtypes = [value.dtype for value in (means, quats, scales, amount, values)]
        return torch.from_numpy(image).to(means.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Any, ...]:  # type: ignore[override]
        incoming = grad.detach().numpy().astype(np.float32)
        if ctx.product:
            incoming = -incoming * ctx.image
        channels, height, width = incoming.shape
        padded = np.zeros((channels, height, padded_width(width)), np.float32)
        padded[:, :, :width] = incoming
        wanted = ctx.needs_input_grad[4], any(ctx.needs_input_grad[:3])
        gradients = rasterize_backward(padded, ctx.channels, ctx.product, *wanted, *ctx.kept)
        returned = [
            torch.from_numpy(value).to(dtype) if needed else None
            for value, dtype, needed in zip(gradients, ctx.dtypes, ctx.needs_input_grad[:5], strict=True)
        ]
        return (*returned, None, None, None)


def _array(value: Tensor) -> np.ndarray:
    return np.ascontiguousarray(value.detach().numpy(), np.float64)
