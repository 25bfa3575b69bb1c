"""The pixel loops of cuts and slabs, threaded as in `radiograph_raster`: bands of rows forward, splats backward."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange

from .math import FAST, exp_negative
from .radiograph_raster import BAND_ROWS, FARTHEST, LANES, PART, STRETCH
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
from .whitening import pixel_range

THIN_ETA = 0.5
"""Under this half thickness, in standard deviations, the slab's mean is taken from its series (error 1e-6)."""
LARGEST_ALPHA = np.float32(1 - 1e-6)
SQRT_HALF_PI = np.float32(np.sqrt(np.pi / 2))


@njit(inline="always")
def _signed_erf(t: Any, bell: Any) -> Any:
    """erf(t/√2) from t and exp(−t²/2): Abramowitz and Stegun 7.1.26, absolute error 1.5e-7."""
    size = abs(t)
    s = np.float32(1.0) / (np.float32(1.0) + np.float32(0.3275911 * 0.7071067811865476) * size)
    p = np.float32(1.061405429)
    p = p * s + np.float32(-1.453152027)
    p = p * s + np.float32(1.421413741)
    p = p * s + np.float32(-0.284496736)
    p = p * s + np.float32(0.254829592)
    value = np.float32(1.0) - p * s * bell
    return value if t >= np.float32(0.0) else -value


@njit(inline="always")
def _half_square(x: Any) -> Any:
    q = x * x
    q = q if q < FARTHEST else FARTHEST
    return np.float32(-0.5) * q


@njit(fastmath=FAST, error_model="numpy", cache=True, _nrt=False)
def _weights(x: Any, m: Any, y2: Any, eta: Any, count: int, weights: Any) -> None:
    """w of pixels from their components x and m (count,) and the row's squared y."""
    one = np.float32(1.0)
    if eta == np.float32(0.0):
        for k in range(count):
            q = x[k] * x[k] + m[k] * m[k] + y2
            q = q if q < FARTHEST else FARTHEST
            weights[k] = exp_negative(np.float32(-0.5) * q)
    elif eta < np.float32(THIN_ETA):
        e2 = eta * eta
        e4, e6 = e2 * e2 / np.float32(120), e2 * e2 * e2 / np.float32(5040)
        e2 /= np.float32(6)
        for k in range(count):
            m2 = m[k] * m[k]
            q = x[k] * x[k] + m2 + y2
            q = q if q < FARTHEST else FARTHEST
            m2 = m2 if m2 < FARTHEST else FARTHEST
            series = e6 * m2 + (e4 - np.float32(15) * e6)
            series = series * m2 + (e2 - np.float32(6) * e4 + np.float32(45) * e6)
            series = series * m2 + (one - e2 + np.float32(3) * e4 - np.float32(15) * e6)
            weights[k] = series * exp_negative(np.float32(-0.5) * q)
    else:
        scale = np.float32(0.5) * SQRT_HALF_PI / eta
        for k in range(count):
            q = x[k] * x[k] + y2
            q = q if q < FARTHEST else FARTHEST
            upper, lower = m[k] + eta, m[k] - eta
            mean = _signed_erf(upper, exp_negative(_half_square(upper)))
            mean -= _signed_erf(lower, exp_negative(_half_square(lower)))
            weights[k] = scale * mean * exp_negative(np.float32(-0.5) * q)


@njit(error_model="numpy", cache=True, _nrt=False)
def _row_start(row: Any, column0: float, down: float, sigmas: float, left: int, right: int) -> Any:
    """First and last pixel of a row within reach, and x, y, m at z₀ = 0 of that row in float64."""
    b = row[P12] * down + row[P13]
    y = row[P22] * down + row[P23]
    m = row[M2] * down + row[M3]
    p11, m1 = float(row[P11]), float(row[M1])
    low, high = -np.inf, np.inf
    room = sigmas * sigmas - y * y - (m * m if row[ETA] == 0 else 0.0)
    if room < 0:
        return left, left, b, y, m
    if p11 > 0:
        # Measured from where x = 0, so that a slanted needle's large terms do not cancel.
        half, middle = np.sqrt(room) / p11, -b / p11
        low, high = middle - half, middle + half
    if m1 != 0:
        half, middle = (sigmas + row[ETA]) / abs(m1), -m / m1
        low, high = max(low, middle - half), min(high, middle + half)
    first, last = pixel_range(low + column0, high + column0, right)
    return max(first, left), last, b, y, m


@njit(fastmath=FAST, error_model="numpy", cache=True, _nrt=False)
def _fill_row(xs: Any, ms: Any, filled: int, count: int, start_x: float, p11: Any, start_m: float, m1: Any) -> None:
    x0, m0 = np.float32(start_x), np.float32(start_m)
    for k in range(count):
        xs[filled + k] = x0 + p11 * np.float32(k)
        ms[filled + k] = m0 + m1 * np.float32(k)


