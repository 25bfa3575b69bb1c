"""The pixel loops of cuts and slabs, threaded as in `radiograph_raster`: bands of rows forward, splats backward."""

from __future__ import annotations

from typing import Any

import numpy as np

from ....compiled import njit, prange
from .bands import BAND_ROWS, FARTHEST, LANES, PART, STRETCHES_A_SUM, SUMS, add_lanes, aligned_zeros, bell
from .math import FAST
from .section_geometry import (
    AMOUNT,
    ETA,
    M1,
    M2,
    M3,
    P11,
    P12,
    P13,
    P22,
    P23,
    SPLATS_A_TASK,
    geometry_backward,
)

THIN_ETA = 0.5
"""Under this half thickness, in standard deviations, the slab's mean is taken from its series (error 1e-6)."""
LARGEST_ALPHA = np.float32(1 - 1e-6)
# What many opaque splats leave empty, and gradients in proportion to it, would else become numbers that processors
# calculate with several times slower (`bands.FARTHEST`). Such splats keep a gradient of at most a millionth, of the
# right sign, by which Adam can make them clear again; that of the image as it is would be 0.
LEAST_EMPTY = np.float32(1e-12)
SQRT_HALF_PI = np.float32(np.sqrt(np.pi / 2))

# Planes of a band's buffer, as in `radiograph_raster`; x, y and m are those of the first pixel within reach.
FIRST, STRETCHES, _RIGHT, _DOWN, _X, _Y, _M = (np.uint64(k * BAND_ROWS) for k in range(7))
PLANES = 7
# The 13 sums of `geometry_backward` and of one stretch dL/dimage and w, each with a place for every lane.
_S0, _S1, _S2, _S3, _S4, _S5, _S6, _S7, _S8, _S9, _S10, _S11, _S12 = (np.uint64(k * LANES) for k in range(13))
_GRAD, _WEIGHT = (np.uint64((SUMS + k) * LANES) for k in range(2))


@njit(inline="always")
def _signed_erf(t: Any, near: Any) -> Any:
    """erf(t/√2) from t and exp(−t²/2): Abramowitz and Stegun 7.1.26, absolute error 1.5e-7."""
    size = abs(t)
    s = np.float32(1.0) / (np.float32(1.0) + np.float32(0.3275911 * 0.7071067811865476) * size)
    p = np.float32(1.061405429)
    p = p * s + np.float32(-1.453152027)
    p = p * s + np.float32(1.421413741)
    p = p * s + np.float32(-0.284496736)
    p = p * s + np.float32(0.254829592)
    value = np.float32(1.0) - p * s * near
    return value if t >= np.float32(0.0) else -value


@njit(fastmath=FAST, error_model="numpy", _nrt=False, forceinline=True)
def _weights(x: Any, m: Any, y2: Any, eta: Any, count: int, weights: Any) -> None:
    """w of pixels from their components x and m (count,) and the row's squared y."""
    one = np.float32(1.0)
    if eta == np.float32(0.0):
        for k in range(count):
            weights[k] = bell(x[k] * x[k] + m[k] * m[k] + y2)
    elif eta < np.float32(THIN_ETA):
        e2 = eta * eta
        e4, e6 = e2 * e2 / np.float32(120), e2 * e2 * e2 / np.float32(5040)
        e2 /= np.float32(6)
        for k in range(count):
            m2 = m[k] * m[k]
            q = x[k] * x[k] + m2 + y2
            m2 = m2 if m2 < FARTHEST else FARTHEST
            series = e6 * m2 + (e4 - np.float32(15) * e6)
            series = series * m2 + (e2 - np.float32(6) * e4 + np.float32(45) * e6)
            series = series * m2 + (one - e2 + np.float32(3) * e4 - np.float32(15) * e6)
            weights[k] = series * bell(q)
    else:
        scale = np.float32(0.5) * SQRT_HALF_PI / eta
        for k in range(count):
            upper, lower = m[k] + eta, m[k] - eta
            mean = _signed_erf(upper, bell(upper * upper)) - _signed_erf(lower, bell(lower * lower))
            weights[k] = scale * mean * bell(x[k] * x[k] + y2)


