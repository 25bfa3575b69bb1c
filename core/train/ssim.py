"""SSIM and L1 with their gradient in one pass over the rows: the loss must not cost more than the renderer."""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..compiled import njit, prange
from ..threads import Alone, loops_only

_RADIUS = 5
# Rows kept at a time: two and the five on either side of them.
_KEPT = 2 * _RADIUS + 2
# Fewer numbers are compared before other threads are awake.
_FEW = 20_000
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
    return _Ssim.apply(image, target.detach())


class _Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor) -> Tensor:
        found = compare(image, target, 1.0, 0.0, ctx.needs_input_grad[0])
        ctx.gradient = found.gradient
        return torch.tensor(found.ssim, dtype=image.dtype, device=image.device)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Any:  # type: ignore[override]
        return times(ctx.gradient, grad).to(grad.device, grad.dtype), None


class Comparison(NamedTuple):
    """Two images compared.

    Attributes:
        ssim: mean over pixels and channels.
        l1: mean absolute difference.
        gradient: of what `compare` was asked for by the image, float32 on the processor.
    """

    ssim: float
    l1: float
    gradient: Tensor


def compare(image: Tensor, target: Tensor, ssim_weight: float, l1_weight: float, backward: bool = True) -> Comparison:
    """SSIM and L1 of images (H, W) or (H, W, C) of one shape, and the gradient of their weighted sum.

    Args:
        backward: whether a gradient is wanted; it has no rows if not.

    Raises:
        ValueError: the shapes differ or an image has no pixels.
    """
    if image.shape != target.shape or image.numel() == 0:
        raise ValueError(f"images of the same size with pixels are compared, not {image.shape} and {target.shape}")
    x, y = _rows(image), _rows(target)
    sums, differences = np.empty(len(x)), np.empty(len(x))
    gradient = np.empty(x.shape if backward else (0, x.shape[1]), np.float32)
    channels = image.shape[2] if image.ndim == 3 else 1
    weights = np.float32(ssim_weight / x.size), np.float32(l1_weight / x.size)
    with Alone(x.size < _FEW):
        compare_rows(x, y, channels, *weights, numba.get_num_threads(), sums, differences, gradient)
    shape = image.shape if backward else gradient.shape
    means = float(sums.sum() / x.size), float(differences.sum() / x.size)
    return Comparison(*means, torch.from_numpy(gradient.reshape(shape)))


def times(gradient: Tensor, factor: Tensor) -> Tensor:
    """A gradient on the processor times what autograd hands down, a scalar that is 1 more often than not."""
    value = float(factor)
    # By numpy: torch wakes its threads for 32,768 numbers, which takes longer than to multiply them.
    return gradient if value == 1 else torch.from_numpy(gradient.numpy() * np.float32(value))


def _rows(image: Tensor) -> np.ndarray:
    """(H, W · C) float32: the channels of a pixel side by side, so that neighbours are C apart."""
    array = image.detach().cpu().numpy()
    return np.ascontiguousarray(array.reshape(array.shape[0], -1), np.float32)


