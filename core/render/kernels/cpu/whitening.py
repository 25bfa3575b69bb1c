"""W = S⁻¹Rᵀ, which turns a splat into a unit ball, and the way back from dL/dW; shared by the additive renderers.

Per-splat geometry is float64 throughout: the pixel loops get float32 coefficients in which nothing cancels.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ....compiled import njit

SMALLEST_SCALE, LARGEST_SCALE = 1e-12, 1e12


@njit(error_model="numpy", cache=True, _nrt=False)
def usable(mean: Any, quat: Any, scale: Any, amount: float) -> bool:
    """Whether the splat's parameters are numbers it can be drawn with; an amount of 0 shows nothing."""
    total = amount
    for k in range(3):
        total += mean[k] * 0.0
        if np.isnan(scale[k]):
            return False
    for k in range(4):
        total += quat[k] * 0.0
    return bool(np.isfinite(total))


@njit(error_model="numpy", cache=True, _nrt=False)
def unit_quat(quat: Any, unit: Any) -> float:
    """Fills `unit` (4,) and returns the length; a zero quaternion gives the identity and length 0."""
    squared = quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3]
    if squared <= 1e-24:
        unit[0], unit[1], unit[2], unit[3] = 1.0, 0.0, 0.0, 0.0
        return 0.0
    length = np.sqrt(squared)
    for k in range(4):
        unit[k] = quat[k] / length
    return float(length)


@njit(error_model="numpy", cache=True, _nrt=False)
def fill_whitening(quat: Any, scale: Any, unit: Any, whiten: Any) -> float:
    """Fills the unit quaternion (4,) and W (3, 3); returns the quaternion's length, see `unit_quat`."""
    length = unit_quat(quat, unit)
    w, x, y, z = unit[0], unit[1], unit[2], unit[3]
    whiten[0, 0] = 1 - 2 * (y * y + z * z)
    whiten[1, 0] = 2 * (x * y - w * z)
    whiten[2, 0] = 2 * (x * z + w * y)
    whiten[0, 1] = 2 * (x * y + w * z)
    whiten[1, 1] = 1 - 2 * (x * x + z * z)
    whiten[2, 1] = 2 * (y * z - w * x)
    whiten[0, 2] = 2 * (x * z - w * y)
    whiten[1, 2] = 2 * (y * z + w * x)
    whiten[2, 2] = 1 - 2 * (x * x + y * y)
    for a in range(3):
        inverse = 1.0 / min(max(scale[a], SMALLEST_SCALE), LARGEST_SCALE)
        for b in range(3):
            whiten[a, b] *= inverse
    return length


@njit(error_model="numpy", cache=True, _nrt=False)
def whitening_backward(
    scale: Any, unit: Any, length: float, whiten: Any, grad: Any, grad_quat: Any, grad_scale: Any
) -> None:
    """From dL/dW (3, 3), which is overwritten, to the gradients of quaternion (4,) and scales (3,)."""
    for a in range(3):
        kept = min(max(scale[a], SMALLEST_SCALE), LARGEST_SCALE)
        total = 0.0
        for b in range(3):
            total += grad[a, b] * whiten[a, b]
            grad[a, b] /= kept
        grad_scale[a] = -total / kept if kept == scale[a] else 0.0
    if length == 0.0:
        grad_quat[:] = 0.0
        return
    # grad[a, b] is now dL/dR[b, a].
    w, x, y, z = unit[0], unit[1], unit[2], unit[3]
    m00, m01, m02 = grad[0, 0], grad[1, 0], grad[2, 0]
    m10, m11, m12 = grad[0, 1], grad[1, 1], grad[2, 1]
    m20, m21, m22 = grad[0, 2], grad[1, 2], grad[2, 2]
    dw = 2 * (-z * m01 + y * m02 + z * m10 - x * m12 - y * m20 + x * m21)
    dx = 2 * (y * m01 + z * m02 + y * m10 - 2 * x * m11 - w * m12 + z * m20 + w * m21 - 2 * x * m22)
    dy = 2 * (-2 * y * m00 + x * m01 + w * m02 + x * m10 + z * m12 - w * m20 + z * m21 - 2 * y * m22)
    dz = 2 * (-2 * z * m00 - w * m01 + x * m02 + w * m10 - 2 * z * m11 + y * m12 + x * m20 + y * m21)
    radial = w * dw + x * dx + y * dy + z * dz
    grad_quat[0] = (dw - w * radial) / length
    grad_quat[1] = (dx - x * radial) / length
    grad_quat[2] = (dy - y * radial) / length
    grad_quat[3] = (dz - z * radial) / length