@njit(fastmath=FAST, error_model="numpy", _nrt=False, forceinline=True)
def find_rows(row: Any, reference: Any, box: Any, sigmas: float, top: int, rows: Any) -> None:
    """Fills the planes (PLANES * BAND_ROWS,) float32 of the band that begins at row `top`; see `radiograph_raster`."""
    p11, p12, p13 = np.float64(row[P11]), np.float64(row[P12]), np.float64(row[P13])
    p22, p23, eta = np.float64(row[P22]), np.float64(row[P23]), np.float64(row[ETA])
    m1, m2, m3 = np.float64(row[M1]), np.float64(row[M2]), np.float64(row[M3])
    is_cut = 1.0 if eta == 0.0 else 0.0
    inverse, widened = (1.0 / p11, 0.0) if p11 > 0.0 else (0.0, np.inf)
    inverse_m, half_m = (1.0 / m1, (sigmas + eta) / abs(m1)) if m1 != 0.0 else (0.0, np.inf)
    column0, left, right = reference[0], np.float64(box[0]), np.float64(box[1])
    down0 = top - reference[1]
    for k in range(np.uint64(BAND_ROWS)):
        down = down0 + np.float64(np.int64(k))
        x, y, m = p12 * down + p13, p22 * down + p23, m2 * down + m3
        room = sigmas * sigmas - y * y - is_cut * (m * m)
        half = np.sqrt(room if room > 0.0 else 0.0) * inverse + widened
        half = -np.inf if room < 0.0 else half
        middle, middle_m = column0 - x * inverse, column0 - m * inverse_m
        low, low_m, high, high_m = middle - half, middle_m - half_m, middle + half, middle_m + half_m
        # Comparisons in this order, so that NaN gives the whole row.
        first, end = np.ceil(low if low > low_m else low_m), np.floor(high if high < high_m else high_m) + 1.0
        first = first if first > left else left
        first = first if first < right else right
        end = end if end < right else right
        end = end if end > first else first
        offset = first - column0
        rows[FIRST + k] = first
        rows[STRETCHES + k] = np.ceil((end - first) * (1.0 / LANES))
        rows[_RIGHT + k] = offset
        rows[_DOWN + k] = down
        rows[_X + k] = p11 * offset + x
        rows[_Y + k] = y
        rows[_M + k] = m1 * offset + m


@njit(fastmath=FAST, error_model="numpy", _nrt=False, forceinline=True)
def _fill_row(xs: Any, ms: Any, count: int, x: Any, p11: Any, m: Any, m1: Any) -> None:
    for k in range(count):
        xs[k] = x + p11 * np.float32(k)
        ms[k] = m + m1 * np.float32(k)


@njit(fastmath=FAST, error_model="numpy", _nrt=False, forceinline=True)
def _add(out: Any, weights: Any, factor: Any) -> None:
    for k in range(len(out)):
        out[k] += factor * weights[k]


@njit(fastmath=FAST, error_model="numpy", _nrt=False, forceinline=True)
def _multiply_empty(out: Any, weights: Any, opacity: Any) -> None:
    for k in range(len(out)):
        alpha = opacity * weights[k]
        alpha = alpha if alpha < LARGEST_ALPHA else LARGEST_ALPHA
        left = out[k] * (np.float32(1.0) - alpha)
        out[k] = LEAST_EMPTY if left < LEAST_EMPTY else left


