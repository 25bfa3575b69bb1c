"""Small linear algebra on all splats at once, and where on the image a splat can be seen."""

from __future__ import annotations

import torch
from torch import Tensor


def dot(left: Tensor, right: Tensor) -> Tensor:
    """(N,) products of vectors (N, 3) or (3,)."""
    return (left * right).sum(-1)


def cross(left: Tensor, right: Tensor) -> Tensor:
    """(N, 3) of vectors (N, 3) or (3,)."""
    return torch.linalg.cross(*torch.broadcast_tensors(left, right), dim=-1)


def whitening(rotations: Tensor, scales: Tensor) -> Tensor:
    """W = S⁻¹Rᵀ, (N, 3, 3), which turns a splat into a unit ball."""
    return rotations.transpose(1, 2) / scales[:, :, None]


def multiply(matrices: Tensor, vectors: Tensor) -> Tensor:
    """(N, 3) of matrices (N, 3, 3) and vectors (N, 3) or (3,)."""
    return (matrices * vectors.unsqueeze(-2)).sum(-1)


def split_pixels(reference: Tensor) -> tuple[Tensor, Tensor]:
    """Positions (N, 2) as whole pixels (int32) and what is left (float32), so that distances do not cancel."""
    whole = reference.round().clamp(-(1 << 30), 1 << 30)
    return whole.int(), (reference - whole).float()


def plane_basis(first: Tensor, second: Tensor, normal: Tensor) -> Tensor:
    """(N, 2, 3) orthonormal rows that span the plane at right angles to `normal`, `first` along the first.

    `first` and `second` lie in that plane; if `first` is zero, the second row is along `second`, and if both are
    (or the normal is), any two directions do, because nothing is left to be measured in them.
    """
    lengths = [vectors.norm(dim=1, keepdim=True) for vectors in (first, second, normal)]
    along, other, normal_length = (torch.where(length > 0, length, 1.0) for length in lengths)
    unit = normal / normal_length
    by_first = torch.stack([first / along, cross(unit, first / along)], dim=1)
    by_second = torch.stack([cross(second / other, unit), second / other], dim=1)
    basis = torch.where((lengths[0] > 0)[:, :, None], by_first, by_second)
    nothing = (lengths[2] == 0) | ((lengths[0] == 0) & (lengths[1] == 0))
    return torch.where(nothing[:, :, None], torch.eye(3, dtype=first.dtype, device=first.device)[:2], basis)


def triangular(columns: list[Tensor]) -> tuple[Tensor, Tensor]:
    """QR factorisation by Gram-Schmidt of matrices given as three columns (N, 3): R and, as rows, Q's columns.

    The second pass keeps the small part of nearly parallel columns (needles); where R's diagonal is zero, so is
    the row.
    """
    upper = columns[0].new_zeros(len(columns[0]), 3, 3)
    basis = torch.zeros_like(upper)
    for k, column in enumerate(columns):
        left = column
        for _ in range(2):
            for row in range(k):
                part = dot(basis[:, row], left)
                upper[:, row, k] += part
                left = left - part[:, None] * basis[:, row]
        length = left.norm(dim=1)
        upper[:, k, k] = length
        basis[:, k] = left / torch.where(length > 0, length, 1.0)[:, None]
    return upper, basis


def quadratic_range(a: Tensor, b: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    """Where a·x² + 2b·x + c ≤ 0: the interval, everything if a ≤ 0, and (∞, −∞) if it is nowhere."""
    discriminant = b * b - a * c
    half = discriminant.clamp_min(0).sqrt()
    bounded = a > 0
    nowhere = bounded & (discriminant < 0)
    low = torch.where(bounded, (-b - half) / a, -torch.inf)
    high = torch.where(bounded, (-b + half) / a, torch.inf)
    return torch.where(nowhere, torch.inf, low), torch.where(nowhere, -torch.inf, high)


def pixel_range(low: Tensor, high: Tensor, size: int) -> Tensor:
    """(N, 2) first and one past the last of the whole numbers in low..high within 0..size; NaN gives everything."""
    low = torch.where(low.isnan(), -torch.inf, low).clamp(0, size)
    high = torch.where(high.isnan(), torch.inf, high).clamp(-1, size - 1)
    return torch.stack([low.ceil().long(), high.floor().long() + 1], dim=1)
