"""X-ray line integrals of Gaussians in plain torch: the truth the other kernels are tested against.

Every splat is evaluated on every pixel's ray. Works in float32 and float64 on any torch device; memory stays
bounded because the splats are taken in chunks that are computed again in the backward pass.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from ....rotations import quats_to_matrices
from ....views import Detector

SQRT_2PI = math.sqrt(2 * math.pi)
CHUNK_ELEMENTS = 1 << 21
SMALLEST_SCALE, LARGEST_SCALE = 1e-12, 1e12
NEAREST_AFFINE_DEPTH = 0.01
"""The affine form is not drawn for centres nearer to the source than this part of the way to the detector."""


def line_integrals(
    means: Tensor, quats: Tensor, scales: Tensor, density: Tensor, detector: Detector, mode: str
) -> Tensor:
    """Σ of the line integrals ρ·√(2π/a)·exp(−½(c − b²/a)) over infinite lines, (height, width).

    Args:
        means, quats, scales, density: (N, 3), (N, 4), (N, 3), (N,), see `GaussianSet`.
        detector: its vectors may be torch tensors that require a gradient.
        mode: "exact", or "affine" for the local affine approximation of R2-Gaussian (arXiv 2405.20693).
    """
    source, center, u, v = detector_tensors(detector, means.double())
    pixels = detector_pixels(detector, center, u, v)
    # The empty sum keeps the image part of the graph when there are no splats.
    total = means.new_zeros(len(pixels)) + density[:0].sum()
    if len(means):
        splats = (means, *finite_shapes(means, quats, scales, density))
        per_chunk = max(1, CHUNK_ELEMENTS // len(pixels))
        evaluate = _exact if mode == "exact" else _affine
        for start in range(0, len(means), per_chunk):
            part = [value[start : start + per_chunk] for value in splats]
            total = total + checkpoint(evaluate, *part, detector, source, center, u, v, pixels, use_reentrant=False)
    return total.reshape(detector.height, detector.width)


def detector_tensors(detector: Detector, like: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """source (unit direction of a parallel beam), center, u, v as tensors of `like`'s type and device."""
    source, center, u, v = (
        torch.as_tensor(value).to(like) for value in (detector.source, detector.center, detector.u, detector.v)
    )
    return (source / source.norm() if detector.parallel else source), center, u, v