@njit(parallel=True, error_model="numpy", cache=True)
def rasterize(
    table: Any,
    reference: Any,
    boxes: Any,
    starts: Any,
    splats: Any,
    values: Any,
    product: bool,
    k2: float,
    width: int,
    height: int,
) -> Any:
    """Σ amount·w·values, (channels, height, padded width) float32, or Π(1 − amount·w) as the one channel."""
    image = np.full((values.shape[1], height, width + LANES), 1.0 if product else 0.0, np.float32)
    parts = np.zeros_like(image)
    sigmas = np.sqrt(k2)
    for band in prange(len(starts) - 1):
        room = width + LANES
        xs, ms, weights = np.empty(room, np.float32), np.empty(room, np.float32), np.empty(room, np.float32)
        lines = np.empty(PLANES * BAND_ROWS, np.float32)
        rows = slice(band * BAND_ROWS, (band + 1) * BAND_ROWS)
        # As in `radiograph_raster`; a product has no such trouble.
        single = product or starts[band + 1] - starts[band] <= PART
        target = image if single else parts
        for entry in range(starts[band], starts[band + 1]):
            if not single and (entry - starts[band]) % PART == 0:
                image[:, rows] += parts[:, rows]
                parts[:, rows] = np.float32(0.0)
            n = splats[entry]
            row = table[n]
            find_rows(row, reference[n], boxes[n], sigmas, band * BAND_ROWS, lines)
            for i in range(max(boxes[n, 2], band * BAND_ROWS), min(boxes[n, 3], (band + 1) * BAND_ROWS)):
                k = np.uint64(i - band * BAND_ROWS)
                first, count = int(lines[FIRST + k]), LANES * int(lines[STRETCHES + k])
                if count == 0:
                    continue
                _fill_row(xs, ms, count, lines[_X + k], row[P11], lines[_M + k], row[M1])
                _weights(xs, ms, lines[_Y + k] * lines[_Y + k], row[ETA], count, weights)
                for channel in range(values.shape[1]):
                    out = target[channel, i, first : first + count]
                    if product:
                        _multiply_empty(out, weights, row[AMOUNT])
                    else:
                        _add(out, weights, row[AMOUNT] * values[n, channel])
        if not single:
            image[:, rows] += parts[:, rows]
    return image


