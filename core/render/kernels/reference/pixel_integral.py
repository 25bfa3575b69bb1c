"""A splat's mean over a pixel instead of its value at the pixel's centre.

Analytic-Splatting (Liang et al. 2024, arXiv 2403.11056): α = min(0.99, o·I) with I a product of two differences of
normal distribution functions, Φ(x) ≈ 1 / (1 + exp(−1.6x − 0.07x³)), times 2πσ₁σ₂; no low-pass.

The paper takes the differences along the eigenvectors of Σ' over a pixel turned to them. Those have no limit where a
splat becomes round, so neither has I, and its gradient grows with 1/(λ₁ − λ₂). Here one difference is over the pixel's
row and the other over x given the row, which is the paper's I for splats along the axes and round ones. A slanted
splat's x at a row is xy/(yy + 1/12)·y: its mean where y is somewhere in the row and not at its centre; the variance is
xx − xy²/(yy + 1/12). All is smooth in Σ', and both differences telescope: whatever lies where, the pixels' sum is
2π√|Σ'|. Against the true means over pixels the error is about that of the eigenvectors' form for splats from 0.2 px
across, and less for thinner ones: half of it for needles of 0.05 px, a twentieth for rounder splats of that size.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

# Variance of a place somewhere in a pixel.
PIXEL_VARIANCE = 1.0 / 12.0
# Of Φ's approximation.
LINEAR, CUBIC = 1.6, 0.07
# Squared pixels added to variances, so that a splat of no width has finite numbers.
LEAST_VARIANCE = 1e-8
# How much a splat's I may exceed exp(−½r²) with r the distance from the nearest point of the pixel in standard
# deviations: 1 % for Φ's approximation in either direction, and so that r > 0 where a splat is just drawn.
MARGIN = 1.05
# Of the footprint's ellipse, for rounding.
SLACK = 1e-3
# Least share of the ellipse in its sum with the pixel; without a bound a point's would have no size.
LEAST_SHARE = 0.1
_FARTHEST = 1e6
_CLAMP = 60.0


def integral(cov: Tensor) -> Tensor:
    """1/σy, 1/σx of x given the row, k of the mean k·y of x, and 2π√|Σ'| / (2πσxσy): (M, 4).

    Args:
        cov: (M, 4) Σ' without low-pass as xx, xy, yy in squared pixels, and its determinant.
    """
    xx, xy, yy, det = cov.unbind(1)
    row = yy + PIXEL_VARIANCE
    of_y = yy + LEAST_VARIANCE
    # xx − xy²/row without the difference.
    of_x = (det + PIXEL_VARIANCE * xx) / row + LEAST_VARIANCE
    return torch.stack([of_y.rsqrt(), of_x.rsqrt(), xy / row, torch.sqrt(det / of_x / of_y)], dim=1)


def largest(integral: Tensor, opacities: Tensor) -> Tensor:
    """(M,) what α cannot exceed."""
    inverse_y, inverse_x, _, ratio = integral.unbind(1)
    root = math.sqrt(2 * math.pi)
    return opacities * ratio * (root / inverse_y).clamp_max(1.0) * (root / inverse_x).clamp_max(1.0)


def half_extents(integral: Tensor, opacities: Tensor, least: float) -> Tensor:
    """(M, 2) half sides in pixels of the box around the ellipse outside of which α < `least`.

    In (x − k·y, y) a splat lies along the axes. Its ellipse at r and a pixel's circumscribed circle, radius √½, have
    their sum within the ellipse of half axes² (1 + 1/p)·r²σ² + (1 + p)/2 for any p > 0.
    """
    inverse_y, inverse_x, k, _ = integral.unbind(1)
    squared = 2 * torch.log((MARGIN / least) * largest(integral, opacities)).clamp_min(0)
    of_x, of_y = squared / inverse_x.square(), squared / inverse_y.square()
    share = torch.sqrt(of_x + of_y).clamp_min(LEAST_SHARE)
    across = (1 + 1 / share) * of_x + 0.5 * (1 + share)
    down = (1 + 1 / share) * of_y + 0.5 * (1 + share)
    return (1 + SLACK) * torch.stack([torch.sqrt(across + k.square() * down), down.sqrt()], dim=1)


def window(x: Tensor, inverse: Tensor) -> Tensor:
    """√(2π)σ·(Φ((x + ½)/σ) − Φ((x − ½)/σ)) with 1/σ = `inverse`: mean of exp(−½x²/σ²) over a pixel.

    With t(x) = 1.6x + 0.07x³ the difference is Φ(b)·Φ(−a)·(1 − exp(t(a) − t(b))), which keeps its digits however wide
    the splat is.
    """
    half = 0.5 * inverse
    middle = (x * inverse).clamp(-_FARTHEST, _FARTHEST)
    low, high = middle - half, middle + half
    low, high = ((at * (LINEAR + CUBIC * at * at)).clamp(-_CLAMP, _CLAMP) for at in (low, high))
    slope = LINEAR + CUBIC * (3 * middle * middle + half * half)
    apart = (inverse * slope).clamp_min(1e-30)
    return math.sqrt(2 * math.pi) * torch.sigmoid(high) * torch.sigmoid(-low) * slope * (-torch.expm1(-apart) / apart)
