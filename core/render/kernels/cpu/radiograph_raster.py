"""The pixel loops of the radiograph: bands of rows forward, splat by splat backward.

Forward, each thread owns bands of rows and adds the splats in their order. Backward, each thread owns splats and
only reads the image's gradient. Nothing is shared between threads, so the result does not depend on their number.

A splat is drawn over the pixels within its reach. Where they begin and end is found for all rows of a band at once,
in one vector register of float64. Each row is then run in stretches of `LANES` pixels, one vector register of
float32; a stretch may go past the reach (exact values there too) or past the image's edge (columns of padding).
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

LANES = 16
BAND_ROWS = 8
PART = 1024
"""Splats added up before their sum is added to the image: a running float32 sum of 1e6 like terms errs by 0.5 %."""
FARTHEST = np.float32(160.0)
"""Squared distances of a splat's centre are cut here, far under float32's smallest number in exp(−½·)."""

# Planes of a band's buffer, one float for each row: first pixel within reach, number of stretches; then at that
# pixel z = (j − j₀, i − i₀, 1), P z and the first of R z, and the sum of squares of its other two, the same in the
# whole row. Indices are unsigned because Numba guards signed ones against negative values, which stops vectorising.
_FIRST, STRETCHES, _RIGHT, _DOWN, _A, _B, _R, _REST = (np.uint64(k * BAND_ROWS) for k in range(8))
PLANES = 8
# The 13 sums of `geometry_backward`, each with a place for every lane.
_S0, _S1, _S2, _S3, _S4, _S5, _S6, _S7, _S8, _S9, _S10, _S11, _S12 = (np.uint64(k * LANES) for k in range(13))
SUMS = 13
STRETCHES_A_SUM = 64
"""Stretches added up in float32 before their sum is added in float64."""


def padded_width(width: int) -> int:
    """Row length of the image buffers: room for a stretch that starts at the last pixel."""
    return width + LANES


@njit
def aligned_zeros(count: int) -> Any:
    """(count,) float32 at a multiple of a vector register's size: no access touches two lines of the cache."""
    buffer = np.zeros(count + LANES, np.float32)
    skipped = -(buffer.ctypes.data // 4) % LANES
    return buffer[skipped : skipped + count]


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


@njit(fastmath=FAST, error_model="numpy", _nrt=False)
def find_rows(row: Any, reference: Any, box: Any, k2: float, top: int, rows: Any) -> None:
    """Fills the planes (PLANES * BAND_ROWS,) float32 of the band that begins at row `top`, below the box too.

    Along a row num − k2·den = square·t² − 2·half_b·t + c, with t measured from where x = 0, so that a slanted
    needle's large terms do not cancel. One buffer, because LLVM vectorises a loop this short only when it need not
    ask whether what is written overlaps.
    """
    p11, p12, p13 = np.float64(row[P11]), np.float64(row[P12]), np.float64(row[P13])
    p22, p23 = np.float64(row[P22]), np.float64(row[P23])
    r11, r12, r13 = np.float64(row[R11]), np.float64(row[R12]), np.float64(row[R13])
    r22, r23, r33 = np.float64(row[R22]), np.float64(row[R23]), np.float64(row[R33])
    square = p11 * p11 - k2 * r11 * r11
    slope = -1.0 / p11 if p11 != 0.0 else 0.0
    # Where `square` is not positive all of a row counts as within reach.
    inverse, widened, missed = (1.0 / square, 0.0, -np.inf) if square > 0.0 else (0.0, np.inf, np.inf)
    column0, left, right = reference[0], np.float64(box[0]), np.float64(box[1])
    down0 = top - reference[1]
    for k in range(np.uint64(BAND_ROWS)):
        down = down0 + np.float64(np.int64(k))
        shift = slope * (p12 * down + p13)
        a = p11 * shift + (p12 * down + p13)
        r = r11 * shift + (r12 * down + r13)
        b = p22 * down + p23
        s = r22 * down + r23
        rest = s * s + r33 * r33
        half_b = k2 * r11 * r
        discriminant = half_b * half_b - square * (b * b - k2 * (r * r + rest))
        half = np.sqrt(discriminant if discriminant > 0.0 else 0.0) * inverse + widened
        half = missed if discriminant < 0.0 else half
        middle = half_b * inverse + shift + column0
        # Comparisons in this order, so that NaN gives the whole row.
        first, end = np.ceil(middle - half), np.floor(middle + half) + 1.0
        first = first if first > left else left
        first = first if first < right else right
        end = end if end < right else right
        end = end if end > first else first
        offset = first - column0
        rows[_FIRST + k] = first
        rows[STRETCHES + k] = np.ceil((end - first) * (1.0 / LANES))
        rows[_RIGHT + k] = offset
        rows[_DOWN + k] = down
        rows[_A + k] = p11 * (offset - shift) + a
        rows[_B + k] = b
        rows[_R + k] = r11 * (offset - shift) + r
        rows[_REST + k] = rest


@njit(parallel=True, error_model="numpy", cache=True)
def rasterize(
    table: Any, reference: Any, boxes: Any, starts: Any, splats: Any, k2: float, width: int, height: int
) -> Any:
    """Σ amplitude·den^(−1/2)·exp(−½ num/den) over the splats: (height, padded width) float32."""
    stride = width + LANES
    image = np.zeros(height * stride, np.float32)
    parts = np.zeros_like(image)
    for band in prange(len(starts) - 1):
        first_row = band * BAND_ROWS
        pixels = slice(first_row * stride, (first_row + BAND_ROWS) * stride)
        # Most bands have but one part, which goes straight to the image.
        single = starts[band + 1] - starts[band] <= PART
        target = image if single else parts
        rows = np.empty(PLANES * BAND_ROWS, np.float32)
        for begin in range(starts[band], starts[band + 1], PART):
            for entry in range(begin, min(begin + PART, starts[band + 1])):
                n = splats[entry]
                find_rows(table[n], reference[n], boxes[n], k2, first_row, rows)
                top, bottom = max(boxes[n, 2] - first_row, 0), min(boxes[n, 3] - first_row, BAND_ROWS)
                _add_splat(target, stride, first_row, table[n], rows, np.uint64(top), np.uint64(bottom))
            if not single:
                image[pixels] += parts[pixels]
                parts[pixels] = np.float32(0.0)
    return image.reshape((height, stride))


@njit(fastmath=FAST, error_model="numpy", cache=True, _nrt=False)
def _add_splat(image: Any, stride: int, first_row: int, row: Any, rows: Any, top: Any, bottom: Any) -> None:
    """Adds a splat to rows top..bottom of the band that begins at `first_row`; `image` is flat."""
    half, one = np.float32(0.5), np.float32(1.0)
    p11, r11, amplitude = row[P11], row[R11], row[AMPLITUDE]
    for k in range(top, bottom):
        a0, b, r0, rest = rows[_A + k], rows[_B + k], rows[_R + k], rows[_REST + k]
        b2 = b * b
        to = np.uint64((first_row + np.int64(k)) * stride + np.int64(rows[_FIRST + k]))
        for _ in range(np.int64(rows[STRETCHES + k])):
            for lane in range(np.uint64(LANES)):
                step = np.float32(np.int64(lane))
                a = p11 * step + a0
                r = r11 * step + r0
                inverse = one / (r * r + rest)
                q = (a * a + b2) * inverse
                q = q if q < FARTHEST else FARTHEST
                image[to + lane] += amplitude * np.sqrt(inverse) * exp_negative(-half * q)
            a0 += p11 * np.float32(LANES)
            r0 += r11 * np.float32(LANES)
            to += np.uint64(LANES)


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
    pixels = grad.reshape(-1)
    grad_views = np.zeros((count if want_view else 0, 4, 3))
    for task in prange((count + SPLATS_A_TASK - 1) // SPLATS_A_TASK):
        sums = np.zeros(SUMS)
        grad_view = np.zeros((4, 3))
        rows, lanes = np.empty(PLANES * BAND_ROWS, np.float32), aligned_zeros(SUMS * LANES)
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
            _gather(pixels, width + LANES, table[n], reference[n], boxes[n], k2, rows, lanes, sums)
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


@njit(fastmath=FAST, error_model="numpy", cache=True, _nrt=False)
def _gather(
    grad: Any, stride: int, row: Any, reference: Any, box: Any, k2: float, rows: Any, lanes: Any, sums: Any
) -> None:
    """Adds a splat's pixels to the sums of `geometry_backward`; `grad` is flat, `lanes` 0 before and after."""
    added: Any = 0
    for top in range(box[2], box[3], BAND_ROWS):
        find_rows(row, reference, box, k2, top, rows)
        for k in range(np.uint64(min(BAND_ROWS, box[3] - top))):
            right, down, rest = rows[_RIGHT + k], rows[_DOWN + k], rows[_REST + k]
            a, b, r = rows[_A + k], rows[_B + k], rows[_R + k]
            stretches = np.int64(rows[STRETCHES + k])
            at = np.uint64((top + np.int64(k)) * stride + np.int64(rows[_FIRST + k]))
            for _ in range(stretches):
                _add_stretch(grad, at, row, right, down, a, b, r, rest, lanes)
                right += np.float32(LANES)
                a += row[P11] * np.float32(LANES)
                r += row[R11] * np.float32(LANES)
                at += np.uint64(LANES)
            added += stretches
            if added >= STRETCHES_A_SUM:
                add_lanes(lanes, sums)
                added = 0
    add_lanes(lanes, sums)


@njit(fastmath=FAST, error_model="numpy", forceinline=True, _nrt=False)
def _add_stretch(
    grad: Any, at: Any, row: Any, right: Any, down: Any, a0: Any, b: Any, r0: Any, rest: Any, lanes: Any
) -> None:
    """Adds one stretch, which begins at `at`, to the sums of each lane."""
    p11, r11, half_amplitude = row[P11], row[R11], np.float32(0.5) * row[AMPLITUDE]
    half, one = np.float32(0.5), np.float32(1.0)
    b2 = b * b
    for lane in range(np.uint64(LANES)):
        step = np.float32(np.int64(lane))
        x = right + step
        a = p11 * step + a0
        r = r11 * step + r0
        inverse = one / (r * r + rest)
        q = (a * a + b2) * inverse
        q = q if q < FARTHEST else FARTHEST
        w = grad[at + lane] * np.sqrt(inverse) * exp_negative(-half * q)
        tau = half_amplitude * w * inverse
        gamma = tau * (q - one)
        tau_a, tau_b = tau * a, tau * b
        gamma_x, gamma_y = gamma * x, gamma * down
        lanes[_S0 + lane] += w
        lanes[_S1 + lane] += tau_a * x
        lanes[_S2 + lane] += tau_a * down
        lanes[_S3 + lane] += tau_a
        lanes[_S4 + lane] += tau_b * x
        lanes[_S5 + lane] += tau_b * down
        lanes[_S6 + lane] += tau_b
        lanes[_S7 + lane] += gamma_x * x
        lanes[_S8 + lane] += gamma_x * down
        lanes[_S9 + lane] += gamma_y * down
        lanes[_S10 + lane] += gamma_x
        lanes[_S11 + lane] += gamma_y
        lanes[_S12 + lane] += gamma


@njit(fastmath=FAST, error_model="numpy", cache=True, _nrt=False)
def add_lanes(lanes: Any, sums: Any) -> None:
    """Adds what the lanes have to `sums`, and makes them 0."""
    for place in range(np.uint64(SUMS)):
        total = np.float32(0.0)
        for lane in range(np.uint64(LANES)):
            total += lanes[np.uint64(LANES) * place + lane]
        sums[place] += total
    lanes[:] = np.float32(0.0)
