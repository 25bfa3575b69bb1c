"""What the radiographs' geometries share: vectors of three, W and its gradients, and the buffers of a batch of splats.

Everything is written out in scalars, without a branch or a library call, so that LLVM carries out the loop over splats
several splats at a time.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ....compiled import njit
from .math import cross, dot
from .whitening import LARGEST_SCALE, SMALLEST_SCALE

BATCH = 32
"""Splats that are turned around together: a loop over fewer has no full registers."""
# Planes of a batch's buffer, one float64 for each splat: what comes in, then what goes out. FACTOR is the amplitude by
# √(2π)·ρ; LOW to HIGH are the columns and UP to DEEP the rows within reach, from the projected centre.
MEAN, QUAT, SCALE, SUMS_AT, DENSITY = (np.uint64(k * BATCH) for k in (0, 3, 7, 10, 23))
TO_MEAN, TO_QUAT, TO_SCALE, TO_DENSITY, TO_VIEW = (np.uint64(k * BATCH) for k in (24, 27, 31, 34, 35))
FACTOR, FROM_COLUMN, FROM_ROW, LOW, HIGH, UP, DEEP = (np.uint64(k * BATCH) for k in range(10, 17))
NUMBERS = np.uint64(17 * BATCH)
BUFFER = 47 * BATCH
STEP = np.uint64(BATCH)


@njit(error_model="numpy", _nrt=False, forceinline=True)
def combine(x: Any, a: Any, y: Any, b: Any) -> Any:
    """x·a + y·b."""
    return x * a[0] + y * b[0], x * a[1] + y * b[1], x * a[2] + y * b[2]


@njit(error_model="numpy", _nrt=False, forceinline=True)
def choose(condition: Any, a: Any, b: Any) -> Any:
    return a[0] if condition else b[0], a[1] if condition else b[1], a[2] if condition else b[2]


@njit(error_model="numpy", _nrt=False, forceinline=True)
def turned(rows: Any, a: Any) -> Any:
    """Matrix times vector."""
    return dot(rows[0], a), dot(rows[1], a), dot(rows[2], a)


@njit(error_model="numpy", _nrt=False, forceinline=True)
def turned_back(rows: Any, a: Any) -> Any:
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
        -dot(grad[0], rows[0]) * inverse[0] if SMALLEST_SCALE <= scale[0] <= LARGEST_SCALE else 0.0,
        -dot(grad[1], rows[1]) * inverse[1] if SMALLEST_SCALE <= scale[1] <= LARGEST_SCALE else 0.0,
        -dot(grad[2], rows[2]) * inverse[2] if SMALLEST_SCALE <= scale[2] <= LARGEST_SCALE else 0.0,
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


@njit(error_model="numpy", _nrt=False, forceinline=True)
def plane_basis(first: Any, second: Any, normal: Any) -> Any:
    """As `whitening.plane_basis`."""
    one, two, three = dot(first, first), dot(second, second), dot(normal, normal)
    flat, nothing = one > 0.0, (three == 0.0) | ((one == 0.0) & (two == 0.0))
    along = choose(flat, first, second)
    per, per_normal = 1.0 / np.sqrt(one if flat else two), 1.0 / np.sqrt(three)
    q = combine(per, along, 0.0, normal)
    across = cross(normal, q)
    p = combine(per_normal, across, 0.0, normal)
    back = combine(-1.0, p, 0.0, p)
    q_1, q_2 = choose(flat, q, back), choose(flat, p, q)
    return choose(nothing, (1.0, 0.0, 0.0), q_1), choose(nothing, (0.0, 1.0, 0.0), q_2)


@njit(error_model="numpy", _nrt=False, forceinline=True)
def three(lanes: Any, plane: Any, n: Any) -> Any:
    return lanes[plane + n], lanes[plane + STEP + n], lanes[plane + STEP + STEP + n]


@njit(error_model="numpy", _nrt=False, forceinline=True)
def put_three(lanes: Any, plane: Any, n: Any, a: Any) -> None:
    lanes[plane + n], lanes[plane + STEP + n], lanes[plane + STEP + STEP + n] = a


@njit(error_model="numpy", _nrt=False, forceinline=True)
def view_of(packed: Any) -> Any:
    """(4, 3) as tuples: source or direction, center, u and v."""
    return (
        (packed[0, 0], packed[0, 1], packed[0, 2]),
        (packed[1, 0], packed[1, 1], packed[1, 2]),
        (packed[2, 0], packed[2, 1], packed[2, 2]),
        (packed[3, 0], packed[3, 1], packed[3, 2]),
    )


@njit(error_model="numpy", _nrt=False, forceinline=True)
def drawn_in(right: Any, down: Any, width: Any, height: Any) -> Any:
    """A projected centre, drawn in if further than two image sizes off the image, and whether it is not.

    Elsewhere than at the projected centre the pixel loop has a G·z that is not 0 at the reference, but is far from
    cancelling.
    """
    inside = (abs(right) <= 2.5 * width + 100) & (abs(down) <= 2.5 * height + 100)
    edge, bottom = 2.5 * width, 2.5 * height
    drawn_right = min(max(right, -edge), edge) if abs(right) < np.inf else 0.0
    drawn_down = min(max(down, -bottom), bottom) if abs(down) < np.inf else 0.0
    return right if inside else drawn_right, down if inside else drawn_down, inside


@njit(error_model="numpy", _nrt=False, forceinline=True)
def within(x2: Any, x1: Any, x0: Any) -> Any:
    """Where x2·x² + 2·x1·x + x0 ≤ 0; as `whitening.quadratic_range`."""
    bounded, discriminant = x2 > 0.0, x1 * x1 - x2 * x0
    half = np.sqrt(discriminant)
    low = 1.0 if discriminant < 0.0 else (-x1 - half) / x2
    high = 0.0 if discriminant < 0.0 else (-x1 + half) / x2
    return low if bounded else -np.inf, high if bounded else np.inf


@njit(error_model="numpy", _nrt=False, forceinline=True)
def factor(c: Any, kappa: Any) -> Any:
    """P's numbers p₁₁, p₁₂, p₁₃, p₂₂, p₂₃."""
    return (
        kappa * dot(c.q_1, c.g_u),
        kappa * dot(c.q_1, c.g_v),
        kappa * dot(c.q_1, c.g_0),
        kappa * dot(c.q_2, c.g_v),
        kappa * dot(c.q_2, c.g_0),
    )


