"""From splats to the few numbers a pixel of a cut or slab needs and back, a thread a splat, in float64.

As in `kernels.cpu.section_geometry`: with z = (j − j₀, i − i₀, 1) from a reference pixel, a pixel lies at
(x, y, m) = C z in standard deviations. Of a cut w = exp(−½(x² + y² + m²)), with m the same in all pixels; of a slab m
runs along the normal and w = exp(−½(x² + y²)) · mean of exp(−½(m + t)²) over t in ±η. The reference pixel and the
basis of x and y only say how the numbers are written, so no gradient goes through them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from torch import Tensor

from ....views import Plane
from .blocks import launch_threads, view
from .linear import plane_basis, quadratic_range, triangular
from .pixels import OnImage, drawn_in, nearest_pixel, pixel_range, rest_of
from .rotations import ONE, TWO, ZERO
from .section_raster import Row
from .whitening import White, scales_backward, white_backward, white_of

_HALF, _THREE, _MARGIN = (wp.constant(wp.float64(number)) for number in (0.5, 3.0, 100.0))


@wp.struct
class Slab:
    """A `Plane` in mm and pixels with its unit normal, the cutoff in standard deviations; a thickness of 0 is a cut."""

    origin: wp.vec3d
    u: wp.vec3d
    v: wp.vec3d
    normal: wp.vec3d
    thickness: wp.float64
    width: wp.float64
    height: wp.float64
    cutoff: wp.float64
    keep_empty: wp.bool


def slab_of(plane: Plane, cutoff_sigmas: float, keep_empty: bool) -> Any:
    """`Slab`; `keep_empty` draws splats of amount 0, which the gradient of their amount needs."""
    slab = Slab()
    for name in ("origin", "u", "v", "normal"):
        setattr(slab, name, wp.vec3d(*np.asarray(getattr(plane, name), np.float64).tolist()))
    slab.width, slab.height = float(plane.width), float(plane.height)
    slab.thickness = max(float(plane.thickness_mm), 0.0)
    slab.cutoff, slab.keep_empty = float(cutoff_sigmas), keep_empty
    return slab


def project(parameters: tuple[Tensor, ...], slab: Any) -> OnImage:
    """Splats that cannot be drawn are left out.

    Args:
        parameters: means (N, 3), quats (N, 4), scales (N, 3) and amount (N,), density or opacity; all float64.
        slab: of `slab_of`.
    """
    count, device = len(parameters[0]), parameters[0].device
    cuts = OnImage.unset(count, Row, device)
    outputs = [view(cuts.boxes, wp.vec4i), *cuts.of_pixels(Row)]
    launch_threads(_project, count, [*_views(parameters), slab, *outputs], device)
    return cuts


def project_backward(parameters: tuple[Tensor, ...], slab: Any, slot_starts: Tensor, totals: Tensor) -> list[Tensor]:
    """Gradients of the `parameters` of `project`.

    Args:
        slot_starts: of `tiles.Tiles`.
        totals: (N, GEOMETRY_SUMS and more) float64 sums over pixels; see `section_raster`.
    """
    gradients = [parameter.new_empty(parameter.shape) for parameter in parameters]
    inputs = [*_views(parameters), slab, view(slot_starts), view(totals), *_views(gradients)]
    launch_threads(_project_backward, len(totals), inputs, totals.device)
    return gradients


def _views(parameters: Any) -> list[Any]:
    """Warp arrays of means, quats, scales and amount."""
    vectors = (wp.vec3d, wp.vec4d, wp.vec3d, None)
    return [view(tensor, dtype) for tensor, dtype in zip(parameters, vectors, strict=True)]


@wp.struct
class _Cut:
    """Where a splat stands to the plane.

    right, down: the reference in pixels from the plane's corner. to_pixel: from the splat to it. q_1, q_2, q_3: the
    basis of x, y and m. c: C. length: of the whitened normal of a slab. eta: η.
    """

    right: wp.float64
    down: wp.float64
    to_pixel: wp.vec3d
    q_1: wp.vec3d
    q_2: wp.vec3d
    q_3: wp.vec3d
    c: wp.mat33d
    length: wp.float64
    eta: wp.float64


@wp.func
def _is_near(right: wp.float64, down: wp.float64, slab: Slab) -> bool:
    """Whether a place is no further than two image sizes off; others are drawn in."""
    return wp.abs(right) <= _THREE * slab.width + _MARGIN and wp.abs(down) <= _THREE * slab.height + _MARGIN


@wp.func
def _cut_of(mean: wp.vec3d, white: White, slab: Slab) -> _Cut:
    cut = _Cut()
    apart, area = mean - slab.origin, wp.length(wp.cross(slab.u, slab.v))
    y_u, y_v = white.matrix * slab.u, white.matrix * slab.v
    # The foot of the perpendicular from the centre.
    cut.right = wp.dot(apart, wp.cross(slab.v, slab.normal)) / area
    cut.down = wp.dot(apart, wp.cross(slab.normal, slab.u)) / area
    near = _is_near(cut.right, cut.down, slab)
    if not near:
        cut.right = drawn_in(cut.right, -TWO * slab.width, _THREE * slab.width)
        cut.down = drawn_in(cut.down, -TWO * slab.height, _THREE * slab.height)
    cut.to_pixel = cut.right * slab.u + cut.down * slab.v - apart
    y_0 = white.matrix * cut.to_pixel
    if slab.thickness > ZERO:
        through = white.matrix * slab.normal
        cut.length = wp.length(through)
        cut.eta = _HALF * slab.thickness * cut.length
        cut.q_3 = through / cut.length
        m_u, m_v = wp.dot(cut.q_3, y_u), wp.dot(cut.q_3, y_v)
        basis = plane_basis(y_u - m_u * cut.q_3, y_v - m_v * cut.q_3, cut.q_3)
        cut.q_1 = basis.q_1
        cut.q_2 = basis.q_2
        cut.c = wp.mat33d(
            wp.dot(cut.q_1, y_u), wp.dot(cut.q_1, y_v), wp.dot(cut.q_1, y_0),
            ZERO, wp.dot(cut.q_2, y_v), wp.dot(cut.q_2, y_0),
            m_u, m_v, wp.dot(cut.q_3, y_0),
        )  # fmt: skip
    else:
        # From there to the cut's own peak.
        t = triangular(y_u, y_v, y_0)
        step = -t.r23 / t.r22
        cut.right -= (t.r13 + t.r12 * step) / t.r11
        cut.down += step
        near = _is_near(cut.right, cut.down, slab)
        if not near:
            cut.right = drawn_in(cut.right, -TWO * slab.width, _THREE * slab.width)
            cut.down = drawn_in(cut.down, -TWO * slab.height, _THREE * slab.height)
        cut.to_pixel = cut.right * slab.u + cut.down * slab.v - apart
        t = triangular(y_u, y_v, white.matrix * cut.to_pixel)
        cut.q_1 = t.q_1
        cut.q_2 = t.q_2
        cut.q_3 = t.q_3
        cut.c = wp.mat33d(t.r11, t.r12, t.r13, ZERO, t.r22, t.r23, ZERO, ZERO, t.r33)
    if near:
        # At the reference x and y are 0 but for rounding; their gradients are not.
        cut.c[0, 2] = ZERO
        cut.c[1, 2] = ZERO
    return cut


@wp.func
def _column(c: wp.mat33d, column: int, weight: wp.float64) -> wp.vec3d:
    return wp.vec3d(c[0, column], c[1, column], weight * c[2, column])


@wp.func
def _bounds(c: wp.mat33d, weight: wp.float64, limit: wp.float64, axis: int) -> wp.vec2d:
    """Where along one image axis x² + y² + (weight·m)² ≤ limit for some place along the other; exact."""
    along, across = _column(c, axis, weight), _column(c, 1 - axis, weight)
    a, b = wp.cross(_column(c, 2, weight), across), wp.cross(along, across)
    return quadratic_range(wp.dot(b, b), wp.dot(a, b), wp.dot(a, a) - limit * wp.dot(across, across))


@wp.func
def _range_of(cut: _Cut, slab: Slab, axis: int, place: wp.float64, size: wp.float64) -> wp.vec2i:
    square = slab.cutoff * slab.cutoff
    found = _bounds(cut.c, ONE, square, axis)
    if slab.thickness > ZERO:
        whole = _bounds(cut.c, ZERO, square, axis)
        part = _bounds(cut.c, slab.cutoff / (slab.cutoff + cut.eta), TWO * square, axis)
        found = wp.vec2d(wp.max(whole[0], part[0]), wp.min(whole[1], part[1]))
    return pixel_range(found[0] + place, found[1] + place, size)


@wp.kernel(enable_backward=False)
def _project(
    means: wp.array(dtype=wp.vec3d),
    quats: wp.array(dtype=wp.vec4d),
    scales: wp.array(dtype=wp.vec3d),
    amounts: wp.array(dtype=wp.float64),
    slab: Slab,
    boxes: wp.array(dtype=wp.vec4i),
    wholes: wp.array(dtype=wp.vec2i),
    rests: wp.array(dtype=wp.vec2),
    rows: wp.array(dtype=Row),
):
    i = wp.tid()
    boxes[i] = wp.vec4i(0, 0, 0, 0)
    mean, quat, scale, amount = means[i], quats[i], scales[i], amounts[i]
    finite = wp.isfinite(mean) and wp.isfinite(quat) and wp.isfinite(amount)
    if not finite or wp.isnan(scale) or (amount == ZERO and not slab.keep_empty):
        return
    white = white_of(quat, scale)
    widest = ONE / wp.min(wp.min(white.inverse[0], white.inverse[1]), white.inverse[2])
    if wp.abs(wp.dot(mean - slab.origin, slab.normal)) > _HALF * slab.thickness + slab.cutoff * widest:
        return
    cut = _cut_of(mean, white, slab)
    rows[i] = Row(
        wp.float32(cut.c[0, 0]), wp.float32(cut.c[0, 1]), wp.float32(cut.c[0, 2]),
        wp.float32(cut.c[1, 1]), wp.float32(cut.c[1, 2]),
        wp.float32(cut.c[2, 0]), wp.float32(cut.c[2, 1]), wp.float32(cut.c[2, 2]),
        wp.float32(cut.eta), wp.float32(amount),
    )  # fmt: skip
    # Pixel (row i, column j) has its centre at j + 0.5.
    place = wp.vec2d(cut.right - _HALF, cut.down - _HALF)
    whole = nearest_pixel(place)
    wholes[i] = whole
    rests[i] = rest_of(place, whole)
    columns = _range_of(cut, slab, 0, place[0], slab.width)
    lines = _range_of(cut, slab, 1, place[1], slab.height)
    boxes[i] = wp.vec4i(columns[0], columns[1], lines[0], lines[1])


@wp.kernel(enable_backward=False)
def _project_backward(
    means: wp.array(dtype=wp.vec3d),
    quats: wp.array(dtype=wp.vec4d),
    scales: wp.array(dtype=wp.vec3d),
    amounts: wp.array(dtype=wp.float64),
    slab: Slab,
    slot_starts: wp.array(dtype=wp.int64),
    totals: wp.array2d(dtype=wp.float64),
    to_means: wp.array(dtype=wp.vec3d),
    to_quats: wp.array(dtype=wp.vec4d),
    to_scales: wp.array(dtype=wp.vec3d),
    to_amounts: wp.array(dtype=wp.float64),
):
    """From sums over pixels to gradients; zero for splats that no tile has."""
    i = wp.tid()
    to_amounts[i] = totals[i, 0]
    if slot_starts[i] == slot_starts[i + 1]:
        to_means[i] = wp.vec3d()
        to_quats[i] = wp.vec4d()
        to_scales[i] = wp.vec3d()
        return
    scale = scales[i]
    white = white_of(quats[i], scale)
    cut = _cut_of(means[i], white, slab)
    # ∂L/∂C by rows.
    to_x = -wp.vec3d(totals[i, 1], totals[i, 2], totals[i, 3])
    to_y = -wp.vec3d(totals[i, 4], totals[i, 5], totals[i, 6])
    to_m = wp.vec3d(totals[i, 7], totals[i, 8], totals[i, 9])
    # By columns, whitened.
    to_u = to_x[0] * cut.q_1 + to_y[0] * cut.q_2 + to_m[0] * cut.q_3
    to_v = to_x[1] * cut.q_1 + to_y[1] * cut.q_2 + to_m[1] * cut.q_3
    to_0 = to_x[2] * cut.q_1 + to_y[2] * cut.q_2 + to_m[2] * cut.q_3
    to_white = wp.outer(to_u, slab.u) + wp.outer(to_v, slab.v) + wp.outer(to_0, cut.to_pixel)
    if slab.thickness > ZERO:
        # As the normal's direction turns, m changes with x and y, and these with m.
        x, y, m = wp.vec3d(), wp.vec3d(), wp.vec3d()
        for k in range(3):
            x[k] = cut.c[0, k]
            y[k] = cut.c[1, k]
            m[k] = cut.c[2, k]
        turn = (wp.dot(to_m, x) - wp.dot(to_x, m)) * cut.q_1 + (wp.dot(to_m, y) - wp.dot(to_y, m)) * cut.q_2
        to_normal = turn / cut.length + totals[i, 10] * _HALF * slab.thickness * cut.q_3
        to_white += wp.outer(to_normal, slab.normal)
    to_means[i] = -(wp.transpose(white.matrix) * to_0)
    to_quats[i] = white_backward(white, to_white)
    to_scales[i] = scales_backward(white, scale, to_white)
