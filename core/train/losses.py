"""Losses, each a scalar tensor."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..threads import loops_only
from .ssim import Comparison, ssim

# Pixels a task adds up in float32: fixed, so that sums do not depend on the number of threads.
_CHUNK = 4096
_ZERO_ONE_MARGIN = 1e-3


def l1(image: Tensor, target: Tensor) -> Tensor:
    """Mean absolute difference of two images of the same shape; equal values pass no gradient.

    Images in float32 on the processor are passed over once; the target then gets no gradient.
    """
    return _L1.apply(image, target) if _plain(image, target) else (image - target).abs().mean()


def image_loss(image: Tensor, target: Tensor, structure_weight: float) -> Tensor:
    """(1 − λ)·L1 + λ·(1 − SSIM) of images (H, W) or (H, W, C) in 0..1 (arXiv 2308.04079, eq. 7).

    Images in float32 on the processor get one gradient for the two terms; the target then gets none.
    """
    if _plain(image, target):
        return _ImageLoss.apply(image, target, structure_weight)
    return (1 - structure_weight) * l1(image, target) + structure_weight * d_ssim(image, target)


def _plain(image: Tensor, target: Tensor) -> bool:
    here = image.dtype == target.dtype == torch.float32 and image.device == target.device == torch.device("cpu")
    return here and not target.requires_grad and image.shape == target.shape and image.numel() > 0


class _L1(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor) -> Tensor:
        mean, ctx.signs = _mean_difference(image, target)
        return torch.tensor(mean, dtype=torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Any:  # type: ignore[override]
        return ctx.signs * (grad / ctx.signs.numel()), None


class _ImageLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, structure_weight: float) -> Tensor:
        mean, ctx.signs = _mean_difference(image, target)
        ctx.comparison, ctx.structure_weight = Comparison(image, target), structure_weight
        loss = (1 - structure_weight) * mean + structure_weight * (1 - ctx.comparison.mean)
        return torch.tensor(loss, dtype=torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Any:  # type: ignore[override]
        factor, weight = float(grad), ctx.structure_weight
        gradient = ctx.comparison.gradient(-weight * factor)
        return gradient.add_(ctx.signs, alpha=(1 - weight) * factor / ctx.signs.numel()), None, None


def _mean_difference(image: Tensor, target: Tensor) -> tuple[float, Tensor]:
    """L1 of two images and the signs, −1, 0 or 1, of what is too much or too little."""
    signs = torch.empty(image.shape, dtype=torch.float32)
    values, wanted = (part.detach().contiguous().numpy().reshape(-1) for part in (image, target))
    return float(difference(values, wanted, signs.numpy().reshape(-1))) / signs.numel(), signs


@numba.njit(parallel=loops_only(), cache=True, fastmath={"reassoc", "contract", "nsz"}, error_model="numpy")
def difference(values, wanted, signs):  # type: ignore[no-untyped-def]
    """Sum of |values − wanted|; its derivative by `values`, −1, 0 or 1, is written to `signs`."""
    chunks = (values.size + _CHUNK - 1) // _CHUNK
    sums = np.zeros(chunks)
    for chunk in numba.prange(chunks):
        total = np.float32(0.0)
        for i in range(np.uint64(chunk * _CHUNK), np.uint64(min((chunk + 1) * _CHUNK, values.size))):
            off = values[i] - wanted[i]
            total += abs(off)
            signs[i] = np.float32(off > 0) - np.float32(off < 0)
        sums[chunk] = total
    return sums.sum()


def d_ssim(image: Tensor, target: Tensor) -> Tensor:
    """1 − SSIM of images (H, W) or (H, W, C) in 0..1, as 3DGS's code has it (arXiv 2308.04079, eq. 7)."""
    return 1 - ssim(image, target)


def zero_one(values: Tensor) -> Tensor:
    """mean(log v + log(1 − v)), smallest at 0 and 1: it makes opacities decide (Lombardi et al. 2019).

    Values are clamped to [1e-3, 1 − 1e-3]; beyond that there is no gradient. 0 for an empty tensor.
    """
    if values.numel() == 0:
        return values.sum()
    kept = values.clamp(_ZERO_ONE_MARGIN, 1 - _ZERO_ONE_MARGIN)
    return (kept.log() + torch.log1p(-kept)).mean()


def total_variation(volume: Tensor) -> Tensor:
    """Mean absolute difference between neighbours along the three axes of (nz, ny, nx)."""
    steps = [volume.diff(dim=axis).abs() for axis in range(3)]
    count = sum(step.numel() for step in steps)
    return sum((step.sum() for step in steps), volume.new_zeros(())) / max(count, 1)
