"""Losses, each a scalar tensor."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import huber_loss

from ..capture.model import CountingNoise
from ..compiled import njit, prange
from ..threads import Alone, loops_only
from .ssim import compare, ssim, times

# Numbers a task adds up in float32: fixed, so that sums do not depend on the number of threads.
_CHUNK = 4096
# Fewer numbers are compared before other threads are awake.
_FEW = 300_000
_ZERO_ONE_MARGIN = 1e-3
# e to more than that is no number in single precision.
_DEEPEST = 80.0


def l1(image: Tensor, target: Tensor) -> Tensor:
    """Mean absolute difference of two images of the same shape; equal values pass no gradient.

    Images in float32 on the processor are passed over once; the target then gets no gradient.
    """
    return _L1.apply(image, target) if _plain(image, target) else (image - target).abs().mean()


def image_loss(image: Tensor, target: Tensor, structure_weight: float) -> Tensor:
    """(1 − λ)·L1 + λ·(1 − SSIM) of images (H, W) or (H, W, C) in 0..1 (arXiv 2308.04079, eq. 7).

    Images in float32 on the processor are passed over once for the two terms; the target then gets no gradient.
    """
    if _plain(image, target):
        return _ImageLoss.apply(image, target, structure_weight)
    return (1 - structure_weight) * l1(image, target) + structure_weight * d_ssim(image, target)


def masked_loss(
    image: Tensor, target: Tensor, structure_weight: float, alpha: Tensor, mask: Tensor, mask_weight: float
) -> Tensor:
    """`image_loss` plus `mask_weight` times the L1 of `alpha` and `mask`, both (H, W)."""
    if _plain(image, target) and _plain(alpha, mask):
        return _MaskedLoss.apply(image, target, structure_weight, alpha, mask, mask_weight)
    return image_loss(image, target, structure_weight) + mask_weight * l1(alpha, mask)


def _plain(image: Tensor, target: Tensor) -> bool:
    here = image.dtype == target.dtype == torch.float32 and image.is_cpu and target.is_cpu
    return here and not target.requires_grad and image.shape == target.shape and image.numel() > 0


class _L1(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor) -> Tensor:
        value, ctx.gradient = _mean_difference(image, target, 1.0)
        return torch.tensor(value, dtype=torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Any:  # type: ignore[override]
        return times(ctx.gradient, grad), None


class _ImageLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, structure_weight: float) -> Tensor:
        value, ctx.gradient = _both_terms(image, target, structure_weight, ctx.needs_input_grad[0])
        return torch.tensor(value, dtype=torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Any:  # type: ignore[override]
        return times(ctx.gradient, grad), None, None


class _MaskedLoss(torch.autograd.Function):
    """The two losses in one node: each node, and each sum of scalars, costs as much as a small kernel."""

    @staticmethod
    def forward(
        ctx: Any,
        image: Tensor,
        target: Tensor,
        structure_weight: float,
        alpha: Tensor,
        mask: Tensor,
        mask_weight: float,
    ) -> Tensor:
        value, ctx.gradient = _both_terms(image, target, structure_weight, ctx.needs_input_grad[0])
        outside, ctx.alpha_gradient = _mean_difference(alpha, mask, mask_weight)
        return torch.tensor(value + outside, dtype=torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Any:  # type: ignore[override]
        return times(ctx.gradient, grad), None, None, times(ctx.alpha_gradient, grad), None, None


def _both_terms(image: Tensor, target: Tensor, structure_weight: float, backward: bool) -> tuple[float, Tensor]:
    """`image_loss` and its gradient by the image."""
    found = compare(image, target, -structure_weight, 1 - structure_weight, backward)
    return (1 - structure_weight) * found.l1 + structure_weight * (1 - found.ssim), found.gradient


def _mean_difference(image: Tensor, target: Tensor, weight: float) -> tuple[float, Tensor]:
    """`weight` times the L1 of two images, and its gradient by the first."""
    gradient = np.empty(tuple(image.shape), np.float32)
    values, wanted = (part.detach().contiguous().numpy().reshape(-1) for part in (image, target))
    with Alone(values.size < _FEW):
        total = difference(values, wanted, np.float32(weight / values.size), gradient.reshape(-1))
    return weight * float(total) / values.size, torch.from_numpy(gradient)


@njit(parallel=loops_only(), cache=True, fastmath={"reassoc", "contract", "nsz"}, error_model="numpy")
def difference(values, wanted, factor, gradient):  # type: ignore[no-untyped-def]
    """Sum of |values − wanted|; `factor` times its derivative by `values`, −1, 0 or 1, is written to `gradient`."""
    chunks = (values.size + _CHUNK - 1) // _CHUNK
    sums = np.zeros(chunks)
    for chunk in prange(chunks):
        total = np.float32(0.0)
        for i in range(np.uint64(chunk * _CHUNK), np.uint64(min((chunk + 1) * _CHUNK, values.size))):
            off = values[i] - wanted[i]
            total += abs(off)
            gradient[i] = factor * (np.float32(off > 0) - np.float32(off < 0))
        sums[chunk] = total
    return sums.sum()


def d_ssim(image: Tensor, target: Tensor) -> Tensor:
    """1 − SSIM of images (H, W) or (H, W, C) in 0..1, as 3DGS's code has it (arXiv 2308.04079, eq. 7)."""
    return 1 - ssim(image, target)