@njit(inline="always")
def multiply(matrix: Any, vector: Any, out: Any) -> None:
    """out = matrix · vector, (3, 3) and (3,)."""
    for a in range(3):
        out[a] = matrix[a, 0] * vector[0] + matrix[a, 1] * vector[1] + matrix[a, 2] * vector[2]


@njit(inline="always")
def multiply_transposed(matrix: Any, vector: Any, out: Any) -> None:
    """out = matrixᵀ · vector, (3, 3) and (3,)."""
    for a in range(3):
        out[a] = matrix[0, a] * vector[0] + matrix[1, a] * vector[1] + matrix[2, a] * vector[2]


@njit(inline="always")
def add_outer(matrix: Any, left: Any, right: Any) -> None:
    """matrix += left · rightᵀ, (3, 3) and (3,)."""
    for a in range(3):
        for b in range(3):
            matrix[a, b] += left[a] * right[b]


@njit(inline="always")
def cross(left: Any, right: Any, out: Any) -> None:
    """out = left × right; `out` is neither of them."""
    out[0] = left[1] * right[2] - left[2] * right[1]
    out[1] = left[2] * right[0] - left[0] * right[2]
    out[2] = left[0] * right[1] - left[1] * right[0]


@njit(inline="always")
def dot(left: Any, right: Any) -> Any:
    return left[0] * right[0] + left[1] * right[1] + left[2] * right[2]


@njit(error_model="numpy", cache=True, _nrt=False)
def triangular(columns: Any, upper: Any, basis: Any) -> None:
    """QR factorisation by Gram-Schmidt of the matrix whose columns are the rows of `columns` (3, 3).

    Fills R in `upper` (3, 3) and the columns of Q as rows of `basis` (3, 3), a zero row where R's diagonal is zero.
    The second pass keeps the small part of nearly parallel columns (needles).
    """
    basis[:] = 0.0
    upper[:] = 0.0
    for k in range(3):
        x, y, z = columns[k, 0], columns[k, 1], columns[k, 2]
        for _ in range(2):
            for row in range(k):
                part = basis[row, 0] * x + basis[row, 1] * y + basis[row, 2] * z
                upper[row, k] += part
                x -= part * basis[row, 0]
                y -= part * basis[row, 1]
                z -= part * basis[row, 2]
        length = np.sqrt(x * x + y * y + z * z)
        upper[k, k] = length
        if length > 0:
            basis[k, 0], basis[k, 1], basis[k, 2] = x / length, y / length, z / length


@njit(error_model="numpy", cache=True, _nrt=False)
def plane_basis(first: Any, second: Any, normal: Any, q1: Any, q2: Any) -> None:
    """Fills orthonormal q1, q2 (3,) that span the plane at right angles to `normal`, `first` along q1.

    `first` and `second` lie in that plane; if `first` is zero, q2 is along `second`, and if both are (or the normal
    is), any two directions do, because nothing is left to be measured in them.
    """
    length, other = np.sqrt(dot(first, first)), np.sqrt(dot(second, second))
    normal_length = np.sqrt(dot(normal, normal))
    if normal_length == 0 or (length == 0 and other == 0):
        q1[0], q1[1], q1[2] = 1.0, 0.0, 0.0
        q2[0], q2[1], q2[2] = 0.0, 1.0, 0.0
        return
    if length > 0:
        for k in range(3):
            q1[k] = first[k] / length
        cross(normal, q1, q2)
        for k in range(3):
            q2[k] /= normal_length
    else:
        for k in range(3):
            q2[k] = second[k] / other
        cross(q2, normal, q1)
        for k in range(3):
            q1[k] /= normal_length


@njit(error_model="numpy", cache=True, _nrt=False)
def quadratic_range(a: float, b: float, c: float) -> tuple[float, float]:
    """Where a·x² + 2b·x + c ≤ 0: the interval, everything if a ≤ 0, and (1, 0) if it is nowhere."""
    if not a > 0:
        return -np.inf, np.inf
    discriminant = b * b - a * c
    if discriminant < 0:
        return 1.0, 0.0
    half = np.sqrt(discriminant)
    return (-b - half) / a, (-b + half) / a


@njit(inline="always")
def pixel_range(low: Any, high: Any, size: Any) -> Any:
    """First and one past the last of the whole numbers in low..high within 0..size; NaN gives everything."""
    first = int(np.ceil(low)) if low > 0 else 0
    if low > size:
        first = size
    last = int(np.floor(high)) + 1 if high < size - 1 else size
    if high < 0:
        last = 0
    return first, last
