"""The pixel loops of the radiograph: bands of rows forward, splat by splat backward.

Forward, each thread owns bands of rows and adds the splats in their order. Backward, each thread owns splats and
only reads the image's gradient. Nothing is shared between threads, so the result does not depend on their number.
Rows outside a splat's reach are skipped and the rest of a row is run in stretches of `LANES` pixels; a stretch may
go past the reach (exact values there too) or past the image's edge (columns of padding).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange

from .math import FAST, exp_negative
from .radiograph_geometry import (
    AMPLITUDE,
    P11,
    P12,
    P13,
    P22,
    P23,
    R11,
    R12,
    R13,
    R22,
    R23,
    R33,
    SPLATS_A_TASK,
    geometry_backward,
)
from .whitening import pixel_range, quadratic_range

LANES = 8
BAND_ROWS = 8
STRETCH = 1024
PART = 1024
"""Splats added up before their sum is added to the image: a running float32 sum of 1e6 like terms errs by 0.5 %."""
FARTHEST = np.float32(160.0)
"""Squared distances of a splat's centre are cut here, far under float32's smallest number in exp(−½·)."""


def padded_width(width: int) -> int:
    """Row length of the image buffers: room for a stretch that starts at the last pixel."""
    return width + LANES


@njit(error_model="numpy", cache=True)
def list_bands(boxes: Any, height: int) -> Any:
    """Splats of each band of rows in their order: starts (bands + 1,) and splats (P,), int32."""
    bands = (height + BAND_ROWS - 1) // BAND_ROWS
    starts = np.zeros(bands + 1, np.int64)
    for n in range(len(boxes)):
        if boxes[n, 0] < boxes[n, 1] and boxes[n, 2] < boxes[n, 3]:
            for band in range(boxes[n, 2] // BAND_ROWS, (boxes[n, 3] - 1) // BAND_ROWS + 1):
                starts[band + 1] += 1
    for band in range(bands):
        starts[band + 1] += starts[band]
    splats = np.empty(starts[bands], np.int32)
    filled = starts[:-1].copy()
    for n in range(len(boxes)):
        if boxes[n, 0] < boxes[n, 1] and boxes[n, 2] < boxes[n, 3]:
            for band in range(boxes[n, 2] // BAND_ROWS, (boxes[n, 3] - 1) // BAND_ROWS + 1):
                splats[filled[band]] = n
                filled[band] += 1
    return starts, splats


@njit(inline="always")
def _span(row: Any, column0: float, y: float, k2: float, left: int, right: int) -> Any:
    """Pixels [first, last) of the row at y = i − i₀ with num ≤ k2·den, within the splat's box, and j − j₀ where x = 0.

    Pixels are measured from there, so that a slanted needle's large terms do not cancel.
    """
    p11, r11 = float(row[P11]), float(row[R11])
    if p11 == 0.0:
        return left, right, 0.0
    shift = -(row[P12] * y + row[P13]) / p11
    level = row[P22] * y + row[P23]
    b = r11 * shift + row[R12] * y + row[R13]
    c = row[R22] * y + row[R23]
    low, high = quadratic_range(
        p11 * p11 - k2 * r11 * r11,
        -k2 * r11 * b,
        level * level - k2 * (b * b + c * c + float(row[R33]) * row[R33]),
    )
    first, last = pixel_range(low + shift + column0, high + shift + column0, right)
    return max(first, left), last, shift


@njit(parallel=True, error_model="numpy", cache=True)
def rasterize(
    table: Any, reference: Any, boxes: Any, starts: Any, splats: Any, k2: float, width: int, height: int
) -> Any:
    """Σ amplitude·den^(−1/2)·exp(−½ num/den) over the splats: (height, padded width) float32."""
    image = np.zeros((height, width + LANES), np.float32)
    parts = np.zeros_like(image)
    for band in prange(len(starts) - 1):
        rows = slice(band * BAND_ROWS, (band + 1) * BAND_ROWS)
        # Most bands have but one part, which goes straight to the image.
        single = starts[band + 1] - starts[band] <= PART
        target = image if single else parts
        for begin in range(starts[band], starts[band + 1], PART):
            for entry in range(begin, min(begin + PART, starts[band + 1])):
                n = splats[entry]
                top, bottom = max(boxes[n, 2], band * BAND_ROWS), min(boxes[n, 3], (band + 1) * BAND_ROWS)
                _add_splat(target, table[n], reference[n], boxes[n], k2, top, bottom)
            if not single:
                image[rows] += parts[rows]
                parts[rows] = np.float32(0.0)
    return image


@njit(fastmath=FAST, error_model="numpy", cache=True, _nrt=False)
def _add_splat(image: Any, row: Any, reference: Any, box: Any, k2: float, top: int, bottom: int) -> None:
    half, one = np.float32(0.5), np.float32(1.0)
    p11, r11, amplitude = row[P11], row[R11], row[AMPLITUDE]
    for i in range(top, bottom):
        down = i - reference[1]
        first, last, shift = _span(row, reference[0], down, k2, box[0], box[1])
        y = np.float32(row[P22] * down + row[P23])
        z = np.float32(row[R22] * down + row[R23])
        y2 = y * y
        z2 = z * z + row[R33] * row[R33]
        b1 = np.float32(row[P11] * shift + (row[P12] * down + row[P13]))
        b2 = np.float32(row[R11] * shift + (row[R12] * down + row[R13]))
        for start in range(first, last, LANES):
            out = image[i, start : start + LANES]
            right = np.float32(start - reference[0] - shift)
            for lane in range(LANES):
                x = right + np.float32(lane)
                a = p11 * x + b1
                r = r11 * x + b2
                inverse = one / (r * r + z2)
                q = (a * a + y2) * inverse
                q = q if q < FARTHEST else FARTHEST
                out[lane] += amplitude * np.sqrt(inverse) * exp_negative(-half * q)


@njit(parallel=True, error_model="numpy", cache=True)
def rasterize_backward(
    grad: Any,
    means: Any,
    quats: Any,
    scales: Any,
    density: Any,
    view: Any,
    table: Any,
    reference: Any,
    boxes: Any,
    k2: float,
    width: int,
    height: int,
    kind: int,
    want_view: bool,
) -> Any:
    """Gradients of means, quats, scales, density and, one row for each splat, of the view (N or 0, 4, 3), float64.

    Args:
        grad: (height, padded width) float32 dL/dimage, 0 in the padding.
    """
    count = len(means)
    grad_means, grad_quats = np.zeros((count, 3)), np.zeros((count, 4))
    grad_scales, grad_density = np.zeros((count, 3)), np.zeros(count)
    grad_views = np.zeros((count if want_view else 0, 4, 3))
    for task in prange((count + SPLATS_A_TASK - 1) // SPLATS_A_TASK):
        sums = np.zeros(13)
        grad_view = np.zeros((4, 3))
        pixels = np.empty((4, STRETCH), np.float32)
        scratch = (
            np.empty(4),
            np.empty((3, 3)),
            np.empty((15, 3)),
            np.empty((3, 3)),
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
            _gather(grad, table[n], reference[n], boxes[n], k2, pixels, sums)
            grad_density[n] = geometry_backward(
                sums,
                means[n],
                quats[n],
                scales[n],
                density[n],
                view,
                width,
                height,
                kind,
                scratch,
                grad_means[n],
                grad_quats[n],
                grad_scales[n],
                grad_view,
            )
            if want_view:
                grad_views[n] = grad_view
    return grad_means, grad_quats, grad_scales, grad_density, grad_views


@njit(error_model="numpy", cache=True, _nrt=False)
def _gather(grad: Any, row: Any, reference: Any, box: Any, k2: float, pixels: Any, sums: Any) -> None:
    """The sums of `geometry_backward` over a splat's pixels, its rows laid end to end in one stretch."""
    filled = 0
    for i in range(box[2], box[3]):
        down = i - reference[1]
        first, last, shift = _span(row, reference[0], down, k2, box[0], box[1])
        b1 = row[P11] * shift + (row[P12] * down + row[P13])
        for start in range(first, last, LANES):
            right = start - reference[0]
            _fill(
                pixels, filled, right, row[P11], row[P11] * (right - shift) + b1, down, grad[i, start : start + LANES]
            )
            filled += LANES
            if filled == STRETCH:
                _reduce(row, pixels, filled, sums)
                filled = 0
    if filled:
        _reduce(row, pixels, filled, sums)


