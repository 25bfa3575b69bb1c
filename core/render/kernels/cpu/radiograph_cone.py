"""The geometry of `radiograph_geometry` for an exact cone beam: to the pixel rows' numbers, and from sums back.

Everything is written out in scalars, without a branch or a library call, so that LLVM carries out the loop over splats
several splats at a time.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from .bands import SUMS
from .radiograph_table import (
    A_AT,
    AMPLITUDE,
    BOTTOM,
    COLUMN0,
    LEFT,
    RIGHT,
    ROW0,
    SQRT_2PI,
    TOP,
    coefficients,
)
from .whitening import LARGEST_SCALE, SMALLEST_SCALE, pixel_range, usable

BATCH = 32
"""Splats that are turned around together: a loop over fewer has no full registers."""
# Planes of a batch's buffer, one float64 for each splat: what comes in, then what goes out.
_MEAN, _QUAT, _SCALE, _SUMS = (np.uint64(k * BATCH) for k in (0, 3, 7, 10))
_TO_MEAN, _TO_QUAT, _TO_SCALE, _TO_DENSITY, _TO_VIEW = (np.uint64(k * BATCH) for k in (23, 26, 30, 33, 34))
_KAPPA, _COLUMN0, _ROW0, _LOW, _HIGH, _UP, _DEEP = (np.uint64(k * BATCH) for k in range(10, 17))
_NUMBERS = np.uint64(17 * BATCH)
BUFFER = 46 * BATCH
_STEP = np.uint64(BATCH)


@njit(error_model="numpy", _nrt=False, forceinline=True)
def _dot(a: Any, b: Any) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(error_model="numpy", _nrt=False, forceinline=True)
def _cross(a: Any, b: Any) -> Any:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(error_model="numpy", _nrt=False, forceinline=True)
def _sum(x: Any, a: Any, y: Any, b: Any) -> Any:
    """x·a + y·b."""
    return x * a[0] + y * b[0], x * a[1] + y * b[1], x * a[2] + y * b[2]


@njit(error_model="numpy", _nrt=False, forceinline=True)
def _choose(condition: Any, a: Any, b: Any) -> Any:
    return a[0] if condition else b[0], a[1] if condition else b[1], a[2] if condition else b[2]


@njit(error_model="numpy", _nrt=False, forceinline=True)
def _turned(rows: Any, a: Any) -> Any:
    """Matrix times vector."""
    return _dot(rows[0], a), _dot(rows[1], a), _dot(rows[2], a)


@njit(error_model="numpy", _nrt=False, forceinline=True)
def _turned_back(rows: Any, a: Any) -> Any:
    """Transposed matrix times vector."""
    x, y, z = rows
    return (
        x[0] * a[0] + y[0] * a[1] + z[0] * a[2],
        x[1] * a[0] + y[1] * a[1] + z[1] * a[2],
        x[2] * a[0] + y[2] * a[1] + z[2] * a[2],
    )


class Whitening(NamedTuple):
    """W = S⁻¹Rᵀ, its rows, with the unit quaternion, what its length was (0: the identity), and 1/s."""

    rows: Any
    unit: Any
    length: Any
    inverse: Any


@njit(error_model="numpy", _nrt=False, forceinline=True)
def whitening(quat: Any, scale: Any) -> Any:
    """`Whitening` of (w, x, y, z) and three scales; see `whitening.fill_whitening`."""
    squared = quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3]
    turned = squared > 1e-24
    length = np.sqrt(squared) if turned else 0.0
    per = 1.0 / length if turned else 0.0
    w, x, y, z = quat[0] * per if turned else 1.0, quat[1] * per, quat[2] * per, quat[3] * per
    a = 1.0 / min(max(scale[0], SMALLEST_SCALE), LARGEST_SCALE)
    b = 1.0 / min(max(scale[1], SMALLEST_SCALE), LARGEST_SCALE)
    c = 1.0 / min(max(scale[2], SMALLEST_SCALE), LARGEST_SCALE)
    rows = (
        (a * (1 - 2 * (y * y + z * z)), a * (2 * (x * y + w * z)), a * (2 * (x * z - w * y))),
        (b * (2 * (x * y - w * z)), b * (1 - 2 * (x * x + z * z)), b * (2 * (y * z + w * x))),
        (c * (2 * (x * z + w * y)), c * (2 * (y * z - w * x)), c * (1 - 2 * (x * x + y * y))),
    )
    return Whitening(rows, (w, x, y, z), length, (a, b, c))


@njit(error_model="numpy", _nrt=False, forceinline=True)
def whitening_backward(white: Any, scale: Any, grad: Any) -> Any:
    """From the rows of dL/dW to the gradients of quaternion and scales; see `whitening.whitening_backward`."""
    rows, inverse = white.rows, white.inverse
    (m00, m10, m20), (m01, m11, m21), (m02, m12, m22) = (
        (grad[0][0] * inverse[0], grad[0][1] * inverse[0], grad[0][2] * inverse[0]),
        (grad[1][0] * inverse[1], grad[1][1] * inverse[1], grad[1][2] * inverse[1]),
        (grad[2][0] * inverse[2], grad[2][1] * inverse[2], grad[2][2] * inverse[2]),
    )
    to_scale = (
        -_dot(grad[0], rows[0]) * inverse[0] if SMALLEST_SCALE <= scale[0] <= LARGEST_SCALE else 0.0,
        -_dot(grad[1], rows[1]) * inverse[1] if SMALLEST_SCALE <= scale[1] <= LARGEST_SCALE else 0.0,
        -_dot(grad[2], rows[2]) * inverse[2] if SMALLEST_SCALE <= scale[2] <= LARGEST_SCALE else 0.0,
    )
    w, x, y, z = white.unit
    dw = 2 * (-z * m01 + y * m02 + z * m10 - x * m12 - y * m20 + x * m21)
    dx = 2 * (y * m01 + z * m02 + y * m10 - 2 * x * m11 - w * m12 + z * m20 + w * m21 - 2 * x * m22)
    dy = 2 * (-2 * y * m00 + x * m01 + w * m02 + x * m10 + z * m12 - w * m20 + z * m21 - 2 * y * m22)
    dz = 2 * (-2 * z * m00 - w * m01 + x * m02 + w * m10 - 2 * z * m11 + y * m12 + x * m20 + y * m21)
    radial = w * dw + x * dx + y * dy + z * dz
    per = 1.0 / white.length if white.length > 0.0 else 0.0
    to_quat = (dw - w * radial) * per, (dx - x * radial) * per, (dy - y * radial) * per, (dz - z * radial) * per
    return to_quat, to_scale


class Cone(NamedTuple):
    """Where a splat stands in a cone beam.

    Attributes:
        right, down: what it projects to, in steps along u and v from the detector's middle; drawn in where that is
            further than two image sizes off the image.
        away, base: from the source to the splat and to that place.
        f, e_u, e_v, e_0, g_u, g_v, g_0: columns of E, F and G.
        kappa: κ.
        q_1, q_2: basis of G's columns.
    """

    right: Any
    down: Any
    away: Any
    base: Any
    f: Any
    e_u: Any
    e_v: Any
    e_0: Any
    g_u: Any
    g_v: Any
    g_0: Any
    kappa: Any
    q_1: Any
    q_2: Any


@njit(error_model="numpy", _nrt=False, forceinline=True)
def cone(mean: Any, rows: Any, view: Any, width: Any, height: Any) -> Any:
    """`Cone` of a splat with W's rows; `view` is source, center, u and v, three numbers each."""
    source, center, u, v = view
    normal = _cross(u, v)
    per_area = 1.0 / _dot(normal, normal)
    to_center = _sum(1.0, center, -1.0, source)
    away = _sum(1.0, mean, -1.0, source)
    depth = _dot(away, normal)
    t = _dot(to_center, normal) / depth
    on_plane = _sum(t, away, -1.0, to_center)
    right, down = _dot(on_plane, _cross(v, normal)) * per_area, _dot(on_plane, _cross(normal, u)) * per_area
    inside = (abs(right) <= 2.5 * width + 100) & (abs(down) <= 2.5 * height + 100)
    edge, bottom = 2.5 * width, 2.5 * height
    drawn_right = min(max(right, -edge), edge) if abs(right) < np.inf else 0.0
    drawn_down = min(max(down, -bottom), bottom) if abs(down) < np.inf else 0.0
    right, down = right if inside else drawn_right, down if inside else drawn_down
    aside = _sum(right, u, down, v)
    base = _sum(1.0, to_center, 1.0, aside)
    f, e_u, e_v, e_0 = _turned(rows, away), _turned(rows, u), _turned(rows, v), _turned(rows, base)
    g_u, g_v = _cross(f, e_u), _cross(f, e_v)
    # At the projected centre what is left of the cross product is rounding.
    g_0 = _choose(inside, (0.0, 0.0, 0.0), _cross(f, e_0))
    size = _dot(e_0, e_0)
    kappa = 1.0 / np.sqrt(size) if size > 0.0 else 1.0
    q_1, q_2 = _plane_basis(g_u, g_v, f)
    return Cone(right, down, away, base, f, e_u, e_v, e_0, g_u, g_v, g_0, kappa, q_1, q_2)


