"""From splats to the few numbers a pixel of a radiograph needs, in torch float64, so that autograd leads back.

As in `kernels.cpu.radiograph_geometry`: with z = (j − j₀, i − i₀, 1) measured from where the centre projects to, a
pixel's line integral is amplitude · den^(−1/2) · exp(−½·num/den), num = ‖P z‖², den = ‖E z‖² (1 unless the beam is
a cone). P = Q·G with an orthonormal basis Q of the plane that G's columns lie in. The pixel (j₀, i₀), Q and a common
factor of P and E only say how the numbers are written, so no gradient goes through them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from ....views import Detector
from ..reference.radiograph import NEAREST_AFFINE_DEPTH, SQRT_2PI, detector_tensors, finite_shapes
from .linear import cross, dot, multiply, pixel_range, plane_basis, quadratic_range, triangular, whitening

CONE, PARALLEL, AFFINE = range(3)


class Rays(NamedTuple):
    """M splats as the detector's pixels see them.

    Attributes:
        numerator: (M, 2, 3) P, upper triangular in value.
        denominator: (M, 3, 3) columns of E; None where den is 1.
        amplitude: (M,).
        reference: (M, 2) j₀, i₀.
        upper: (M, 3, 3) the triangular factor of E.
        boxes: (M, 4) int64 pixels outside of which nothing reaches the cutoff; see `tiles.bin_boxes`.
    """

    numerator: Tensor
    denominator: Tensor | None
    amplitude: Tensor
    reference: Tensor
    upper: Tensor
    boxes: Tensor


def project(
    means: Tensor, quats: Tensor, scales: Tensor, density: Tensor, detector: Detector, mode: str, cutoff_sigmas: float
) -> Rays:
    """Splats that cannot be drawn are left out, and those without density unless its gradient is wanted."""
    means, quats, scales, density = (value.double() for value in (means, quats, scales, density))
    source, center, u, v = detector_tensors(detector, means)
    kind = PARALLEL if detector.parallel else AFFINE if mode == "affine" else CONE
    rotations, scales, density, usable = finite_shapes(means, quats, scales, density)
    away = means - (center if kind == PARALLEL else source)
    with torch.no_grad():
        right, down, t, inside = _place(away, source, center, u, v, kind, detector)
        drawn = usable & ((density != 0) | density.requires_grad)
        if kind == AFFINE:
            drawn &= (t > 0) & (t < 1 / NEAREST_AFFINE_DEPTH)
        chosen = drawn.nonzero().squeeze(1)
        right, down, inside = right[chosen, None], down[chosen, None], inside[chosen, None]
    away, density = away[chosen], density[chosen]
    whiten = whitening(rotations[chosen], scales[chosen])

    if kind == PARALLEL:
        axis = multiply(whiten, source)
        columns = [-multiply(whiten, u), -multiply(whiten, v), multiply(whiten, away - right * u - down * v)]
        turned = [cross(column, axis) for column in columns]
    else:
        axis = multiply(whiten, away)
        base = center + right * u + down * v - source
        columns = [multiply(whiten, vector) for vector in (u, v, base)]
        turned = [cross(axis, column) for column in columns]
    # At the projected centre what is left of the cross product is rounding, but its gradient is not.
    turned[2] = torch.where(inside, turned[2] - turned[2].detach(), turned[2])

    numbers = [column.detach() for column in turned]
    basis = plane_basis(numbers[0], numbers[1], axis.detach())
    upper = torch.zeros_like(whiten)
    upper[:, 2, 2] = 1.0
    denominator = None
    if kind == CONE:
        size = columns[2].detach().norm(dim=1)
        factor = 1 / torch.where(size > 0, size, 1.0)
        amplitude = SQRT_2PI * density * factor
        denominator = torch.stack(columns, dim=2) * factor[:, None, None]
        upper = triangular(list(denominator.detach().unbind(2)))[0]
    elif kind == PARALLEL:
        factor = 1 / axis.norm(dim=1)
        amplitude = SQRT_2PI * density * factor
    else:
        normal = cross(u, v)
        t = dot(center - source, normal) / dot(away, normal)
        factor = 1 / (t * axis.norm(dim=1))
        amplitude = SQRT_2PI * density * away.norm(dim=1) / axis.norm(dim=1)
    numerator = basis @ torch.stack(turned, dim=2) * factor[:, None, None]
    with torch.no_grad():
        half = torch.tensor([0.5 * detector.width - 0.5, 0.5 * detector.height - 0.5], device=means.device)
        reference = torch.cat([right, down], dim=1) + half
        if kind == AFFINE:
            bounds = _ellipse_bounds(numerator, cutoff_sigmas)
        else:
            bounds = [_bounds(columns, axis, turned[2], by, kind, cutoff_sigmas**2) for by in (0, 1)]
        boxes = _boxes(bounds, reference, detector)
    return Rays(numerator, denominator, amplitude, reference, upper, boxes)


def _place(
    away: Tensor, source: Tensor, center: Tensor, u: Tensor, v: Tensor, kind: int, detector: Detector
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Where centres project to: steps along u and v from the detector's middle, t, and whether it is near the image.

    t is the distance of the detector in units of the centre's. Places further than two image sizes off are drawn in.
    """
    normal = cross(u, v)
    if kind == PARALLEL:
        t = -dot(away, normal) / dot(source, normal)
        on_plane = away + t[:, None] * source
    else:
        t = dot(center - source, normal) / dot(away, normal)
        on_plane = t[:, None] * away - (center - source)
    right = dot(on_plane, cross(v, normal)) / dot(normal, normal)
    down = dot(on_plane, cross(normal, u)) / dot(normal, normal)
    far_x, far_y = 2.5 * detector.width, 2.5 * detector.height
    inside = (right.abs() <= far_x + 100) & (down.abs() <= far_y + 100)
    drawn_in = [
        torch.where(value.isfinite(), value, 0.0).clamp(-far, far) for value, far in ((right, far_x), (down, far_y))
    ]
    return torch.where(inside, right, drawn_in[0]), torch.where(inside, down, drawn_in[1]), t, inside