@njit(parallel=True, error_model="numpy", cache=True)
def rasterize_backward(
    grad: Any,
    values: Any,
    product: bool,
    want_values: bool,
    want_shape: bool,
    means: Any,
    quats: Any,
    scales: Any,
    plane: Any,
    thickness: float,
    table: Any,
    reference: Any,
    boxes: Any,
    k2: float,
    width: int,
    height: int,
) -> Any:
    """Gradients of means, quats, scales, amount and values, float64.

    Args:
        grad: (channels, height, padded width) float32 dL/dimage, 0 in the padding; of a product −dL/dimage · image,
            which every splat divides by its own 1 − amount·w.
        want_values, want_shape: whether the gradients of values, and those of means, quats and scales, are asked
            for; else they are empty, and 0.
    """
    count, channels = values.shape
    grad_means, grad_quats = np.zeros((count, 3)), np.zeros((count, 4))
    grad_scales, grad_amount = np.zeros((count, 3)), np.zeros(count)
    grad_values = np.zeros((count if want_values else 0, channels))
    sigmas = np.sqrt(k2)
    for task in prange((count + SPLATS_A_TASK - 1) // SPLATS_A_TASK):
        sums, of_channel = np.zeros(SUMS), np.zeros(channels if want_values else 0)
        rows, lanes = np.empty(PLANES * BAND_ROWS, np.float32), aligned_zeros((SUMS + 2) * LANES)
        scratch = (
            np.empty(4),
            np.empty((3, 3)),
            np.empty((11, 3)),
            np.empty((3, 3)),
            np.empty((3, 3)),
            np.empty((3, 3)),
            np.empty(3),
            np.empty(3),
        )
        for n in range(task * SPLATS_A_TASK, min(count, (task + 1) * SPLATS_A_TASK)):
            if boxes[n, 0] >= boxes[n, 1] or boxes[n, 2] >= boxes[n, 3]:
                continue
            sums[:] = 0.0
            of_channel[:] = 0.0
            row = table[n]
            _gather(grad, row, values[n], reference[n], boxes[n], sigmas, product, rows, lanes, sums, of_channel)
            grad_amount[n] = sums[0]
            if want_values:
                for channel in range(channels):
                    grad_values[n, channel] = row[AMOUNT] * of_channel[channel]
            if want_shape:
                geometry_backward(
                    sums,
                    means[n],
                    quats[n],
                    scales[n],
                    plane,
                    thickness,
                    width,
                    height,
                    scratch,
                    grad_means[n],
                    grad_quats[n],
                    grad_scales[n],
                )
    return grad_means, grad_quats, grad_scales, grad_amount, grad_values


@njit(error_model="numpy", cache=True, _nrt=False)
def _gather(
    grad: Any,
    row: Any,
    values: Any,
    reference: Any,
    box: Any,
    sigmas: float,
    product: bool,
    rows: Any,
    lanes: Any,
    sums: Any,
    of_channel: Any,
) -> None:
    """Adds a splat's pixels to the sums of `geometry_backward` and Σ w·dL/dimage; `lanes` is 0 before and after."""
    added: Any = 0
    for top in range(box[2], box[3], BAND_ROWS):
        find_rows(row, reference, box, sigmas, top, rows)
        for k in range(np.uint64(min(BAND_ROWS, box[3] - top))):
            right, x, m = rows[_RIGHT + k], rows[_X + k], rows[_M + k]
            stretches, at = np.int64(rows[STRETCHES + k]), np.uint64(rows[FIRST + k])
            for _ in range(stretches):
                _mix(grad, values, np.uint64(top) + k, at, lanes)
                if row[ETA] < np.float32(THIN_ETA):
                    _add_thin(row, product, x, rows[_Y + k], m, right, rows[_DOWN + k], lanes)
                else:
                    _add_thick(row, product, x, rows[_Y + k], m, right, rows[_DOWN + k], lanes)
                _weigh(grad, np.uint64(top) + k, at, lanes, of_channel)
                right += np.float32(LANES)
                x += row[P11] * np.float32(LANES)
                m += row[M1] * np.float32(LANES)
                at += np.uint64(LANES)
            added += stretches
            if added >= STRETCHES_A_SUM:
                add_lanes(lanes, sums)
                added = 0
    add_lanes(lanes, sums)


@njit(fastmath=FAST, error_model="numpy", _nrt=False, forceinline=True)
def _mix(grad: Any, values: Any, i: Any, at: Any, lanes: Any) -> None:
    """dL/d(Σ amount·w) of a stretch: the channels' gradients times their values."""
    for lane in range(np.uint64(LANES)):
        lanes[_GRAD + lane] = values[0] * grad[np.uint64(0), i, at + lane]
    for channel in range(np.uint64(1), np.uint64(len(values))):
        for lane in range(np.uint64(LANES)):
            lanes[_GRAD + lane] += values[channel] * grad[channel, i, at + lane]


@njit(fastmath=FAST, error_model="numpy", _nrt=False, forceinline=True)
def _weigh(grad: Any, i: Any, at: Any, lanes: Any, of_channel: Any) -> None:
    """Σ w·dL/dimage of a stretch, for each channel whose gradient is wanted."""
    for channel in range(np.uint64(len(of_channel))):
        total = np.float32(0.0)
        for lane in range(np.uint64(LANES)):
            total += lanes[_WEIGHT + lane] * grad[channel, i, at + lane]
        of_channel[channel] += total


@njit(inline="always")
def _share(h: Any, weight: Any, amount: Any, product: Any) -> Any:
    """dL/d(amount·w): of a product −dL/dT·T still has to be divided by this splat's own factor."""
    alpha = amount * weight * product
    return h / (np.float32(1.0) - alpha) if alpha < LARGEST_ALPHA else np.float32(0.0)


@njit(fastmath=FAST, error_model="numpy", _nrt=False, forceinline=True)
def _add_thin(row: Any, product: bool, x0: Any, y: Any, m0: Any, right0: Any, down: Any, lanes: Any) -> None:
    p11, m1 = row[P11], row[M1]
    amount, eta, of_product = row[AMOUNT], row[ETA], np.float32(1.0 if product else 0.0)
    one = np.float32(1.0)
    e2 = eta * eta
    c1, c2, c3 = e2 / np.float32(6), e2 * e2 / np.float32(120), e2 * e2 * e2 / np.float32(5040)
    d1, d2, d3 = eta / np.float32(3), eta * e2 / np.float32(30), eta * e2 * e2 / np.float32(840)
    for lane in range(np.uint64(LANES)):
        step = np.float32(np.int64(lane))
        x, m, right = x0 + p11 * step, m0 + m1 * step, right0 + step
        m2 = m * m
        near = bell(x * x + y * y + m2)
        m2 = m2 if m2 < FARTHEST else FARTHEST
        h2 = m2 - one
        h4 = m2 * m2 - np.float32(6) * m2 + np.float32(3)
        h6 = ((m2 - np.float32(15)) * m2 + np.float32(45)) * m2 - np.float32(15)
        series = one + c1 * h2 + c2 * h4 + c3 * h6
        slope = np.float32(2) * c1 + c2 * (np.float32(4) * m2 - np.float32(12))
        slope += c3 * ((np.float32(6) * m2 - np.float32(60)) * m2 + np.float32(90))
        weight = near * series
        lanes[_WEIGHT + lane] = weight
        h = _share(lanes[_GRAD + lane], weight, amount, of_product)
        tau = amount * h * weight
        extra = amount * h * near * slope * m
        tau_x, tau_y, tau_m = tau * x, tau * y, tau * m - extra
        lanes[_S0 + lane] += h * weight
        lanes[_S1 + lane] += tau_x * right
        lanes[_S2 + lane] += tau_x * down
        lanes[_S3 + lane] += tau_x
        lanes[_S4 + lane] += tau_y * right
        lanes[_S5 + lane] += tau_y * down
        lanes[_S6 + lane] += tau_y
        lanes[_S7 + lane] += tau_m * right
        lanes[_S8 + lane] += tau_m * down
        lanes[_S9 + lane] += tau_m
        lanes[_S10 + lane] += extra * x
        lanes[_S11 + lane] += extra * y
        lanes[_S12 + lane] += amount * h * near * (d1 * h2 + d2 * h4 + d3 * h6)


@njit(fastmath=FAST, error_model="numpy", _nrt=False, forceinline=True)
def _add_thick(row: Any, product: bool, x0: Any, y: Any, m0: Any, right0: Any, down: Any, lanes: Any) -> None:
    p11, m1 = row[P11], row[M1]
    amount, eta, of_product = row[AMOUNT], row[ETA], np.float32(1.0 if product else 0.0)
    scale, per_width = np.float32(0.5) * SQRT_HALF_PI / eta, np.float32(0.5) / eta
    for lane in range(np.uint64(LANES)):
        step = np.float32(np.int64(lane))
        x, m, right = x0 + p11 * step, m0 + m1 * step, right0 + step
        across = bell(x * x + y * y)
        upper, lower = m + eta, m - eta
        bell_upper, bell_lower = bell(upper * upper), bell(lower * lower)
        mean = scale * (_signed_erf(upper, bell_upper) - _signed_erf(lower, bell_lower))
        weight = across * mean
        lanes[_WEIGHT + lane] = weight
        h = _share(lanes[_GRAD + lane], weight, amount, of_product)
        tau = amount * h * weight
        along = amount * h * across * per_width * (bell_upper - bell_lower)
        tau_x, tau_y, extra = tau * x, tau * y, along + tau * m
        lanes[_S0 + lane] += h * weight
        lanes[_S1 + lane] += tau_x * right
        lanes[_S2 + lane] += tau_x * down
        lanes[_S3 + lane] += tau_x
        lanes[_S4 + lane] += tau_y * right
        lanes[_S5 + lane] += tau_y * down
        lanes[_S6 + lane] += tau_y
        lanes[_S7 + lane] -= along * right
        lanes[_S8 + lane] -= along * down
        lanes[_S9 + lane] -= along
        lanes[_S10 + lane] += extra * x
        lanes[_S11 + lane] += extra * y
        lanes[_S12 + lane] += amount * h * (across * per_width * (bell_upper + bell_lower) - weight / eta)