@njit(error_model="numpy", _nrt=False, forceinline=True)
def to_cross_products(lanes: Any, n: Any, c: Any, kappa: Any) -> Any:
    """dL/dG, column by column; see `radiograph_geometry.geometry_backward`."""
    along_x, along_y = three(lanes, SUMS_AT + STEP, n), three(lanes, SUMS_AT + np.uint64(4 * BATCH), n)
    twice = -2 * kappa
    return (
        combine(twice * along_x[0], c.q_1, twice * along_y[0], c.q_2),
        combine(twice * along_x[1], c.q_1, twice * along_y[1], c.q_2),
        combine(twice * along_x[2], c.q_1, twice * along_y[2], c.q_2),
    )


@njit(error_model="numpy", _nrt=False, forceinline=True)
def quaternion(lanes: Any, n: Any) -> Any:
    x, y, z = three(lanes, QUAT + STEP, n)
    return lanes[QUAT + n], x, y, z


@njit(error_model="numpy", _nrt=False, forceinline=True)
def put_rows(lanes: Any, n: Any, c: Any, size: Any, amplitude: Any, across: Any, downward: Any, numbers: Any) -> None:
    """Hands on what a splat of `Cone` or `Beam` becomes in the table; `across` and `downward` are intervals."""
    lanes[FACTOR + n] = amplitude
    lanes[FROM_COLUMN + n], lanes[FROM_ROW + n] = c.right - 0.5 + 0.5 * size[0], c.down - 0.5 + 0.5 * size[1]
    lanes[LOW + n], lanes[HIGH + n] = across
    lanes[UP + n], lanes[DEEP + n] = downward
    put_three(lanes, NUMBERS, n, numbers[0:3])
    put_three(lanes, NUMBERS + np.uint64(3 * BATCH), n, numbers[3:6])
    put_three(lanes, NUMBERS + np.uint64(6 * BATCH), n, numbers[6:9])
    put_three(lanes, NUMBERS + np.uint64(9 * BATCH), n, numbers[9:12])
    put_three(lanes, NUMBERS + np.uint64(12 * BATCH), n, numbers[12:15])
    lanes[NUMBERS + np.uint64(15 * BATCH) + n] = numbers[15]


@njit(error_model="numpy", _nrt=False, forceinline=True)
def put_gradients(
    lanes: Any, n: Any, to_mean: Any, white: Any, scale: Any, d_white: Any, to_density: Any, to_view: Any
) -> None:
    """Hands on a splat's gradients, those of quaternion and scales from the rows of dL/dW."""
    to_quat, to_scale = whitening_backward(white, scale, d_white)
    put_three(lanes, TO_MEAN, n, to_mean)
    lanes[TO_QUAT + n] = to_quat[0]
    put_three(lanes, TO_QUAT + STEP, n, to_quat[1:])
    put_three(lanes, TO_SCALE, n, to_scale)
    lanes[TO_DENSITY + n] = to_density
    put_three(lanes, TO_VIEW, n, to_view[0])
    put_three(lanes, TO_VIEW + np.uint64(3 * BATCH), n, to_view[1])
    put_three(lanes, TO_VIEW + np.uint64(6 * BATCH), n, to_view[2])
    put_three(lanes, TO_VIEW + np.uint64(9 * BATCH), n, to_view[3])
