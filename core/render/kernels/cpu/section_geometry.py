"""From splats to the few numbers a pixel row of a cut or slab needs, and from their gradients back.

Whitened, a pixel of the plane lies at Y·z with z = (j − j₀, i − i₀, 1) from a reference pixel of the splat, and
w depends on three components of it in an orthonormal basis: (x, y, m) = Q·Y·z.

- A cut: Q from the QR factorisation of Y, so that m is constant, the distance at the cut's own peak, which is
  the reference; w = exp(−½(x² + y² + m²)).
- A slab: m is the component along the whitened normal and the reference the foot of the perpendicular from the
  centre; w = exp(−½(x² + y²)) · mean of exp(−½(m + t)²) over t in ±η, η = half the thickness in standard deviations.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ....compiled import njit, prange
from .whitening import (
    add_outer,
    cross,
    dot,
    fill_whitening,
    multiply,
    multiply_transposed,
    pixel_range,
    plane_basis,
    quadratic_range,
    triangular,
    usable,
    whitening_backward,
)

SPLATS_A_TASK = 256

# Columns of the coefficient table: rows x, y, m of Q·Y, η, amount.
P11, P12, P13, P22, P23, M1, M2, M3, ETA, AMOUNT = range(10)

# Rows of the (11, 3) scratch of one splat.
Y_U, Y_V, Y_0, Q_1, Q_2, Q_3, NORMAL, TO_PIXEL, BOX_U, BOX_V, BOX_0 = range(11)


@njit(error_model="numpy", cache=True)
def fill_columns(
    mean: Any, whiten: Any, plane: Any, thickness: float, width: int, height: int, g: Any, upper: Any, pixel: Any
) -> float:
    """Fills Y, Q, the whitened normal and the reference pixel (2,); returns η, 0 for a cut.

    `plane` is (4, 3): origin, u, v, unit normal. `upper` (3, 3) becomes Q·Y.
    """
    origin, u, v, normal = plane[0], plane[1], plane[2], plane[3]
    to_mean, side = np.empty(3), np.empty(3)
    for k in range(3):
        to_mean[k] = mean[k] - origin[k]
    cross(u, v, side)
    area = np.sqrt(dot(side, side))
    cross(v, normal, side)
    right = dot(to_mean, side) / area
    cross(normal, u, side)
    down = dot(to_mean, side) / area
    multiply(whiten, u, g[Y_U])
    multiply(whiten, v, g[Y_V])
    multiply(whiten, normal, g[NORMAL])
    exact = _fill_offset(mean, whiten, plane, right, down, width, height, g, pixel)
    if thickness <= 0:
        triangular(g[:3], upper, g[Q_1 : Q_3 + 1])
        step = -upper[1, 2] / upper[1, 1]
        right = pixel[0] - (upper[0, 2] + upper[0, 1] * step) / upper[0, 0]
        exact = _fill_offset(mean, whiten, plane, right, pixel[1] + step, width, height, g, pixel)
        triangular(g[:3], upper, g[Q_1 : Q_3 + 1])
        if exact:
            upper[0, 2] = upper[1, 2] = 0.0
        return 0.0
    length = np.sqrt(dot(g[NORMAL], g[NORMAL]))
    across_u, across_v = np.empty(3), np.empty(3)
    for k in range(3):
        g[Q_3, k] = g[NORMAL, k] / length
    part_u, part_v = dot(g[Y_U], g[Q_3]), dot(g[Y_V], g[Q_3])
    for k in range(3):
        across_u[k] = g[Y_U, k] - part_u * g[Q_3, k]
        across_v[k] = g[Y_V, k] - part_v * g[Q_3, k]
    plane_basis(across_u, across_v, g[Q_3], g[Q_1], g[Q_2])
    for row in range(3):
        for k in range(3):
            upper[row, k] = dot(g[Q_1 + row], g[Y_U + k])
    upper[1, 0] = 0.0
    if exact:
        upper[0, 2] = upper[1, 2] = 0.0
    return 0.5 * thickness * length


@njit(error_model="numpy", cache=True, _nrt=False)
def _fill_offset(
    mean: Any,
    whiten: Any,
    plane: Any,
    right: float,
    down: float,
    width: int,
    height: int,
    g: Any,
    pixel: Any,
) -> bool:
    """Fills the reference pixel, drawn in to two image sizes around the image, and Y₀ there; False if drawn in."""
    exact = bool(abs(right) <= 3.0 * width + 100 and abs(down) <= 3.0 * height + 100)
    if not exact:
        right = min(max(right, -2.0 * width), 3.0 * width) if np.isfinite(right) else 0.0
        down = min(max(down, -2.0 * height), 3.0 * height) if np.isfinite(down) else 0.0
    pixel[0], pixel[1] = right, down
    for k in range(3):
        g[TO_PIXEL, k] = plane[0, k] + right * plane[1, k] + down * plane[2, k] - mean[k]
    multiply(whiten, g[TO_PIXEL], g[Y_0])
    return exact


@njit(error_model="numpy", cache=True)
def _bounds(g: Any, upper: Any, weight: float, limit: float, axis_u: bool) -> tuple[float, float]:
    """Where along one image axis x² + y² + (weight·m)² ≤ limit for some place along the other; exact."""
    for k in range(3):
        for row in range(3):
            g[BOX_U + k, row] = upper[row, k] * (weight if row == 2 else 1.0)
    along, across = (BOX_U, BOX_V) if axis_u else (BOX_V, BOX_U)
    a, b = np.empty(3), np.empty(3)
    cross(g[BOX_0], g[across], a)
    cross(g[along], g[across], b)
    scale = dot(g[across], g[across])
    return quadratic_range(dot(b, b), dot(a, b), dot(a, a) - limit * scale)


@njit(parallel=True, error_model="numpy", cache=True)
def project(
    means: Any,
    quats: Any,
    scales: Any,
    amount: Any,
    plane: Any,
    thickness: float,
    width: int,
    height: int,
    k2: float,
    keep_empty: bool,
) -> Any:
    """Coefficients (N, 10) float32, reference pixels (N, 2) float64, boxes (N, 4) int32: left, right, top, bottom.

    Splats that cannot be seen have an empty box, and so have those of amount 0 unless `keep_empty`.
    """
    count = len(means)
    table = np.zeros((count, 10), np.float32)
    reference = np.zeros((count, 2))
    boxes = np.zeros((count, 4), np.int32)
    sigmas = np.sqrt(k2)
    for task in prange((count + SPLATS_A_TASK - 1) // SPLATS_A_TASK):
        unit, whiten, g, upper = np.empty(4), np.empty((3, 3)), np.empty((11, 3)), np.empty((3, 3))
        side = np.empty(3)
        for n in range(task * SPLATS_A_TASK, min(count, (task + 1) * SPLATS_A_TASK)):
            if (amount[n] == 0 and not keep_empty) or not usable(means[n], quats[n], scales[n], amount[n]):
                continue
            distance, widest = 0.0, max(scales[n, 0], scales[n, 1], scales[n, 2])
            for k in range(3):
                distance += (means[n, k] - plane[0, k]) * plane[3, k]
            if abs(distance) > 0.5 * thickness + sigmas * widest:
                continue
            fill_whitening(quats[n], scales[n], unit, whiten)
            eta = fill_columns(means[n], whiten, plane, thickness, width, height, g, upper, side)
            # Pixel numbers count from 0 at the centre of the first pixel.
            reference[n, 0], reference[n, 1] = side[0] - 0.5, side[1] - 0.5
            row = table[n]
            row[P11], row[P12], row[P13] = upper[0, 0], upper[0, 1], upper[0, 2]
            row[P22], row[P23] = upper[1, 1], upper[1, 2]
            row[M1], row[M2], row[M3] = upper[2, 0], upper[2, 1], upper[2, 2]
            row[ETA], row[AMOUNT] = eta, amount[n]
            for axis in range(2):
                size = width if axis == 0 else height
                if thickness > 0:
                    low, high = _bounds(g, upper, 0.0, k2, axis == 0)
                    low2, high2 = _bounds(g, upper, sigmas / (sigmas + eta), 2 * k2, axis == 0)
                    low, high = max(low, low2), min(high, high2)
                else:
                    low, high = _bounds(g, upper, 1.0, k2, axis == 0)
                first, last = pixel_range(low + reference[n, axis], high + reference[n, axis], size)
                boxes[n, 2 * axis], boxes[n, 2 * axis + 1] = first, last
    return table, reference, boxes


@njit(error_model="numpy", cache=True, _nrt=False)
def geometry_backward(
    sums: Any,
    mean: Any,
    quat: Any,
    scale: Any,
    plane: Any,
    thickness: float,
    width: int,
    height: int,
    scratch: Any,
    grad_mean: Any,
    grad_quat: Any,
    grad_scale: Any,
) -> None:
    """From a splat's sums over pixels to the gradients of its parameters.

    With h = dL/dw and τ = h·w, `sums` (13,) holds [0] Σ τ / amount, [1:4] Στ·x·z, [4:7] Στ·y·z and
    [7:10] −Σ h·dw/dm·z with z = (j − j₀, i − i₀, 1), and of a slab [10] Σ(h·dw/dm + τ·m)·x, [11] the same with y,
    [12] Σ h·dw/dη. The basis Q needs no derivative of its own, but for the slab's third row, the normal's.
    """
    unit, whiten, g, upper, d_y, d_whiten, pixel, side = scratch
    length = fill_whitening(quat, scale, unit, whiten)
    fill_columns(mean, whiten, plane, thickness, width, height, g, upper, pixel)
    for k in range(3):
        for c in range(3):
            d_y[k, c] = -(g[Q_1, c] * sums[1 + k] + g[Q_2, c] * sums[4 + k] + g[Q_3, c] * sums[7 + k])
    d_whiten[:] = 0.0
    add_outer(d_whiten, d_y[0], plane[1])
    add_outer(d_whiten, d_y[1], plane[2])
    add_outer(d_whiten, d_y[2], g[TO_PIXEL])
    if thickness > 0:
        through = np.sqrt(dot(g[NORMAL], g[NORMAL]))
        for c in range(3):
            turn = (g[Q_1, c] * sums[10] + g[Q_2, c] * sums[11]) / through
            side[c] = turn + sums[12] * 0.5 * thickness * g[Q_3, c]
        add_outer(d_whiten, side, plane[3])
    multiply_transposed(whiten, d_y[2], side)
    for c in range(3):
        grad_mean[c] = -side[c]
    whitening_backward(scale, unit, length, whiten, d_whiten, grad_quat, grad_scale)