@njit(fastmath=FAST, error_model="numpy", cache=True, _nrt=False)
def _add(out: Any, weights: Any, factor: Any) -> None:
    for k in range(len(out)):
        out[k] += factor * weights[k]


@njit(fastmath=FAST, error_model="numpy", cache=True, _nrt=False)
def _multiply_empty(out: Any, weights: Any, opacity: Any) -> None:
    for k in range(len(out)):
        alpha = opacity * weights[k]
        alpha = alpha if alpha < LARGEST_ALPHA else LARGEST_ALPHA
        out[k] *= np.float32(1.0) - alpha


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
            for i in range(max(boxes[n, 2], band * BAND_ROWS), min(boxes[n, 3], (band + 1) * BAND_ROWS)):
                first, last, b, y, m = _row_start(
                    row, reference[n, 0], i - reference[n, 1], sigmas, boxes[n, 0], boxes[n, 1]
                )
                if first >= last:
                    continue
                count = (last - first + LANES - 1) // LANES * LANES
                offset = first - reference[n, 0]
                _fill_row(xs, ms, 0, count, row[P11] * offset + b, row[P11], row[M1] * offset + m, row[M1])
                _weights(xs, ms, np.float32(y * y), row[ETA], count, weights)
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
    """
    count, channels = values.shape
    grad_means, grad_quats = np.zeros((count, 3)), np.zeros((count, 4))
    grad_scales, grad_amount = np.zeros((count, 3)), np.zeros(count)
    grad_values = np.zeros((count if want_values else 0, channels))
    sigmas = np.sqrt(k2)
    for task in prange((count + SPLATS_A_TASK - 1) // SPLATS_A_TASK):
        sums, of_channel = np.zeros(13), np.zeros(channels)
        pixels, lines = np.empty((6, STRETCH), np.float32), np.empty((channels, STRETCH), np.float32)
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
            _gather(grad, row, values[n], reference[n], boxes[n], sigmas, product, pixels, lines, sums, of_channel)
            grad_amount[n] = sums[0]
            if want_values:
                for channel in range(channels):
                    grad_values[n, channel] = row[AMOUNT] * of_channel[channel]
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


@njit(error_model="numpy", cache=True)
def _gather(
    grad: Any,
    row: Any,
    values: Any,
    reference: Any,
    box: Any,
    sigmas: float,
    product: bool,
    pixels: Any,
    lines: Any,
    sums: Any,
    of_channel: Any,
) -> None:
    """The sums of `geometry_backward` over a splat's pixels, its rows laid end to end in stretches."""
    filled = 0
    for i in range(box[2], box[3]):
        down = i - reference[1]
        first, last, b, y, m = _row_start(row, reference[0], down, sigmas, box[0], box[1])
        while first < last:
            count = min((last - first + LANES - 1) // LANES * LANES, STRETCH - filled)
            offset = first - reference[0]
            _fill_row(
                pixels[0], pixels[1], filled, count, row[P11] * offset + b, row[P11], row[M1] * offset + m, row[M1]
            )
            _fill_row(pixels[2], pixels[3], filled, count, offset, np.float32(1), down, np.float32(0))
            pixels[4, filled : filled + count] = np.float32(y)
            for channel in range(len(values)):
                lines[channel, filled : filled + count] = grad[channel, i, first : first + count]
            filled += count
            first += count
            if filled == STRETCH:
                _reduce_all(row, values, product, pixels, lines, filled, sums, of_channel)
                filled = 0
    if filled:
        _reduce_all(row, values, product, pixels, lines, filled, sums, of_channel)


@njit(fastmath=FAST, error_model="numpy", cache=True)
def _reduce_all(
    row: Any, values: Any, product: bool, pixels: Any, lines: Any, filled: int, sums: Any, of_channel: Any
) -> None:
    h = pixels[5]
    for k in range(filled):
        h[k] = values[0] * lines[0, k]
    for channel in range(1, len(values)):
        for k in range(filled):
            h[k] += values[channel] * lines[channel, k]
    weights = np.empty(filled, np.float32)
    if row[ETA] < np.float32(THIN_ETA):
        _reduce_thin(row, product, pixels, filled, weights, sums)
    else:
        _reduce_thick(row, product, pixels, filled, weights, sums)
    for channel in range(len(values)):
        total = np.float32(0.0)
        for k in range(filled):
            total += weights[k] * lines[channel, k]
        of_channel[channel] += total


@njit(inline="always")
def _share(h: Any, weight: Any, amount: Any, product: Any) -> Any:
    """dL/d(amount·w): of a product −dL/dT·T still has to be divided by this splat's own factor."""
    alpha = amount * weight * product
    return h / (np.float32(1.0) - alpha) if alpha < LARGEST_ALPHA else np.float32(0.0)


@njit(fastmath=FAST, error_model="numpy", cache=True, _nrt=False)
def _reduce_thin(row: Any, product: bool, pixels: Any, filled: int, weights: Any, sums: Any) -> None:
    xs, ms, rights, downs, ys, hs = pixels[0], pixels[1], pixels[2], pixels[3], pixels[4], pixels[5]
    amount, eta, of_product = row[AMOUNT], row[ETA], np.float32(1.0 if product else 0.0)
    one = np.float32(1.0)
    e2 = eta * eta
    c1, c2, c3 = e2 / np.float32(6), e2 * e2 / np.float32(120), e2 * e2 * e2 / np.float32(5040)
    d1, d2, d3 = eta / np.float32(3), eta * e2 / np.float32(30), eta * e2 * e2 / np.float32(840)
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = s8 = s9 = s10 = s11 = s12 = np.float32(0.0)
    for k in range(filled):
        x, m, y, right, down = xs[k], ms[k], ys[k], rights[k], downs[k]
        m2 = m * m
        q = x * x + y * y + m2
        q = q if q < FARTHEST else FARTHEST
        m2 = m2 if m2 < FARTHEST else FARTHEST
        bell = exp_negative(np.float32(-0.5) * q)
        h2 = m2 - one
        h4 = m2 * m2 - np.float32(6) * m2 + np.float32(3)
        h6 = ((m2 - np.float32(15)) * m2 + np.float32(45)) * m2 - np.float32(15)
        series = one + c1 * h2 + c2 * h4 + c3 * h6
        slope = np.float32(2) * c1 + c2 * (np.float32(4) * m2 - np.float32(12))
        slope += c3 * ((np.float32(6) * m2 - np.float32(60)) * m2 + np.float32(90))
        weight = bell * series
        weights[k] = weight
        h = _share(hs[k], weight, amount, of_product)
        tau = amount * h * weight
        extra = amount * h * bell * slope * m
        tau_x, tau_y, tau_m = tau * x, tau * y, tau * m - extra
        s0 += h * weight
        s1 += tau_x * right
        s2 += tau_x * down
        s3 += tau_x
        s4 += tau_y * right
        s5 += tau_y * down
        s6 += tau_y
        s7 += tau_m * right
        s8 += tau_m * down
        s9 += tau_m
        s10 += extra * x
        s11 += extra * y
        s12 += amount * h * bell * (d1 * h2 + d2 * h4 + d3 * h6)
    for place, value in enumerate((s0, s1, s2, s3, s4, s5, s6, s7, s8, s9, s10, s11, s12)):
        sums[place] += value


@njit(fastmath=FAST, error_model="numpy", cache=True, _nrt=False)
def _reduce_thick(row: Any, product: bool, pixels: Any, filled: int, weights: Any, sums: Any) -> None:
    xs, ms, rights, downs, ys, hs = pixels[0], pixels[1], pixels[2], pixels[3], pixels[4], pixels[5]
    amount, eta, of_product = row[AMOUNT], row[ETA], np.float32(1.0 if product else 0.0)
    scale, per_width = np.float32(0.5) * SQRT_HALF_PI / eta, np.float32(0.5) / eta
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = s8 = s9 = s10 = s11 = s12 = np.float32(0.0)
    for k in range(filled):
        x, m, y, right, down = xs[k], ms[k], ys[k], rights[k], downs[k]
        q = x * x + y * y
        q = q if q < FARTHEST else FARTHEST
        across = exp_negative(np.float32(-0.5) * q)
        upper, lower = m + eta, m - eta
        bell_upper, bell_lower = exp_negative(_half_square(upper)), exp_negative(_half_square(lower))
        mean = scale * (_signed_erf(upper, bell_upper) - _signed_erf(lower, bell_lower))
        weight = across * mean
        weights[k] = weight
        h = _share(hs[k], weight, amount, of_product)
        tau = amount * h * weight
        along = amount * h * across * per_width * (bell_upper - bell_lower)
        tau_x, tau_y, extra = tau * x, tau * y, along + tau * m
        s0 += h * weight
        s1 += tau_x * right
        s2 += tau_x * down
        s3 += tau_x
        s4 += tau_y * right
        s5 += tau_y * down
        s6 += tau_y
        s7 -= along * right
        s8 -= along * down
        s9 -= along
        s10 += extra * x
        s11 += extra * y
        s12 += amount * h * (across * per_width * (bell_upper + bell_lower) - weight / eta)
    for place, value in enumerate((s0, s1, s2, s3, s4, s5, s6, s7, s8, s9, s10, s11, s12)):
        sums[place] += value