def projection_loss(
    image: Tensor,
    target: Tensor,
    squares_weight: float | None,
    structure_weight: float,
    straight_from: float | None = None,
    noise: CountingNoise | None = None,
    full_scale: float = 1.0,
) -> Tensor:
    """L1, or the mean square times `squares_weight`, plus `structure_weight` times D-SSIM.

    Of two projections (H, W) of line integrals, divided by their full scale. Differences from `straight_from` on count
    straight on with the slope that squares have there (Huber, Ann. Math. Statist. 35(1), 1964), not squared. With
    `noise`, squares and D-SSIM beside them look at the target `as_known`; not so L1, whose gradient knows but the sign
    of a difference.
    """
    if squares_weight is None:
        return l1(image, target) + structure_weight * d_ssim(image, target)
    target = as_known(image, target, noise, full_scale)
    if straight_from is None:
        difference = squares_weight * (image - target).square().mean()
    else:
        difference = 2 * squares_weight * huber_loss(image, target, delta=straight_from)
    return difference + structure_weight * d_ssim(image, target)


def as_known(image: Tensor, target: Tensor, noise: CountingNoise | None, full_scale: float) -> Tensor:
    """The target (H, W) of a projection, as far from the image as is known of it, a constant to gradients.

    Differences shrink to the share σ₀²/(σ₀² + σ²), so that in squares they weigh as much, of the deviation σ that the
    rendered line integral has (`Projections.noise`) and σ₀, which counts as known. σ of what is measured would be noise
    itself, and lowest where that made a ray look thin. `target` itself without noise.

    Args:
        image, target: line integrals divided by `full_scale`.
    """
    if noise is None:
        return target
    rendered = image.detach()
    known, lines = noise.known**2, (rendered * full_scale).clamp(max=_DEEPEST)
    variance = (noise.per_photon * torch.exp(lines) + noise.floor).clamp(max=noise.most)
    return rendered + known / (known + variance) * (target - rendered)


def zero_one(values: Tensor) -> Tensor:
    """mean(log v + log(1 − v)), smallest at 0 and 1: it makes opacities decide (Lombardi et al. 2019).

    Values are clamped to [1e-3, 1 − 1e-3]; beyond that there is no gradient. 0 for an empty tensor.
    """
    if values.numel() == 0:
        return values.sum()
    kept = values.clamp(_ZERO_ONE_MARGIN, 1 - _ZERO_ONE_MARGIN)
    return (kept.log() + torch.log1p(-kept)).mean()


def total_variation(volume: Tensor, edge: float | None = None) -> Tensor:
    """Mean absolute difference d between neighbours along the three axes of (nz, ny, nx).

    Args:
        edge: τ, where d counts as τ d / (τ + d): what is far below τ as it is, as noise and streaks are, a step far
            beyond it, an edge, as τ whatever its height, so that nothing is won by making it lower (Geman and Reynolds,
            IEEE TPAMI 14, 1992, as a potential of edges). None for d itself, total variation proper.
    """
    steps = [volume.diff(dim=axis).abs() for axis in range(3)]
    if edge is not None:
        steps = [edge * step / (edge + step) for step in steps]
    count = sum(step.numel() for step in steps)
    return sum((step.sum() for step in steps), volume.new_zeros(())) / max(count, 1)
