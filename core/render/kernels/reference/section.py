"""Plane cuts and slabs through Gaussians in plain torch: the truth the other kernels are tested against."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from ....views import Plane
from .radiograph import CHUNK_ELEMENTS, finite_shapes, whitened

THIN_SLAB = 1e-2
LARGEST_ALPHA = 1 - 1e-6
LEAST_WEIGHT = 1e-2


def sum_on_plane(means: Tensor, quats: Tensor, scales: Tensor, amount: Tensor, values: Tensor, plane: Plane) -> Tensor:
    """Σ amount·w·values, (height, width, channels).

    Args:
        means, quats, scales: (N, 3), (N, 4), (N, 3).
        amount: (N,) density or opacity.
        values: (N, channels).
        plane: where w is evaluated; its mean over the slab if the plane has a thickness.
    """
    total = means.new_zeros(plane.height * plane.width, values.shape[1]) + amount[:0].sum()
    for weights, part in _weights_by_chunk(means, quats, scales, amount, plane):
        # In float64, because a float32 sum of a hundred thousand like terms is off by as much as its order makes it.
        total = total + (weights.double().T @ values[part].double()).to(total)
    return total.reshape(plane.height, plane.width, -1)


def occupancy_on_plane(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, plane: Plane) -> Tensor:
    """1 − Π(1 − o·w), (height, width). o·w is kept at or under 1 − 1e-6 so that no factor is zero."""
    log_empty = means.new_zeros(plane.height * plane.width) + opacities[:0].sum()
    for weights, _ in _weights_by_chunk(means, quats, scales, opacities, plane):
        log_empty = log_empty + torch.log1p(-weights.clamp(max=LARGEST_ALPHA)).sum(0)
    return -torch.expm1(log_empty).reshape(plane.height, plane.width)


def _weights_by_chunk(means: Tensor, quats: Tensor, scales: Tensor, amount: Tensor, plane: Plane):  # type: ignore[no-untyped-def]
    """Yields amount·w (n, pixels) and the slice of splats it belongs to."""
    rotations, scales, amount, usable = finite_shapes(means, quats, scales, amount)
    means = torch.where(usable[:, None], means, torch.zeros_like(means))
    points = torch.as_tensor(plane.points().reshape(-1, 3)).to(means)
    normal = torch.as_tensor(plane.normal).to(means)
    per_chunk = max(1, CHUNK_ELEMENTS // len(points))
    for start in range(0, len(means), per_chunk):
        part = slice(start, start + per_chunk)
        weights = checkpoint(
            _weights,
            means[part],
            rotations[part],
            scales[part],
            points,
            normal,
            plane.thickness_mm,
            use_reentrant=False,
        )
        yield amount[part, None] * weights, part


def _weights(
    means: Tensor, rotations: Tensor, scales: Tensor, points: Tensor, normal: Tensor, thickness: float
) -> Tensor:
    """w at points (P, 3), or its mean over ±thickness/2 along the normal: (n, P)."""
    y = whitened(rotations, scales, points - means[:, None, :])
    if thickness <= 0:
        return torch.exp(-0.5 * (y * y).sum(-1))
    through = whitened(rotations, scales, normal[None, :])
    length = through.norm(dim=-1)
    axis = through / length[..., None]
    across = torch.linalg.cross(y, axis.expand_as(y))
    along = (y * axis).sum(-1)
    return torch.exp(-0.5 * (across * across).sum(-1)) * _mean_over_slab(along, 0.5 * thickness * length)


def _mean_over_slab(along: Tensor, half: Tensor) -> Tensor:
    """Mean of exp(−½(along + t)²) over t in ±half, both in standard deviations.

    A thin slab's two CDFs cancel, so it is taken from the Taylor series of the integral instead.
    """
    half = half.expand_as(along)
    thin = half < THIN_SLAB
    h2, a2 = half * half, along * along
    series = torch.exp(-0.5 * a2) * (1 + h2 / 6 * (a2 - 1) + h2 * h2 / 120 * (a2 * a2 - 6 * a2 + 3))
    thick = torch.where(thin, torch.ones_like(half), half)
    away = along.abs()
    difference = torch.special.ndtr(thick - away) - torch.special.ndtr(-thick - away)
    return torch.where(thin, series, difference * (math.sqrt(2 * math.pi) / 2) / thick)