@njit(fastmath=FAST, error_model="numpy", cache=True, _nrt=False)
def _fill(pixels: Any, filled: int, right: float, p11: Any, a: float, down: float, line: Any) -> None:
    """One stretch of j − j₀, i − i₀, x and dL/dimage."""
    right32, a32, down32 = np.float32(right), np.float32(a), np.float32(down)
    part = pixels[:, filled : filled + LANES]
    for lane in range(LANES):
        part[0, lane] = right32 + np.float32(lane)
        part[1, lane] = down32
        part[2, lane] = a32 + p11 * np.float32(lane)
        part[3, lane] = line[lane]


@njit(fastmath=FAST, error_model="numpy", cache=True, _nrt=False)
def _reduce(row: Any, pixels: Any, filled: int, sums: Any) -> None:
    xs, ys, others, hs = pixels[0], pixels[1], pixels[2], pixels[3]
    p22, p23 = row[P22], row[P23]
    r11, r12, r13, r22, r23 = row[R11], row[R12], row[R13], row[R22], row[R23]
    floor, half_amplitude = row[R33] * row[R33], np.float32(0.5) * row[AMPLITUDE]
    half, one, zero = np.float32(0.5), np.float32(1.0), np.float32(0.0)
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = s8 = s9 = s10 = s11 = s12 = zero
    for m in range(filled):
        x, y, a, h = xs[m], ys[m], others[m], hs[m]
        b = p22 * y + p23
        r = r11 * x + r12 * y + r13
        s = r22 * y + r23
        inverse = one / (r * r + s * s + floor)
        q = (a * a + b * b) * inverse
        q = q if q < FARTHEST else FARTHEST
        w = h * np.sqrt(inverse) * exp_negative(-half * q)
        tau = half_amplitude * w * inverse
        gamma = tau * (q - one)
        tau_a, tau_b = tau * a, tau * b
        gamma_x, gamma_y = gamma * x, gamma * y
        s0 += w
        s1 += tau_a * x
        s2 += tau_a * y
        s3 += tau_a
        s4 += tau_b * x
        s5 += tau_b * y
        s6 += tau_b
        s7 += gamma_x * x
        s8 += gamma_x * y
        s9 += gamma_y * y
        s10 += gamma_x
        s11 += gamma_y
        s12 += gamma
    for place, value in enumerate((s0, s1, s2, s3, s4, s5, s6, s7, s8, s9, s10, s11, s12)):
        sums[place] += value
