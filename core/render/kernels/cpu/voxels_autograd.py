"""The voxel grid of `voxels` behind one autograd function."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from .bands import list_bands, padded_width
from .voxels import project, rasterize, rasterize_backward


def differentiable_voxels(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    density: Tensor,
    origin: np.ndarray,
    spacing: np.ndarray,
    shape: np.ndarray,
    cutoff_sigmas: float,
) -> Tensor:
    """(nz, ny, nx) Σ ρ·w; origin, spacing and shape are (3,) in the order x, y, z."""
    return _Voxelize.apply(means, quats, scales, density, origin, spacing, shape, cutoff_sigmas)


class _Voxelize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        density: Tensor,
        origin: np.ndarray,
        spacing: np.ndarray,
        shape: np.ndarray,
        cutoff_sigmas: float,
    ) -> Tensor:
        k2 = float(cutoff_sigmas) ** 2
        splats = [np.ascontiguousarray(value.detach().numpy(), np.float64) for value in (means, quats, scales, density)]
        table, centers, boxes = project(*splats, origin, spacing, shape, k2, ctx.needs_input_grad[3])
        bands = list_bands(np.ascontiguousarray(boxes[:, [0, 1, 4, 5]]), shape[2])
        values = rasterize(table, centers, boxes, *bands, k2, shape)
        ctx.kept = (*splats[:3], spacing, table, centers, boxes, k2)
        ctx.dtypes = [value.dtype for value in (means, quats, scales, density)]
        return torch.from_numpy(np.ascontiguousarray(values[:, :, : shape[0]])).to(means.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Any, ...]:  # type: ignore[override]
        slices, rows, columns = grad.shape
        padded = np.zeros((slices, rows, padded_width(columns)), np.float32)
        padded[:, :, :columns] = grad.detach().numpy()
        gradients = [
            torch.from_numpy(value).to(dtype)
            for value, dtype in zip(rasterize_backward(padded, *ctx.kept), ctx.dtypes, strict=True)
        ]
        return (*gradients, None, None, None, None)
