"""SSIM with its gradient, as separable filters in Numba: the loss must not cost more than the renderer."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

_RADIUS = 5
_SIGMA = 1.5
_C1, _C2 = np.float32(0.01**2), np.float32(0.03**2)


def _half_window() -> tuple[np.float32, ...]:
    """The window's middle weight and the five on either side of it, outwards."""
    weights = np.exp(-0.5 * (np.arange(-_RADIUS, _RADIUS + 1) / _SIGMA) ** 2)
    return tuple((weights / weights.sum())[_RADIUS:].astype(np.float32))


_W0, _W1, _W2, _W3, _W4, _W5 = _half_window()
_FAST = {"contract", "nsz", "arcp", "reassoc"}


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Mean structural similarity (Wang et al. 2004), a scalar; 11 x 11 Gaussian window, σ = 1.5, zeros outside.

    Two flat images of the same value give 1 and no gradient.

    Args:
        image: (H, W) or (H, W, C), values in 0..1; gradients go to it.
        target: the same shape; gets no gradient.

    Raises:
        ValueError: the shapes differ or an image has no pixels.
    """
    if image.shape != target.shape or image.numel() == 0:
        raise ValueError(f"ssim needs two images of the same size with pixels, not {image.shape} and {target.shape}")
    return _Ssim.apply(image, target.detach())


class _Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor) -> Tensor:
        x, y = _planes(image), _planes(target)
        across = np.empty((5, *x.shape), np.float32)
        _filter_products(x, y, across)
        parts = np.empty((3, *x.shape), np.float32)
        sums = np.empty(x.shape[0] * x.shape[1])
        _compare(across, parts, sums)
        ctx.parts, ctx.shape, ctx.kind = (x, y, parts), image.shape, (image.dtype, image.device)
        return torch.tensor(sums.sum() / x.size, dtype=image.dtype, device=image.device)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Any:  # type: ignore[override]
        x, y, parts = ctx.parts
        across = np.empty_like(parts)
        _filter_parts(parts, across)
        gradient = np.empty_like(x)
        _gather(across, x, y, np.float32(float(grad) / x.size), gradient)
        shaped = gradient[0]
        if len(ctx.shape) == 3:
            shaped = np.empty(ctx.shape, np.float32)
            _join(gradient, shaped)
        dtype, device = ctx.kind
        return torch.from_numpy(shaped).to(device, dtype), None


def _planes(image: Tensor) -> np.ndarray:
    """(C, H, W) float32."""
    array = image.detach().cpu().numpy().astype(np.float32, copy=False)
    if array.ndim == 2:
        return np.ascontiguousarray(array[None])
    planes = np.empty((array.shape[2], *array.shape[:2]), np.float32)
    _split(np.ascontiguousarray(array), planes)
    return planes


@numba.njit(parallel=True, cache=True)
def _split(image, planes):  # type: ignore[no-untyped-def]
    """(H, W, C) to (C, H, W)."""
    for i in numba.prange(image.shape[0]):
        for c in range(image.shape[2]):
            for j in range(image.shape[1]):
                planes[c, i, j] = image[i, j, c]


@numba.njit(parallel=True, cache=True)
def _join(planes, image):  # type: ignore[no-untyped-def]
    """(C, H, W) to (H, W, C)."""
    for i in numba.prange(image.shape[0]):
        for c in range(image.shape[2]):
            for j in range(image.shape[1]):
                image[i, j, c] = planes[c, i, j]


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def _along_row(padded, out):  # type: ignore[no-untyped-def]
    """The window along a row that has five zeros on either side; written out so that it vectorises."""
    for j in range(out.size):
        out[j] = (
            _W0 * padded[j + 5]
            + _W1 * (padded[j + 4] + padded[j + 6])
            + _W2 * (padded[j + 3] + padded[j + 7])
            + _W3 * (padded[j + 2] + padded[j + 8])
            + _W4 * (padded[j + 1] + padded[j + 9])
            + _W5 * (padded[j] + padded[j + 10])
        )


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def _down_columns(plane, i, out):  # type: ignore[no-untyped-def]
    """Row `i` of the plane (H, W) under the window along columns, zeros outside."""
    weights = (_W0, _W1, _W2, _W3, _W4, _W5)
    middle = plane[i]
    for j in range(out.size):
        out[j] = _W0 * middle[j]
    for step in range(1, 6):
        weight = weights[step]
        if i - step >= 0:
            above = plane[i - step]
            for j in range(out.size):
                out[j] += weight * above[j]
        if i + step < plane.shape[0]:
            below = plane[i + step]
            for j in range(out.size):
                out[j] += weight * below[j]


@numba.njit(parallel=True, cache=True, fastmath=_FAST, error_model="numpy")
def _filter_products(x, y, across):  # type: ignore[no-untyped-def]
    """x, y, x², y², xy (5, C, H, W) under the window along rows."""
    channels, height, width = x.shape
    for row in numba.prange(channels * height):
        c, i = row // height, row % height
        padded = np.zeros(width + 10, np.float32)
        a, b, inner = x[c, i], y[c, i], padded[5 : 5 + width]
        inner[:] = a
        _along_row(padded, across[0, c, i])
        inner[:] = b
        _along_row(padded, across[1, c, i])
        inner[:] = a * a
        _along_row(padded, across[2, c, i])
        inner[:] = b * b
        _along_row(padded, across[3, c, i])
        inner[:] = a * b
        _along_row(padded, across[4, c, i])


@numba.njit(parallel=True, cache=True, fastmath=_FAST, error_model="numpy")
def _compare(across, parts, sums):  # type: ignore[no-untyped-def]
    """Sum of SSIM over each row, and its derivatives by the filtered x, x² and xy (3, C, H, W)."""
    _, channels, height, width = across.shape
    for row in numba.prange(channels * height):
        c, i = row // height, row % height
        down = np.empty((5, width), np.float32)
        for k in range(5):
            _down_columns(across[k, c], i, down[k])
        total = np.float64(0.0)
        for j in range(width):
            mx, my = down[0, j], down[1, j]
            a1 = np.float32(2) * mx * my + _C1
            a2 = np.float32(2) * (down[4, j] - mx * my) + _C2
            b1 = mx * mx + my * my + _C1
            # Rounding can push the variance of a flat patch below zero.
            b2 = max(down[2, j] - mx * mx, np.float32(0)) + max(down[3, j] - my * my, np.float32(0)) + _C2
            over = np.float32(1) / (b1 * b2)
            value = a1 * a2 * over
            total += value
            parts[0, c, i, j] = np.float32(2) * (my * (a2 - a1) * over - mx * value * (b2 - b1) * over)
            parts[1, c, i, j] = -value * b1 * over
            parts[2, c, i, j] = np.float32(2) * a1 * over
        sums[row] = total


@numba.njit(parallel=True, cache=True, fastmath=_FAST, error_model="numpy")
def _filter_parts(parts, across):  # type: ignore[no-untyped-def]
    _, channels, height, width = parts.shape
    for row in numba.prange(channels * height):
        c, i = row // height, row % height
        padded = np.zeros(width + 10, np.float32)
        for k in range(3):
            padded[5 : 5 + width] = parts[k, c, i]
            _along_row(padded, across[k, c, i])


@numba.njit(parallel=True, cache=True, fastmath=_FAST, error_model="numpy")
def _gather(across, x, y, scale, gradient):  # type: ignore[no-untyped-def]
    """The gradient by x: the window is symmetric, so filtering is its own adjoint."""
    channels, height, width = x.shape
    for row in numba.prange(channels * height):
        c, i = row // height, row % height
        down = np.empty((3, width), np.float32)
        for k in range(3):
            _down_columns(across[k, c], i, down[k])
        for j in range(width):
            total = down[0, j] + np.float32(2) * x[c, i, j] * down[1, j] + y[c, i, j] * down[2, j]
            gradient[c, i, j] = scale * total