@njit(error_model="numpy", _nrt=False, forceinline=True)
def _plane_basis(first: Any, second: Any, normal: Any) -> Any:
    """As `whitening.plane_basis`."""
    one, two, three = _dot(first, first), _dot(second, second), _dot(normal, normal)
    flat, nothing = one > 0.0, (three == 0.0) | ((one == 0.0) & (two == 0.0))
    along = _choose(flat, first, second)
    per, per_normal = 1.0 / np.sqrt(one if flat else two), 1.0 / np.sqrt(three)
    q = _sum(per, along, 0.0, normal)
    across = _cross(normal, q)
    p = _sum(per_normal, across, 0.0, normal)
    back = _sum(-1.0, p, 0.0, p)
    q_1, q_2 = _choose(flat, q, back), _choose(flat, p, q)
    return _choose(nothing, (1.0, 0.0, 0.0), q_1), _choose(nothing, (0.0, 1.0, 0.0), q_2)


@njit(error_model="numpy", _nrt=False, forceinline=True)
def _three(lanes: Any, plane: Any, n: Any) -> Any:
    return lanes[plane + n], lanes[plane + _STEP + n], lanes[plane + _STEP + _STEP + n]


@njit(error_model="numpy", _nrt=False, forceinline=True)
def _put_three(lanes: Any, plane: Any, n: Any, a: Any) -> None:
    lanes[plane + n], lanes[plane + _STEP + n], lanes[plane + _STEP + _STEP + n] = a


