"""Scattering every pixel over its circle of confusion, and the gradient of that (Numba)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..compiled import njit, prange
from ..threads import Alone, loops_only
from ..train.activation import exponential

# Of the scatter weight (½ + ½ tanh 4(r − d)) / (r² + 0.2): the steepness, and what keeps a sharp pixel finite.
_STEEP, _SHARPEST = np.float32(8.0), np.float32(0.2)
# The weight's tail one pixel beyond the circle. It is taken off, so that weights end there without a step.
_TAIL = np.float32(1.0 / (1.0 + math.exp(8.0)))
_WHOLE = np.float32(1.0 / (1.0 - float(_TAIL)))
_ONE = np.float32(1.0)
# Darker pixels pass gradients as if they were this bright: the root of the light has no slope in the dark.
_DARK = 1e-6
_CHANNELS = 4
# Fewer pixels are spread before other threads are awake.
_FEW = 2000


def scatter_blur(color: Tensor, alpha: Tensor, radii: Tensor) -> tuple[Tensor, Tensor]:
    """Colour and alpha with every pixel spread over a circle of its own; differentiable in all three.

    The scatter weight of DoF-Gaussian (arXiv 2503.00746) and BokehMe (Peng et al. 2022): a pixel of radius r gives
    (½ + ½ tanh 4(r − d)) / (r² + 0.2) to the pixel at the distance d, and what a pixel gets is divided by the
    sum of weights. Colours are mixed as squares, light at a gamma of 2. Weights below 3.4e-4 of the largest are
    taken off, so that a radius of 0 leaves an image as it is.

    Args:
        color: (H, W, 3) ≥ 0, float32, on the processor.
        alpha: (H, W).
        radii: (H, W) pixels, ≥ 0.
    """
    blurred, covered = _Blur.apply(color, alpha, radii)
    return blurred, covered


class _Blur(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, color: Tensor, alpha: Tensor, radii: Tensor) -> tuple[Tensor, Tensor]:
        colors, around = color.detach().numpy(), np.ascontiguousarray(radii.detach().numpy(), np.float32)
        values = np.empty((_CHANNELS, *around.shape), np.float32)
        np.square(np.moveaxis(colors, -1, 0), out=values[:3])
        values[3] = alpha.detach().numpy()
        sums, weights = np.zeros_like(values), np.zeros_like(around)
        with Alone(around.size < _FEW):
            scatter(values, around, _reach(around), sums, weights)
        sums /= weights
        blurred = np.sqrt(np.moveaxis(sums[:3], 0, -1))
        ctx.images = (values, around, sums, weights, colors)
        return torch.from_numpy(blurred), torch.from_numpy(sums[3].copy())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_color: Tensor, by_alpha: Tensor) -> Any:  # type: ignore[override]
        values, around, means, weights, colors = ctx.images
        given = np.empty_like(values)
        given[:3] = np.moveaxis(by_color.numpy(), -1, 0) * (0.5 / np.maximum(np.sqrt(means[:3]), np.float32(_DARK)))
        given[3] = by_alpha.numpy()
        given /= weights
        of_weight = -(given * means).sum(axis=0)
        by_values, by_radii = np.empty_like(values), np.empty_like(around)
        with Alone(around.size < _FEW):
            scatter_backward(values, around, _reach(around), given, of_weight, by_values, by_radii)
        by_colors = 2 * np.maximum(colors, np.float32(_DARK)) * np.moveaxis(by_values[:3], 0, -1)
        return torch.from_numpy(by_colors), torch.from_numpy(by_values[3]), torch.from_numpy(by_radii)


def _reach(radii: np.ndarray) -> int:
    return math.ceil(float(radii.max(initial=0.0, where=np.isfinite(radii))))


@njit(fastmath={"contract"}, error_model="numpy", forceinline=True)
def _share(radius, along, across2):  # type: ignore[no-untyped-def]
    """½ + ½ tanh 4(r − d) at d² = along² + across², without its tail."""
    inside = radius - np.sqrt(np.float32(along * along) + across2)
    share = (_ONE / (_ONE + exponential(-_STEEP * inside)) - _TAIL) * _WHOLE
    return share if share > 0 else np.float32(0.0)


@njit(parallel=loops_only(), cache=True, fastmath={"contract"}, error_model="numpy")
def scatter(values, radii, reach, sums, weights):  # type: ignore[no-untyped-def]
    """Adds to sums (4, H, W) and weights (H, W) what each pixel of values (4, H, W) gives to those around it.

    Each task owns the rows it writes, so that the order of additions does not depend on threads.
    """
    height, width = radii.shape
    for y in prange(height):
        for sy in range(max(0, y - reach), min(height, y + reach + 1)):
            across2 = np.float32((sy - y) * (sy - y))
            for sx in range(width):
                radius = radii[sy, sx]
                room = (radius + _ONE) * (radius + _ONE) - across2
                # Also of a radius that is not a number, whose square root would be any place in memory.
                if not room > 0:
                    continue
                half = int(np.sqrt(room))
                power = _ONE / (radius * radius + _SHARPEST)
                a, b = values[0, sy, sx], values[1, sy, sx]
                c, d = values[2, sy, sx], values[3, sy, sx]
                for x in range(np.uint64(max(0, sx - half)), np.uint64(min(width, sx + half + 1))):
                    weight = power * _share(radius, np.float32(np.int32(x) - np.int32(sx)), across2)
                    sums[0, y, x] += weight * a
                    sums[1, y, x] += weight * b
                    sums[2, y, x] += weight * c
                    sums[3, y, x] += weight * d
                    weights[y, x] += weight


@njit(parallel=loops_only(), cache=True, fastmath={"contract", "reassoc", "nsz"}, error_model="numpy")
def scatter_backward(values, radii, reach, given, of_weight, by_values, by_radii):  # type: ignore[no-untyped-def]
    """The gradient by values and radii from the one by sums, `given` (4, H, W), and by weights, `of_weight` (H, W)."""
    height, width = radii.shape
    for sy in prange(height):
        for sx in range(width):
            radius = radii[sy, sx]
            power = _ONE / (radius * radius + _SHARPEST)
            a, b = values[0, sy, sx], values[1, sy, sx]
            c, d = values[2, sy, sx], values[3, sy, sx]
            of_a = of_b = of_c = of_d = np.float32(0.0)
            shares = slopes = np.float32(0.0)
            for y in range(max(0, sy - reach), min(height, sy + reach + 1)):
                across2 = np.float32((sy - y) * (sy - y))
                room = (radius + _ONE) * (radius + _ONE) - across2
                if not room > 0:
                    continue
                half = int(np.sqrt(room))
                for x in range(np.uint64(max(0, sx - half)), np.uint64(min(width, sx + half + 1))):
                    share = _share(radius, np.float32(np.int32(x) - np.int32(sx)), across2)
                    ga, gb, gc, gd = given[0, y, x], given[1, y, x], given[2, y, x], given[3, y, x]
                    of_a += share * ga
                    of_b += share * gb
                    of_c += share * gc
                    of_d += share * gd
                    gained = a * ga + b * gb + c * gc + d * gd + of_weight[y, x]
                    shares += share * gained
                    whole = share * (_ONE - _TAIL) + _TAIL
                    slopes += (_STEEP * _WHOLE * whole * (_ONE - whole) if share > 0 else np.float32(0.0)) * gained
            by_values[0, sy, sx], by_values[1, sy, sx] = power * of_a, power * of_b
            by_values[2, sy, sx], by_values[3, sy, sx] = power * of_c, power * of_d
            by_radii[sy, sx] = power * slopes - np.float32(2.0) * radius * power * power * shares
