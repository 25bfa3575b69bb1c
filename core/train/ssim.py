"""SSIM with its gradient, as separable filters in Numba: the loss must not cost more than the renderer."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..threads import loops_only

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
        ctx.comparison = Comparison(image, target)
        return torch.tensor(ctx.comparison.mean, dtype=image.dtype, device=image.device)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Any:  # type: ignore[override]
        return ctx.comparison.gradient(float(grad)).to(grad.device, grad.dtype), None


class Comparison:
    """SSIM of two images of the same shape, with what its gradient needs.

    Attributes:
        mean: over pixels and channels.
    """

    def __init__(self, image: Tensor, target: Tensor) -> None:
        self._shape, self._channels = image.shape, image.shape[2] if image.ndim == 3 else 1
        self._x, self._y = _rows(image), _rows(target)
        across = np.empty((5, *self._x.shape), np.float32)
        _filter_products(self._x, self._y, self._channels, across)
        self._parts = np.empty((3, *self._x.shape), np.float32)
        sums = np.empty(len(self._x))
        _compare(across, self._parts, sums)
        self.mean = float(sums.sum() / self._x.size)

    def gradient(self, factor: float) -> Tensor:
        """`factor` times the derivative of `mean` by the image, float32."""
        across = np.empty_like(self._parts)
        _filter_parts(self._parts, self._channels, across)
        gradient = np.empty_like(self._x)
        _gather(across, self._x, self._y, np.float32(factor / gradient.size), gradient)
        return torch.from_numpy(gradient.reshape(self._shape))


def _rows(image: Tensor) -> np.ndarray:
    """(H, W · C) float32: the channels of a pixel side by side, so that neighbours are C apart."""
    array = image.detach().cpu().numpy()
    return np.ascontiguousarray(array.reshape(array.shape[0], -1), np.float32)


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def _along_row(padded, step, out):  # type: ignore[no-untyped-def]
    """The window along a row of pixels `step` apart that has five zero pixels on either side."""
    for place in range(np.uint64(out.size)):
        j = place + np.uint64(5 * step)
        out[place] = (
            _W0 * padded[j]
            + _W1 * (padded[j - step] + padded[j + step])
            + _W2 * (padded[j - np.uint64(2) * step] + padded[j + np.uint64(2) * step])
            + _W3 * (padded[j - np.uint64(3) * step] + padded[j + np.uint64(3) * step])
            + _W4 * (padded[j - np.uint64(4) * step] + padded[j + np.uint64(4) * step])
            + _W5 * (padded[j - np.uint64(5) * step] + padded[j + np.uint64(5) * step])
        )


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def _down_columns(plane, i, out):  # type: ignore[no-untyped-def]
    """Row `i` of the plane under the window along columns, zeros outside."""
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


@numba.njit(cache=True, fastmath=_FAST, error_model="numpy")
def _multiply(a, b, out):  # type: ignore[no-untyped-def]
    for j in range(out.size):
        out[j] = a[j] * b[j]


@numba.njit(parallel=loops_only(), cache=True, fastmath=_FAST, error_model="numpy")
def _filter_products(x, y, channels, across):  # type: ignore[no-untyped-def]
    """x, y, x², y², xy (5, H, W · C) under the window along rows."""
    height, width = x.shape
    margin, step = 5 * channels, np.uint64(channels)
    for i in numba.prange(height):
        padded = np.zeros(width + 2 * margin, np.float32)
        a, b, inner = x[i], y[i], padded[margin : margin + width]
        inner[:] = a
        _along_row(padded, step, across[0, i])
        inner[:] = b
        _along_row(padded, step, across[1, i])
        _multiply(a, a, inner)
        _along_row(padded, step, across[2, i])
        _multiply(b, b, inner)
        _along_row(padded, step, across[3, i])
        _multiply(a, b, inner)
        _along_row(padded, step, across[4, i])


@numba.njit(parallel=loops_only(), cache=True, fastmath=_FAST, error_model="numpy")
def _compare(across, parts, sums):  # type: ignore[no-untyped-def]
    """Sum of SSIM over each row, and its derivatives by the filtered x, x² and xy (3, H, W · C)."""
    _, height, width = across.shape
    for i in numba.prange(height):
        down = np.empty((5, width), np.float32)
        for k in range(5):
            _down_columns(across[k], i, down[k])
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
            parts[0, i, j] = np.float32(2) * (my * (a2 - a1) * over - mx * value * (b2 - b1) * over)
            parts[1, i, j] = -value * b1 * over
            parts[2, i, j] = np.float32(2) * a1 * over
        sums[i] = total


@numba.njit(parallel=loops_only(), cache=True, fastmath=_FAST, error_model="numpy")
def _filter_parts(parts, channels, across):  # type: ignore[no-untyped-def]
    _, height, width = parts.shape
    margin, step = 5 * channels, np.uint64(channels)
    for i in numba.prange(height):
        padded = np.zeros(width + 2 * margin, np.float32)
        for k in range(3):
            padded[margin : margin + width] = parts[k, i]
            _along_row(padded, step, across[k, i])


@numba.njit(parallel=loops_only(), cache=True, fastmath=_FAST, error_model="numpy")
def _gather(across, x, y, scale, gradient):  # type: ignore[no-untyped-def]
    """The gradient by x: the window is symmetric, so filtering is its own adjoint."""
    height, width = x.shape
    for i in numba.prange(height):
        down = np.empty((3, width), np.float32)
        for k in range(3):
            _down_columns(across[k], i, down[k])
        for j in range(width):
            total = down[0, j] + np.float32(2) * x[i, j] * down[1, j] + y[i, j] * down[2, j]
            gradient[i, j] = scale * total