def detector_pixels(detector: Detector, center: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """(height · width, 3) pixel centres in mm."""
    columns = torch.arange(detector.width, dtype=u.dtype, device=u.device) + (0.5 - detector.width / 2)
    rows = torch.arange(detector.height, dtype=u.dtype, device=u.device) + (0.5 - detector.height / 2)
    return (center + rows[:, None, None] * v + columns[None, :, None] * u).reshape(-1, 3)


def finite_shapes(
    means: Tensor, quats: Tensor, scales: Tensor, amount: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Rotations (N, 3, 3), scales, usable amounts (N,) and the mask (N,) of splats with finite parameters.

    A zero quaternion becomes the identity; scales are kept within 1e-12..1e12; the amount (density or opacity) of
    a splat with a NaN or infinite parameter becomes 0.
    """
    usable = means.isfinite().all(-1) & quats.isfinite().all(-1) & ~scales.isnan().any(-1) & amount.isfinite()
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=quats.dtype, device=quats.device)
    turned = usable & ((quats * quats).sum(-1) > 1e-24)
    quats = torch.where(turned[:, None], quats, identity)
    rotations = quats_to_matrices(quats / quats.norm(dim=-1, keepdim=True))
    scales = torch.where(usable[:, None], scales, torch.ones_like(scales))
    amount = torch.where(usable, amount, torch.zeros_like(amount))
    return rotations, scales.clamp(SMALLEST_SCALE, LARGEST_SCALE), amount, usable


def whitened(rotations: Tensor, scales: Tensor, vectors: Tensor) -> Tensor:
    """S⁻¹Rᵀ of vectors (P, 3) common to all splats, or (N, P, 3), one list for each: (N, P, 3)."""
    return (vectors @ rotations) / scales[:, None, :]


def _exact(
    means: Tensor,
    rotations: Tensor,
    scales: Tensor,
    density: Tensor,
    usable: Tensor,
    detector: Detector,
    source: Tensor,
    center: Tensor,
    u: Tensor,
    v: Tensor,
    pixels: Tensor,
) -> Tensor:
    means = torch.where(usable[:, None], means, torch.zeros_like(means))
    # Rays from float64, each from its point nearest to the splats, so that the coordinates that float32 has to hold
    # are no larger than the scene, however far away the origin, the source and the detector are.
    middle = means.detach().double().median(0).values
    pixels, source = pixels.double() - middle, source.double()
    if detector.parallel:
        starts, rays = pixels, source.expand_as(pixels)
    else:
        starts = (source - middle).expand_as(pixels)
        rays = pixels - starts
        rays = rays / rays.norm(dim=-1, keepdim=True)
    origins = (starts - (starts * rays).sum(-1, keepdim=True) * rays).to(means)
    directions = rays.to(means)
    apart = (means.double() - middle).to(means)[:, None, :] - origins
    across = apart - (apart * directions).sum(-1, keepdim=True) * directions
    e = whitened(rotations, scales, directions)
    f = whitened(rotations, scales, across)
    length = e.norm(dim=-1)
    distance = torch.linalg.cross(f, e / length[..., None])
    return (density[:, None] * SQRT_2PI / length * torch.exp(-0.5 * (distance * distance).sum(-1))).sum(0)


def _affine(
    means: Tensor,
    rotations: Tensor,
    scales: Tensor,
    density: Tensor,
    usable: Tensor,
    detector: Detector,
    source: Tensor,
    center: Tensor,
    u: Tensor,
    v: Tensor,
    pixels: Tensor,
) -> Tensor:
    """The projection linearised at each centre: a 2D Gaussian with the integral along the central ray.

    Σ̂₂ = M Mᵀ with M = J₂ R S (2, 3), so |Σ̂₂| = ‖M₀ × M₁‖² and δᵀΣ̂₂⁻¹δ = ‖M₁δ₀ − M₀δ₁‖² / |Σ̂₂|: neither a
    determinant nor an inverse that could lose its sign. |Σ̂₃|/|Σ̂₂| is the variance along the central ray, 1/a.
    """
    width, height = detector.width, detector.height
    source, center, u, v = (vector.to(means) for vector in (source, center, u, v))
    drawn = usable
    means = torch.where(drawn[:, None], means, torch.zeros_like(means))
    apart = means - (center if detector.parallel else source)
    frame = torch.linalg.inv(torch.stack([u, v, source if detector.parallel else center - source], dim=-1))
    local = apart @ frame.T
    if detector.parallel:
        position = local[:, :2]
        jacobian = frame[:2].expand(len(means), 2, 3)
        directions = source.expand(len(means), 3)
    else:
        drawn = drawn & (local[:, 2] > NEAREST_AFFINE_DEPTH)
        local = torch.where(drawn[:, None], local, torch.ones_like(local))
        apart = torch.where(drawn[:, None], apart, torch.ones_like(apart))
        depth = local[:, 2:]
        position = local[:, :2] / depth
        jacobian = (frame[:2] - position[:, :, None] * frame[2]) / depth[:, :, None]
        directions = apart / apart.norm(dim=-1, keepdim=True)
    factors = (jacobian @ rotations) * scales[:, None, :]
    along = whitened(rotations, scales, directions[:, None, :])[:, 0].norm(dim=-1)
    columns = torch.arange(width, dtype=means.dtype, device=means.device) + (0.5 - width / 2)
    rows = torch.arange(height, dtype=means.dtype, device=means.device) + (0.5 - height / 2)
    right = (columns - position[:, :1])[:, None, :, None]
    down = (rows - position[:, 1:])[:, :, None, None]
    first, second = factors[:, None, None, 0], factors[:, None, None, 1]
    area = torch.linalg.cross(factors[:, 0], factors[:, 1]).norm(dim=-1)
    offset = (second * right - first * down) / area[:, None, None, None]
    peak = torch.where(drawn, density * SQRT_2PI / along, torch.zeros_like(density))
    return (peak[:, None, None] * torch.exp(-0.5 * (offset * offset).sum(-1))).sum(0).reshape(-1)