@njit(error_model="numpy", _nrt=False)
def cone_backward(
    found: Any, count: Any, sums: Any, start: Any, means: Any, quats: Any, scales: Any, packed: Any, width: Any,
    height: Any, lanes: Any, grad_means: Any, grad_quats: Any, grad_scales: Any, grad_density: Any, grad_views: Any,
) -> None:  # fmt: skip
    """As `radiograph_geometry.geometry_backward`, for some of the splats from `start` on.

    Args:
        found: (BATCH,) rows of `sums`, which begin with that splat; the first `count` are meant.
        packed: (4, 3) source, center, u and v.
        lanes: (BUFFER,) float64, finite.
    """
    for m in range(np.uint64(count)):
        i = np.uint64(start) + found[m]
        for k in range(np.uint64(3)):
            lanes[_MEAN + k * _STEP + m], lanes[_SCALE + k * _STEP + m] = means[i, k], scales[i, k]
        for k in range(np.uint64(4)):
            lanes[_QUAT + k * _STEP + m] = quats[i, k]
        for k in range(np.uint64(SUMS)):
            lanes[_SUMS + k * _STEP + m] = sums[found[m], k]
    _turn_around(lanes, packed, width, height)
    for m in range(np.uint64(count)):
        i = np.uint64(start) + found[m]
        for k in range(np.uint64(3)):
            grad_means[i, k], grad_scales[i, k] = lanes[_TO_MEAN + k * _STEP + m], lanes[_TO_SCALE + k * _STEP + m]
        for k in range(np.uint64(4)):
            grad_quats[i, k] = lanes[_TO_QUAT + k * _STEP + m]
        grad_density[i] = lanes[_TO_DENSITY + m]
        if len(grad_views):
            for k in range(np.uint64(12)):
                grad_views[i, k // np.uint64(3), k % np.uint64(3)] = lanes[_TO_VIEW + k * _STEP + m]


@njit(error_model="numpy", fastmath={"contract"}, _nrt=False)
def _turn_around(lanes: Any, packed: Any, width: Any, height: Any) -> None:
    view = (
        (packed[0, 0], packed[0, 1], packed[0, 2]),
        (packed[1, 0], packed[1, 1], packed[1, 2]),
        (packed[2, 0], packed[2, 1], packed[2, 2]),
        (packed[3, 0], packed[3, 1], packed[3, 2]),
    )
    for n in range(np.uint64(BATCH)):
        scale = _three(lanes, _SCALE, n)
        quat = lanes[_QUAT + n], *_three(lanes, _QUAT + _STEP, n)
        white = whitening(quat, scale)
        c = cone(_three(lanes, _MEAN, n), white.rows, view, width, height)
        along_x, along_y = _three(lanes, _SUMS + _STEP, n), _three(lanes, _SUMS + np.uint64(4 * BATCH), n)
        s_uu, s_uv, s_vv = _three(lanes, _SUMS + np.uint64(7 * BATCH), n)
        s_u, s_v, s_1 = _three(lanes, _SUMS + np.uint64(10 * BATCH), n)
        twice, square = -2 * c.kappa, 2 * c.kappa * c.kappa
        d_gu = _sum(twice * along_x[0], c.q_1, twice * along_y[0], c.q_2)
        d_gv = _sum(twice * along_x[1], c.q_1, twice * along_y[1], c.q_2)
        d_g0 = _sum(twice * along_x[2], c.q_1, twice * along_y[2], c.q_2)
        d_eu = _sum(1.0, _sum(square * s_uu, c.e_u, square * s_uv, c.e_v), square * s_u, c.e_0)
        d_ev = _sum(1.0, _sum(square * s_uv, c.e_u, square * s_vv, c.e_v), square * s_v, c.e_0)
        d_e0 = _sum(1.0, _sum(square * s_u, c.e_u, square * s_v, c.e_v), square * s_1, c.e_0)
        d_eu = _sum(1.0, d_eu, 1.0, _cross(d_gu, c.f))
        d_ev = _sum(1.0, d_ev, 1.0, _cross(d_gv, c.f))
        d_e0 = _sum(1.0, d_e0, 1.0, _cross(d_g0, c.f))
        d_f = _sum(1.0, _cross(c.e_u, d_gu), 1.0, _cross(c.e_v, d_gv))
        d_f = _sum(1.0, d_f, 1.0, _cross(c.e_0, d_g0))
        to_mean, to_base = _turned_back(white.rows, d_f), _turned_back(white.rows, d_e0)
        d_white = (
            _row(d_eu[0], d_ev[0], d_e0[0], d_f[0], view, c),
            _row(d_eu[1], d_ev[1], d_e0[1], d_f[1], view, c),
            _row(d_eu[2], d_ev[2], d_e0[2], d_f[2], view, c),
        )
        to_quat, to_scale = whitening_backward(white, scale, d_white)
        _put_three(lanes, _TO_MEAN, n, to_mean)
        lanes[_TO_QUAT + n] = to_quat[0]
        _put_three(lanes, _TO_QUAT + _STEP, n, to_quat[1:])
        _put_three(lanes, _TO_SCALE, n, to_scale)
        lanes[_TO_DENSITY + n] = SQRT_2PI * c.kappa * lanes[_SUMS + n]
        _put_three(lanes, _TO_VIEW, n, _sum(-1.0, to_mean, -1.0, to_base))
        _put_three(lanes, _TO_VIEW + np.uint64(3 * BATCH), n, to_base)
        to_u = _sum(c.right, to_base, 1.0, _turned_back(white.rows, d_eu))
        _put_three(lanes, _TO_VIEW + np.uint64(6 * BATCH), n, to_u)
        to_v = _sum(c.down, to_base, 1.0, _turned_back(white.rows, d_ev))
        _put_three(lanes, _TO_VIEW + np.uint64(9 * BATCH), n, to_v)


@njit(error_model="numpy", _nrt=False, forceinline=True)
def _row(to_u: Any, to_v: Any, to_base: Any, to_away: Any, view: Any, c: Any) -> Any:
    """A row of dL/dW."""
    return _sum(1.0, _sum(to_u, view[2], to_v, view[3]), 1.0, _sum(to_base, c.base, to_away, c.away))


@njit(error_model="numpy", _nrt=False, forceinline=True)
def _less(x: Any, part: Any, q: Any) -> Any:
    return x[0] - part * q[0], x[1] - part * q[1], x[2] - part * q[2]


@njit(error_model="numpy", _nrt=False, forceinline=True)
def _unit(x: Any) -> Any:
    """Length and direction, which is 0 for a length of 0."""
    length = np.sqrt(_dot(x, x))
    per = 1.0 / length if length > 0.0 else 0.0
    return length, (x[0] * per, x[1] * per, x[2] * per)


@njit(error_model="numpy", _nrt=False, forceinline=True)
def _triangular(first: Any, second: Any, third: Any) -> Any:
    """R's numbers r₁₁, r₁₂, r₁₃, r₂₂, r₂₃, r₃₃; as `whitening.triangular`, each column in two passes."""
    r11, q_1 = _unit(first)
    r12 = _dot(q_1, second)
    second = _less(second, r12, q_1)
    more = _dot(q_1, second)
    r22, q_2 = _unit(_less(second, more, q_1))
    r13 = _dot(q_1, third)
    third = _less(third, r13, q_1)
    r23 = _dot(q_2, third)
    third = _less(third, r23, q_2)
    more_1 = _dot(q_1, third)
    third = _less(third, more_1, q_1)
    more_2 = _dot(q_2, third)
    r33, _ = _unit(_less(third, more_2, q_2))
    return r11, r12 + more, r13 + more_1, r22, r23 + more_2, r33


@njit(error_model="numpy", _nrt=False, forceinline=True)
def _bounds(c: Any, along: Any, across: Any, k2: Any) -> Any:
    """Interval of (j − j₀), or (i − i₀), outside of which no ray comes within √k2 of the splat; exact.

    The rays of one pixel column span a plane with normal n(j) = a + j·b; its distance from the whitened centre is
    |α + β·j| / ‖n(j)‖. If the ellipsoid meets the plane through the source parallel to the detector, it is seen
    everywhere.
    """
    a, b = _cross(c.e_0, across), _cross(along, across)
    # In this order α is exactly 0 where the reference is the projected centre.
    alpha, beta = _dot(c.g_0, across), _dot(c.f, b)
    x2 = beta * beta - k2 * _dot(b, b)
    x1, x0 = alpha * beta - k2 * _dot(a, b), alpha * alpha - k2 * _dot(a, a)
    bounded, discriminant = x2 > 0.0, x1 * x1 - x2 * x0
    half = np.sqrt(discriminant)
    low = 1.0 if discriminant < 0.0 else (-x1 - half) / x2
    high = 0.0 if discriminant < 0.0 else (-x1 + half) / x2
    return low if bounded else -np.inf, high if bounded else np.inf


@njit(error_model="numpy")
def project_cone(
    start: Any, stop: Any, means: Any, quats: Any, scales: Any, density: Any, packed: Any, width: Any, height: Any,
    k2: Any, keep_empty: Any, table: Any, boxes: Any,
) -> None:  # fmt: skip
    """Fills the rows start..stop of the tables of `radiograph_geometry.project`, which are 0."""
    lanes, found, batch = np.zeros(BUFFER), np.empty(BATCH, np.int64), 0
    for n in range(start, stop):
        if (density[n] != 0 or keep_empty) and usable(means[n], quats[n], scales[n], density[n]):
            found[batch] = n
            batch += 1
        if batch == BATCH or n == stop - 1:
            for m in range(np.uint64(batch)):
                i = np.uint64(found[m])
                for k in range(np.uint64(3)):
                    lanes[_MEAN + k * _STEP + m], lanes[_SCALE + k * _STEP + m] = means[i, k], scales[i, k]
                for k in range(np.uint64(4)):
                    lanes[_QUAT + k * _STEP + m] = quats[i, k]
            _to_rows(lanes, packed, width, height, k2)
            _tabulate(found, batch, lanes, density, width, height, table, boxes)
            batch = 0


@njit(error_model="numpy", _nrt=False)
def _tabulate(
    found: Any, count: Any, lanes: Any, density: Any, width: Any, height: Any, table: Any, boxes: Any
) -> None:
    for m in range(np.uint64(count)):
        i = np.uint64(found[m])
        for k in range(np.uint64(A_AT + 1)):
            table[i, k] = lanes[_NUMBERS + k * _STEP + m]
        column0, row0 = lanes[_COLUMN0 + m], lanes[_ROW0 + m]
        table[i, COLUMN0], table[i, ROW0] = column0, row0
        table[i, AMPLITUDE] = SQRT_2PI * density[i] * lanes[_KAPPA + m]
        left, right = pixel_range(lanes[_LOW + m] + column0, lanes[_HIGH + m] + column0, width)
        top, bottom = pixel_range(lanes[_UP + m] + row0, lanes[_DEEP + m] + row0, height)
        boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = left, right, top, bottom
        table[i, LEFT], table[i, RIGHT], table[i, TOP], table[i, BOTTOM] = left, right, top, bottom


@njit(error_model="numpy", fastmath={"contract"}, _nrt=False)
def _to_rows(lanes: Any, packed: Any, width: Any, height: Any, k2: Any) -> None:
    view = (
        (packed[0, 0], packed[0, 1], packed[0, 2]),
        (packed[1, 0], packed[1, 1], packed[1, 2]),
        (packed[2, 0], packed[2, 1], packed[2, 2]),
        (packed[3, 0], packed[3, 1], packed[3, 2]),
    )
    for n in range(np.uint64(BATCH)):
        quat = lanes[_QUAT + n], *_three(lanes, _QUAT + _STEP, n)
        white = whitening(quat, _three(lanes, _SCALE, n))
        c = cone(_three(lanes, _MEAN, n), white.rows, view, width, height)
        kappa = c.kappa
        p = (
            kappa * _dot(c.q_1, c.g_u),
            kappa * _dot(c.q_1, c.g_v),
            kappa * _dot(c.q_1, c.g_0),
            kappa * _dot(c.q_2, c.g_v),
            kappa * _dot(c.q_2, c.g_0),
        )
        r11, r12, r13, r22, r23, r33 = _triangular(c.e_u, c.e_v, c.e_0)
        r = kappa * r11, kappa * r12, kappa * r13, kappa * r22, kappa * r23, kappa * r33
        numbers = coefficients(p, r, k2)
        lanes[_KAPPA + n] = kappa
        lanes[_COLUMN0 + n], lanes[_ROW0 + n] = c.right - 0.5 + 0.5 * width, c.down - 0.5 + 0.5 * height
        lanes[_LOW + n], lanes[_HIGH + n] = _bounds(c, c.e_u, c.e_v, k2)
        lanes[_UP + n], lanes[_DEEP + n] = _bounds(c, c.e_v, c.e_u, k2)
        _put_three(lanes, _NUMBERS, n, numbers[0:3])
        _put_three(lanes, _NUMBERS + np.uint64(3 * BATCH), n, numbers[3:6])
        _put_three(lanes, _NUMBERS + np.uint64(6 * BATCH), n, numbers[6:9])
        _put_three(lanes, _NUMBERS + np.uint64(9 * BATCH), n, numbers[9:12])
        _put_three(lanes, _NUMBERS + np.uint64(12 * BATCH), n, numbers[12:15])
        lanes[_NUMBERS + np.uint64(15 * BATCH) + n] = numbers[15]