@njit(parallel=loops_only(), cache=True, fastmath=_FAST, error_model="numpy")
def compare_rows(x, y, channels, by_ssim, by_l1, bands, sums, differences, gradient):  # type: ignore[no-untyped-def]
    """SSIM and |x − y| summed over each row (H,), and the gradient (H, W · C) of their weighted sum over all rows.

    Each of `bands` goes down its rows two at a time and keeps no more filtered rows than the window is high: x, y,
    x² + y² and xy under the window along rows; five rows behind them, where the window along columns is complete, the
    derivatives of SSIM by those, again filtered along rows; and another five behind those the gradient, because the
    window is symmetric and so filtering its own adjoint. Pairs begin at even rows (those in the middle at odd ones)
    whatever the bands, so a row's numbers do not depend on them.

    Row i of what is kept lies at i modulo `_KEPT`.

    Args:
        x, y: (H, W · C) float32, pixels `channels` apart.
        by_ssim, by_l1: weights of the sums, float32.
        gradient: without rows if none is wanted.
    """
    height, width = x.shape
    step, margin, wide = np.uint64(channels), _RADIUS * channels, (width + 7) // 8 * 8
    pairs = (height + 1) // 2
    for band in prange(bands):
        first, stop = 2 * (band * pairs // bands), min(2 * ((band + 1) * pairs // bands), height)
        low, high = max(first - _RADIUS, 0), min(stop + _RADIUS, height)
        # Rows outside of the image are zeros.
        products, parts = np.zeros((4, _KEPT, wide), np.float32), np.zeros((3, _KEPT, wide), np.float32)
        padded, down = np.zeros((4, wide + 2 * margin), np.float32), np.empty((4, 2, wide), np.float32)
        for pair in range(max(first - 2 * _RADIUS, 0) // 2, (stop + 2 * _RADIUS - 1) // 2 + 1):
            for i in range(2 * pair, 2 * pair + 2):
                if i < height:
                    _multiply(x[i], y[i], padded, margin)
                    _along_row(padded, step, products, i)
                else:
                    products[:, i % _KEPT] = np.float32(0)
            middle = 2 * pair - _RADIUS
            if low <= middle + 1 and middle < high:
                _down_columns(products, middle, down)
            for i in range(middle, middle + 2):
                if low <= i < high:
                    total = _structure(down, i - middle, padded, margin, width)
                    if len(gradient):
                        _along_row(padded, step, parts, i)
                    if first <= i < stop:
                        sums[i], differences[i] = total, _difference(x[i], y[i])
                else:
                    parts[:, i % _KEPT] = np.float32(0)
            last = middle - _RADIUS
            if len(gradient) and first <= last < stop:
                _down_columns(parts, last, down)
                for i in range(last, min(last + 2, stop)):
                    _gather(down, i - last, x[i], y[i], by_ssim, by_l1, gradient[i])


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def _multiply(x, y, padded, margin):  # type: ignore[no-untyped-def]
    """Rows x, y, x² + y² and xy, from `margin` on."""
    first, second, squares, product = padded[0, margin:], padded[1, margin:], padded[2, margin:], padded[3, margin:]
    for j in range(np.uint64(x.size)):
        a, b = x[j], y[j]
        first[j] = a
        second[j] = b
        squares[j] = a * a + b * b
        product[j] = a * b


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def _along_row(padded, step, planes, i):  # type: ignore[no-untyped-def]
    """Row `i` of each plane: the window along pixels `step` apart that have five zero pixels on either side."""
    for k in range(len(planes)):
        _window(padded[k], step, planes[k, i % _KEPT])


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def _window(padded, step, out):  # type: ignore[no-untyped-def]
    for place in range(np.uint64(out.size)):
        j = place + np.uint64(5) * step
        out[place] = (
            _W0 * padded[j]
            + _W1 * (padded[j - step] + padded[j + step])
            + _W2 * (padded[j - np.uint64(2) * step] + padded[j + np.uint64(2) * step])
            + _W3 * (padded[j - np.uint64(3) * step] + padded[j + np.uint64(3) * step])
            + _W4 * (padded[j - np.uint64(4) * step] + padded[j + np.uint64(4) * step])
            + _W5 * (padded[j - np.uint64(5) * step] + padded[j + np.uint64(5) * step])
        )


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def _down_columns(planes, i, out):  # type: ignore[no-untyped-def]
    """Rows `i` and i + 1 of each plane under the window along columns."""
    at = (i - _RADIUS) % _KEPT
    for k in range(len(planes)):
        rows = planes[k]
        _two_windows(
            rows[at], rows[(at + 1) % _KEPT], rows[(at + 2) % _KEPT], rows[(at + 3) % _KEPT], rows[(at + 4) % _KEPT],
            rows[(at + 5) % _KEPT], rows[(at + 6) % _KEPT], rows[(at + 7) % _KEPT], rows[(at + 8) % _KEPT],
            rows[(at + 9) % _KEPT], rows[(at + 10) % _KEPT], rows[(at + 11) % _KEPT], out[k, 0], out[k, 1],
        )  # fmt: skip


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def _two_windows(r0, r1, r2, r3, r4, r5, r6, r7, r8, r9, r10, r11, upper, lower):  # type: ignore[no-untyped-def]
    """Ten of the twelve rows are under both windows; loading them is what takes the time."""
    for j in range(np.uint64(upper.size)):
        b, c, d, e, f = r1[j], r2[j], r3[j], r4[j], r5[j]
        g, h, k, m, n = r6[j], r7[j], r8[j], r9[j], r10[j]
        upper[j] = _W0 * f + _W1 * (e + g) + _W2 * (d + h) + _W3 * (c + k) + _W4 * (b + m) + _W5 * (r0[j] + n)
        lower[j] = _W0 * g + _W1 * (f + h) + _W2 * (e + k) + _W3 * (d + m) + _W4 * (c + n) + _W5 * (b + r11[j])


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def _structure(down, row, padded, margin, width):  # type: ignore[no-untyped-def]
    """Sum of SSIM over a row, and from `margin` on its derivatives by the filtered x, x² + y² and xy."""
    x, y, squares, product = down[0, row], down[1, row], down[2, row], down[3, row]
    by_x, by_squares, by_product = padded[0, margin:], padded[1, margin:], padded[2, margin:]
    total = np.float32(0)
    for j in range(np.uint64(width)):
        mx, my = x[j], y[j]
        square, cross = mx * mx + my * my, mx * my
        a1, a2 = np.float32(2) * cross + _C1, np.float32(2) * (product[j] - cross) + _C2
        # Rounding can push the variance of a flat patch below zero.
        b1, b2 = square + _C1, max(squares[j] - square, np.float32(0)) + _C2
        over = np.float32(1) / (b1 * b2)
        value = a1 * a2 * over
        total += value
        by_x[j] = np.float32(2) * (my * (a2 - a1) * over - mx * value * (b2 - b1) * over)
        by_squares[j] = -value * b1 * over
        by_product[j] = np.float32(2) * a1 * over
    return total


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def _difference(x, y):  # type: ignore[no-untyped-def]
    total = np.float32(0)
    for j in range(np.uint64(x.size)):
        total += abs(x[j] - y[j])
    return total


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def _gather(down, row, x, y, by_ssim, by_l1, gradient):  # type: ignore[no-untyped-def]
    of_x, of_squares, of_product = down[0, row], down[1, row], down[2, row]
    for j in range(np.uint64(gradient.size)):
        structure = of_x[j] + np.float32(2) * x[j] * of_squares[j] + y[j] * of_product[j]
        off = x[j] - y[j]
        gradient[j] = by_ssim * structure + by_l1 * (np.float32(off > 0) - np.float32(off < 0))