def _bounds(
    columns: list[Tensor], axis: Tensor, offset: Tensor, by: int, kind: int, square: float
) -> tuple[Tensor, Tensor]:
    """Interval of j − j₀ (by = 0) or i − i₀ (1) outside of which no ray comes within the cutoff; exact.

    The rays of one pixel column span a plane with normal n(j) = a + j·b; its distance from the whitened centre is
    |α + β·j| / ‖n(j)‖. An ellipsoid that meets the plane through the source parallel to the detector is seen
    everywhere.
    """
    along, across = columns[by], columns[1 - by]
    if kind == PARALLEL:
        a, b = cross(axis, across), torch.zeros_like(axis)
        beta = dot(along, a)
    else:
        a, b = cross(columns[2], across), cross(along, across)
        beta = dot(axis, b)
    # In this order α is exactly 0 where the reference is the projected centre.
    alpha = dot(offset, across)
    return quadratic_range(
        beta * beta - square * dot(b, b), alpha * beta - square * dot(a, b), alpha * alpha - square * dot(a, a)
    )


def _ellipse_bounds(numerator: Tensor, cutoff: float) -> list[tuple[Tensor, Tensor]]:
    """Both intervals of the ellipses ‖P z‖ ≤ cutoff; NaN, everything, where an ellipse has no end."""
    p11, p12, p13 = numerator[:, 0].unbind(1)
    p22, p23 = numerator[:, 1, 1], numerator[:, 1, 2]
    area = (p11 * p22).abs()
    area = torch.where(area > 0, area, math.nan)
    y = -p23 / p22
    x = -(p13 + p12 * y) / p11
    half_x, half_y = cutoff * torch.hypot(p12, p22) / area, cutoff * p11.abs() / area
    return [(x - half_x, x + half_x), (y - half_y, y + half_y)]


def _boxes(bounds: list[tuple[Tensor, Tensor]], reference: Tensor, detector: Detector) -> Tensor:
    sizes = (detector.width, detector.height)
    ranges = [
        pixel_range(low + reference[:, axis], high + reference[:, axis], sizes[axis])
        for axis, (low, high) in enumerate(bounds)
    ]
    return torch.cat(ranges, dim=1)
