"""From splats to the few numbers a pixel of a cut or slab needs, in torch float64, so that autograd leads back.

As in `kernels.cpu.section_geometry`: with z = (j − j₀, i − i₀, 1) from a reference pixel, a pixel lies at
(x, y, m) = C z in standard deviations. Of a cut w = exp(−½(x² + y² + m²)), with m the same in all pixels; of a slab m
runs along the normal and w = exp(−½(x² + y²)) · mean of exp(−½(m + t)²) over t in ±η. The reference pixel and the
basis of x and y only say how the numbers are written, so no gradient goes through them.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ....views import Plane
from ..reference.radiograph import finite_shapes
from .linear import cross, dot, multiply, pixel_range, plane_basis, quadratic_range, triangular, whitening


class Cuts(NamedTuple):
    """M splats as the plane's pixels see them.

    Attributes:
        chosen: (M,) rows of the set.
        coefficients: (M, 3, 3) C, upper triangular in value but for a slab's third row.
        eta: (M,) η, half the thickness in standard deviations; 0 for a cut.
        amount: (M,) density or opacity.
        reference: (M, 2) j₀, i₀ counted from the centre of the first pixel.
        boxes: (M, 4) int64 pixels outside of which nothing reaches the cutoff; see `tiles.bin_boxes`.
    """

    chosen: Tensor
    coefficients: Tensor
    eta: Tensor
    amount: Tensor
    reference: Tensor
    boxes: Tensor


def project(means: Tensor, quats: Tensor, scales: Tensor, amount: Tensor, plane: Plane, cutoff_sigmas: float) -> Cuts:
    """Splats that cannot be drawn are left out, and those of amount 0 unless its gradient is wanted."""
    means, quats, scales, amount = (value.double() for value in (means, quats, scales, amount))
    origin, u, v, normal = (torch.as_tensor(x).to(means) for x in (plane.origin, plane.u, plane.v, plane.normal))
    thickness = max(float(plane.thickness_mm), 0.0)
    rotations, scales, amount, usable = finite_shapes(means, quats, scales, amount)
    with torch.no_grad():
        reach = 0.5 * thickness + cutoff_sigmas * scales.amax(dim=1)
        drawn = usable & ((amount != 0) | amount.requires_grad) & (dot(means - origin, normal).abs() <= reach)
        chosen = drawn.nonzero().squeeze(1)
    means, amount = means[chosen], amount[chosen]
    whiten = whitening(rotations[chosen], scales[chosen])
    columns = [multiply(whiten, u), multiply(whiten, v)]

    def pixel_offset(pixel: Tensor) -> Tensor:
        return multiply(whiten, origin + pixel[:, :1] * u + pixel[:, 1:] * v - means)

    with torch.no_grad():
        side = cross(u, v)
        area = dot(side, side).sqrt()
        foot = torch.stack([dot(means - origin, cross(v, normal)), dot(means - origin, cross(normal, u))], dim=1)
        pixel, exact = _draw_in(foot / area, plane)
        if thickness == 0:
            upper, _ = triangular([*columns, pixel_offset(pixel)])
            step = -upper[:, 1, 2] / upper[:, 1, 1]
            right = pixel[:, 0] - (upper[:, 0, 2] + upper[:, 0, 1] * step) / upper[:, 0, 0]
            pixel, exact = _draw_in(torch.stack([right, pixel[:, 1] + step], dim=1), plane)
    columns.append(pixel_offset(pixel))
    stacked = torch.stack(columns, dim=2)
    if thickness == 0:
        basis = triangular([column.detach() for column in columns])[1]
        coefficients = basis @ stacked
        eta = torch.zeros_like(amount)
    else:
        through = multiply(whiten, normal)
        length = through.norm(dim=1)
        axis = (through / length[:, None])[:, :, None]
        along = (axis * stacked).sum(dim=1, keepdim=True)
        across = stacked - axis * along
        plain = across.detach()
        basis = plane_basis(plain[:, :, 0], plain[:, :, 1], axis[:, :, 0].detach())
        coefficients = torch.cat([basis @ across, along], dim=1)
        eta = 0.5 * thickness * length
    # At the reference x and y are 0 but for rounding; their gradients are not.
    zero = torch.zeros_like(coefficients, dtype=torch.bool)
    zero[:, :2, 2] = exact[:, None]
    coefficients = torch.where(zero, coefficients - coefficients.detach(), coefficients)
    with torch.no_grad():
        reference = pixel - 0.5
        boxes = _boxes(coefficients, eta, reference, plane, thickness, cutoff_sigmas)
    return Cuts(chosen, coefficients, eta, amount, reference, boxes)


def _draw_in(pixel: Tensor, plane: Plane) -> tuple[Tensor, Tensor]:
    """Reference pixels (M, 2) no further than two image sizes off, and which (M,) were not moved for it."""
    size = torch.tensor([plane.width, plane.height], device=pixel.device)
    exact = (pixel.abs() <= 3.0 * size + 100).all(1)
    moved = torch.where(pixel.isfinite(), pixel, 0.0)
    moved = torch.minimum(torch.maximum(moved, -2.0 * size), 3.0 * size)
    return torch.where(exact[:, None], pixel, moved), exact


def _boxes(
    coefficients: Tensor, eta: Tensor, reference: Tensor, plane: Plane, thickness: float, cutoff: float
) -> Tensor:
    ranges = []
    for axis, size in enumerate((plane.width, plane.height)):
        if thickness == 0:
            low, high = _bounds(coefficients, torch.ones_like(eta), cutoff**2, axis)
        else:
            low, high = _bounds(coefficients, torch.zeros_like(eta), cutoff**2, axis)
            others = _bounds(coefficients, cutoff / (cutoff + eta), 2 * cutoff**2, axis)
            low, high = torch.maximum(low, others[0]), torch.minimum(high, others[1])
        ranges.append(pixel_range(low + reference[:, axis], high + reference[:, axis], size))
    return torch.cat(ranges, dim=1)


def _bounds(coefficients: Tensor, weight: Tensor, limit: float, axis: int) -> tuple[Tensor, Tensor]:
    """Where along one image axis x² + y² + (weight·m)² ≤ limit for some place along the other; exact."""
    weights = torch.stack([torch.ones_like(weight), torch.ones_like(weight), weight], dim=1)
    columns = (coefficients * weights[:, :, None]).unbind(2)
    along, across = columns[axis], columns[1 - axis]
    a, b = cross(columns[2], across), cross(along, across)
    return quadratic_range(dot(b, b), dot(a, b), dot(a, a) - limit * dot(across, across))
