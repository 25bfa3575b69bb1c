"""Losses, each a scalar tensor."""

from __future__ import annotations

import torch
from torch import Tensor

from .ssim import ssim

_ZERO_ONE_MARGIN = 1e-3


def l1(image: Tensor, target: Tensor) -> Tensor:
    """Mean absolute difference of two images of the same shape."""
    return (image - target).abs().mean()


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
