"""The pixel loops of the radiograph: bands of rows forward, splat by splat backward.

Forward, each thread owns bands of rows and adds the splats in their order. Backward, each thread owns splats and
only reads the image's gradient. Nothing is shared between threads, so the result does not depend on their number.

A splat is drawn over the pixels within its reach. Where they begin and end is found for all rows of a band at once,
in one vector register of float64. Each row is then cut into strips of `LANES` pixels; a strip may go past the reach
(exact values there too) or past the image's edge (columns of padding). The work on the strips of some splats is cut
into loops that hand on what they found, as in `splat_raster`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ....compiled import njit, prange
from ....threads import loops_only
from .bands import BAND_ROWS, FARTHEST, LANES, PART, SUMS
from .math import bits_of_float, float_from_bits
from .radiograph_geometry import CONE, SPLATS_A_TASK, geometry_backward
from .radiograph_lanes import BATCH, BUFFER
from .radiograph_table import (
    A_AT,
    A_DOWN,
    AMPLITUDE,
    BOTTOM,
    COLUMN0,
    COLUMNS,
    HALF,
    INVERSE,
    LEFT,
    MIDDLE,
    P11,
    P22,
    P23,
    PER_ROOT,
    R11,
    R22,
    R23,
    R33_SQUARED,
    R_AT,
    R_DOWN,
    RIGHT,
    ROW0,
    SHIFT,
    SHIFT_DOWN,
    TOP,
)
from .vectors import LANES as REGISTER
from .vectors import aligned, exp2, inverse_root, lane_numbers, least, load, prefetch, spread, store, totals, where

# Up to so many times `BAND_ROWS` rows are cut into strips together, and so many strips worked on in one loop.
GROUPS, STRIPS = 8, 96
ROWS = GROUPS * BAND_ROWS
# What is known of each row, plane by plane: at its first pixel within reach z = (j − j₀, i − i₀, 1), P z, the square of
# its second, the first of R z, and the sum of squares of its other two; what the first components grow by from pixel to
# pixel; the amplitude; as bits of int32 the first pixel's place in the image and the number of strips. The planes are a
# little apart: a processor takes a store and a load 4096 bytes from each other for the same place at first.
_APART = ROWS + 16
_RIGHT, _DOWN, _A, _B, _BB, _R, _REST, _P11, _R11, _AMPLITUDE, _PLACE, _COUNT = (
    np.uint64(k * _APART) for k in range(12)
)
# Then what a loop hands on, for each pixel of its strips.
_HANDED = (STRIPS + 21) * LANES
_ROOT, _Q, _TAU = (np.uint64(12 * _APART + k * _HANDED) for k in range(3))
_W, _GAMMA = _ROOT, _Q
_TOTALS = np.uint64(12 * _APART + 3 * _HANDED)
_FLOATS = int(_TOTALS) + LANES
# Whole numbers: the first strip of each group of rows; each splat's first group and number.
_FIRST, _FIRST_GROUP, _SPLAT = (np.uint64(k * (GROUPS + 2)) for k in range(3))
_INTS = 3 * (GROUPS + 2)

LARGEST_DEN, SMALLEST_REST = np.float32(1e37), 1e-37
_NOTHING, _ONE = np.float32(0.0), np.float32(1.0)
_STRIP, _GROUP, _REGISTER = np.uint64(LANES), np.uint64(BAND_ROWS), np.uint64(REGISTER)
_SQUARE_ROOTS = np.float32(1 / PER_ROOT**2)
_FARTHEST = np.float32(FARTHEST * PER_ROOT**2)


@njit
def empty_strips(width: int) -> Any:
    """Room for the rows of `GROUPS` groups and all strips of an image so wide: floats, whole numbers, and two lists."""
    most = ROWS * ((width + LANES - 1) // LANES) + 2
    return aligned(_FLOATS), np.zeros(_INTS, np.int32), np.empty(most, np.int32), np.empty(most, np.float32)


@njit(fastmath={"contract", "nsz"}, error_model="numpy", forceinline=True, _nrt=False)
def find_rows(table: Any, n: Any, k2: float, stride: Any, top: Any, end: Any, floats: Any, group: Any) -> None:
    """What is known of the splat's rows from `top` on, a group of them, of which those before `end` have strips.

    One buffer, because LLVM vectorises a loop this short only when it need not ask whether what is written overlaps.
    """
    shift_down, shift_at, r_down, r_at = table[n, SHIFT_DOWN], table[n, SHIFT], table[n, R_DOWN], table[n, R_AT]
    p11, p22, p23 = table[n, P11], table[n, P22], table[n, P23]
    r11, r22, r23, r33_squared = table[n, R11], table[n, R22], table[n, R23], table[n, R33_SQUARED]
    inverse, wide, aside = table[n, INVERSE], table[n, HALF], table[n, MIDDLE]
    column0, left, right = table[n, COLUMN0], table[n, LEFT], table[n, RIGHT]
    a_down, a_at, amplitude = table[n, A_DOWN], table[n, A_AT], np.float32(table[n, AMPLITUDE])
    down0, left_over, place0 = top - table[n, ROW0], end - top, np.float64(top * stride)
    step_a, step_r = np.float32(p11), np.float32(r11)
    for k in range(_GROUP):
        row = group * _GROUP + k
        below = np.float64(np.int64(k))
        down = down0 + below
        shift = shift_down * down + shift_at
        r = r_down * down + r_at
        b = p22 * down + p23
        s = r22 * down + r23
        rest = s * s + r33_squared
        half = wide * r * (wide * r) + inverse * (k2 * rest - b * b)
        half = -np.inf if half < 0.0 else np.sqrt(half)
        middle = aside * r + shift + column0
        # Comparisons in this order, so that NaN gives the whole row.
        first, stop = np.ceil(middle - half), np.floor(middle + half) + 1.0
        first = first if first > left else left
        first = first if first < right else right
        stop = stop if stop < right else right
        count = np.ceil((stop - first) * (1.0 / LANES))
        count = count if count > 0.0 else 0.0
        count = count if below < left_over else 0.0
        offset = first - column0
        beyond = offset - shift
        floats[_RIGHT + row] = offset
        floats[_DOWN + row] = down
        floats[_A + row] = p11 * beyond + (a_down * down + a_at)
        floats[_B + row] = b
        floats[_BB + row] = b * b
        floats[_R + row] = r11 * beyond + r
        floats[_REST + row] = rest if rest > SMALLEST_REST else SMALLEST_REST
        floats[_P11 + row] = step_a
        floats[_R11 + row] = step_r
        floats[_AMPLITUDE + row] = amplitude
        floats[_PLACE + row] = float_from_bits(np.int32(place0 + below * stride + first))
        floats[_COUNT + row] = float_from_bits(np.int32(count))


@njit(error_model="numpy", forceinline=True, _nrt=False)
def cut(floats: Any, ints: Any, groups: Any, rows: Any, offsets: Any) -> Any:
    """Lists the row and the offset in it of every strip; returns how many."""
    strips = np.uint64(0)
    for group in range(groups):
        ints[_FIRST + group] = strips
        for k in range(_GROUP):
            row = group * _GROUP + k
            count = bits_of_float(floats[_COUNT + row])
            # Most rows have one strip or two: both are written, the next row's over those that are none.
            rows[strips], offsets[strips] = row, _NOTHING
            strips += np.uint64(count > 0)
            rows[strips], offsets[strips] = row, np.float32(LANES)
            strips += np.uint64(count > 1)
            for extra in range(2, count):
                rows[strips], offsets[strips] = row, np.float32(extra * LANES)
                strips += np.uint64(1)
    ints[_FIRST + groups] = strips
    return strips


@njit(parallel=loops_only(), error_model="numpy", cache=True)
def rasterize(table: Any, starts: Any, splats: Any, k2: float, width: int, height: int, flat: bool) -> Any:
    """Σ amplitude·den^(−1/2)·exp(−½ num/den) over the splats: (height, padded width) float32; `flat`: all den are 1."""
    stride = width + LANES
    image = np.zeros(height * stride, np.float32)
    parts = np.zeros(height * stride, np.float32)
    for band in prange(len(starts) - 1):
        first_row = np.int64(band) * BAND_ROWS
        floats, ints, rows, offsets = empty_strips(width)
        stop = starts[band + 1]
        # Most bands have but one part, which goes straight to the image.
        single = stop - starts[band] <= PART
        target = image if single else parts
        for begin in range(starts[band], stop, PART):
            for first in range(begin, min(begin + PART, stop), GROUPS):
                groups = np.uint64(min(first + GROUPS, begin + PART, stop) - first)
                for entry in range(np.uint64(first + GROUPS), np.uint64(min(first + 2 * GROUPS, stop))):
                    for line in range(0, COLUMNS, 8):
                        prefetch(table, np.uint64(splats[entry]) * np.uint64(COLUMNS) + np.uint64(line))
                for group in range(groups):
                    n = np.uint64(splats[np.uint64(first) + group])
                    top = max(np.int64(table[n, TOP]), first_row)
                    end = min(table[n, BOTTOM], first_row + BAND_ROWS)
                    find_rows(table, n, k2 * PER_ROOT**2, stride, top, end, floats, group)
                strips = cut(floats, ints, groups, rows, offsets)
                if flat:
                    _draw_flat(target, floats, rows, offsets, strips)
                else:
                    _draw(target, floats, rows, offsets, strips)
            if not single:
                last_row: Any = min(first_row + BAND_ROWS, height)
                for k in range(first_row * stride, last_row * stride):
                    image[k] += parts[k]
                    parts[k] = _NOTHING
    return image.reshape((height, stride))


@njit(error_model="numpy", forceinline=True, _nrt=False)
def _draw(image: Any, floats: Any, rows: Any, offsets: Any, strips: Any) -> None:
    """Adds the strips to the flat image."""
    for begin in range(np.uint64(0), strips, np.uint64(STRIPS)):
        end = min(begin + np.uint64(STRIPS), strips)
        _pass_by(floats, rows, offsets, begin, end)
        for strip in range(begin, end):
            row = np.uint64(rows[strip])
            place = np.uint64(bits_of_float(floats[_PLACE + row])) + np.uint64(offsets[strip])
            for column in range(np.uint64(0), _STRIP, _REGISTER):
                at = (strip - begin) * _STRIP + column
                value = load(floats, _ROOT + at) * floats[_AMPLITUDE + row] * _within_reach(load(floats, _Q + at))
                store(image, place + column, load(image, place + column) + value)


@njit(error_model="numpy", forceinline=True, _nrt=False)
def _draw_flat(image: Any, floats: Any, rows: Any, offsets: Any, strips: Any) -> None:
    """`_draw` where den is 1: what is left of a pixel needs no second loop."""
    for strip in range(strips):
        row = np.uint64(rows[strip])
        place = np.uint64(bits_of_float(floats[_PLACE + row])) + np.uint64(offsets[strip])
        for column in range(np.uint64(0), _STRIP, _REGISTER):
            value = floats[_AMPLITUDE + row] * _within_reach(_flat_power(floats, row, offsets[strip], column))
            store(image, place + column, load(image, place + column) + value)


@njit(error_model="numpy", forceinline=True, _nrt=False)
def _flat_power(floats: Any, row: Any, offset: Any, column: Any) -> Any:
    """num times `PER_ROOT` squared of the pixels from `column` on in a strip."""
    a = (lane_numbers() + np.float32(column) + offset) * floats[_P11 + row] + floats[_A + row]
    return least(a * a + floats[_BB + row], _FARTHEST)


@njit(error_model="numpy", forceinline=True, _nrt=False)
def _within_reach(q: Any) -> Any:
    """2^(−q), and 0 where q was cut."""
    return where(q < _FARTHEST, exp2(_NOTHING - q))


@njit(error_model="numpy", forceinline=True, _nrt=False)
def _pass_by(floats: Any, rows: Any, offsets: Any, begin: Any, end: Any) -> None:
    """den^(−1/2) and num/den times `PER_ROOT` squared of each pixel of the strips begin..end."""
    for strip in range(begin, end):
        row = np.uint64(rows[strip])
        for column in range(np.uint64(0), _STRIP, _REGISTER):
            step = lane_numbers() + np.float32(column) + offsets[strip]
            a = step * floats[_P11 + row] + floats[_A + row]
            r = step * floats[_R11 + row] + floats[_R + row]
            root = inverse_root(least(r * r + floats[_REST + row], LARGEST_DEN))
            q = least((a * a + floats[_BB + row]) * (root * root), _FARTHEST)
            store(floats, _ROOT + (strip - begin) * _STRIP + column, root)
            store(floats, _Q + (strip - begin) * _STRIP + column, q)


@njit(parallel=loops_only(), error_model="numpy", cache=True)
def rasterize_backward(
    grad: Any,
    means: Any,
    quats: Any,
    scales: Any,
    density: Any,
    view: Any,
    table: Any,
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
        start = np.int64(task) * SPLATS_A_TASK
        stop: Any = min(start + SPLATS_A_TASK, count)
        sums = np.zeros((SPLATS_A_TASK, LANES))
        _gather(pixels, width, table, boxes, k2 * PER_ROOT**2, start, stop, kind != CONE, sums)
        _scale_sums(table, start, stop, sums)
        lanes, found, batch = np.zeros(BUFFER), np.empty(BATCH, np.uint64), 0
        for n in range(start, stop):
            if boxes[n, 0] < boxes[n, 1] and boxes[n, 2] < boxes[n, 3]:
                found[batch] = n - start
                batch += 1
            if batch == BATCH or n == stop - 1:
                geometry_backward(
                    found, batch, sums, start, means, quats, scales, density, view, width, height, kind, lanes,
                    grad_means, grad_quats, grad_scales, grad_density, grad_views,
                )  # fmt: skip
                batch = 0
    return grad_means, grad_quats, grad_scales, grad_density, grad_views


@njit(error_model="numpy", _nrt=False)
def _scale_sums(table: Any, start: Any, stop: Any, sums: Any) -> None:
    """What `_gather` left out."""
    for n in range(np.uint64(stop - start)):
        half_amplitude = 0.5 * table[np.uint64(start) + n, AMPLITUDE]
        for k in range(np.uint64(1), np.uint64(SUMS)):
            sums[n, k] *= half_amplitude if k > np.uint64(6) else half_amplitude * (1 / PER_ROOT)


@njit(error_model="numpy", cache=True)
def _gather(
    grad: Any, width: Any, table: Any, boxes: Any, k2: float, start: Any, stop: Any, flat: bool, sums: Any
) -> None:
    """Adds the pixels of the splats start..stop to their rows of `sums` (stop − start, 16); `grad` is flat.

    The sums are those of `geometry_backward`, but for the factors that are the same in all pixels: half the amplitude
    in all except the first, and `PER_ROOT` in those with x or y. `flat`: all den are 1, and of the sums with γ only the
    last is added up.
    """
    stride = width + LANES
    floats, ints, rows, offsets = empty_strips(width)
    groups, splats = np.uint64(0), np.uint64(0)
    for n in range(start, stop):
        if boxes[n, 0] >= boxes[n, 1] or boxes[n, 2] >= boxes[n, 3]:
            continue
        ints[_FIRST_GROUP + splats], ints[_SPLAT + splats] = groups, n - start
        splats += np.uint64(1)
        for top in range(boxes[n, 2], boxes[n, 3], BAND_ROWS):
            if groups == GROUPS:
                ints[_FIRST_GROUP + splats] = groups
                _add_up(grad, floats, ints, groups, splats, rows, offsets, flat, sums)
                groups, splats = np.uint64(0), np.uint64(1)
                ints[_FIRST_GROUP], ints[_SPLAT] = 0, n - start
            find_rows(table, np.uint64(n), k2, stride, top, table[n, BOTTOM], floats, groups)
            groups += np.uint64(1)
    ints[_FIRST_GROUP + splats] = groups
    _add_up(grad, floats, ints, groups, splats, rows, offsets, flat, sums)


@njit(error_model="numpy", _nrt=False)
def _add_up(
    grad: Any, floats: Any, ints: Any, groups: Any, splats: Any, rows: Any, offsets: Any, flat: bool, sums: Any
) -> None:
    strips = cut(floats, ints, groups, rows, offsets)
    for begin in range(np.uint64(0), strips, np.uint64(STRIPS)):
        end = min(begin + np.uint64(STRIPS), strips)
        if flat:
            _weigh_flat(grad, floats, rows, offsets, begin, end)
        else:
            _pass_by(floats, rows, offsets, begin, end)
            _weigh(grad, floats, rows, offsets, begin, end)
        for splat in range(splats):
            first: Any = np.uint64(ints[_FIRST + np.uint64(ints[_FIRST_GROUP + splat])])
            last: Any = np.uint64(ints[_FIRST + np.uint64(ints[_FIRST_GROUP + splat + np.uint64(1)])])
            first, last = max(first, begin), min(last, end)
            if first < last:
                if flat:
                    _add_flat(floats, rows, offsets, begin, first, last)
                else:
                    _add_splat(floats, rows, offsets, begin, first, last)
                for k in range(np.uint64(LANES)):
                    sums[np.uint64(ints[_SPLAT + splat]), k] += floats[_TOTALS + k]


@njit(error_model="numpy", forceinline=True, _nrt=False)
def _weigh(grad: Any, floats: Any, rows: Any, offsets: Any, begin: Any, end: Any) -> None:
    """h·w, τ and γ of each pixel of the strips, but for the amplitude."""
    for strip in range(begin, end):
        place = np.uint64(bits_of_float(floats[_PLACE + np.uint64(rows[strip])])) + np.uint64(offsets[strip])
        for column in range(np.uint64(0), _STRIP, _REGISTER):
            at = (strip - begin) * _STRIP + column
            root, q = load(floats, _ROOT + at), load(floats, _Q + at)
            w = load(grad, place + column) * root * _within_reach(q)
            tau = w * (root * root)
            store(floats, _W + at, w)
            store(floats, _TAU + at, tau)
            store(floats, _GAMMA + at, tau * (q * _SQUARE_ROOTS - _ONE))


@njit(error_model="numpy", forceinline=True, _nrt=False)
def _weigh_flat(grad: Any, floats: Any, rows: Any, offsets: Any, begin: Any, end: Any) -> None:
    """`_weigh` where den is 1, so that τ is h·w."""
    for strip in range(begin, end):
        row = np.uint64(rows[strip])
        place = np.uint64(bits_of_float(floats[_PLACE + row])) + np.uint64(offsets[strip])
        for column in range(np.uint64(0), _STRIP, _REGISTER):
            at = (strip - begin) * _STRIP + column
            q = _flat_power(floats, row, offsets[strip], column)
            w = load(grad, place + column) * _within_reach(q)
            store(floats, _W + at, w)
            store(floats, _GAMMA + at, w * (q * _SQUARE_ROOTS - _ONE))


@njit(error_model="numpy", forceinline=True, _nrt=False)
def _add_splat(floats: Any, rows: Any, offsets: Any, begin: Any, first: Any, last: Any) -> None:
    """The sums over the strips first..last, all of one splat, of which `begin` is the first that was weighed."""
    zero = spread(_NOTHING)
    s0, s1, s2, s3, s4, s5, s6, s7, s8, s9, s10, s11, s12 = (
        zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero,
    )  # fmt: skip
    p11 = floats[_P11 + np.uint64(rows[first])]
    for strip in range(first, last):
        row, offset = np.uint64(rows[strip]), offsets[strip]
        down, b = floats[_DOWN + row], floats[_B + row]
        for column in range(np.uint64(0), _STRIP, _REGISTER):
            to = (strip - begin) * _STRIP + column
            step = lane_numbers() + np.float32(column) + offset
            x = step + floats[_RIGHT + row]
            w, tau, gamma = load(floats, _W + to), load(floats, _TAU + to), load(floats, _GAMMA + to)
            tau_a, tau_b = tau * (step * p11 + floats[_A + row]), tau * b
            gamma_x, gamma_y = gamma * x, gamma * down
            s0 = s0 + w
            s1 = s1 + tau_a * x
            s2 = s2 + tau_a * down
            s3 = s3 + tau_a
            s4 = s4 + tau_b * x
            s5 = s5 + tau_b * down
            s6 = s6 + tau_b
            s7 = s7 + gamma_x * x
            s8 = s8 + gamma_x * down
            s9 = s9 + gamma_y * down
            s10 = s10 + gamma_x
            s11 = s11 + gamma_y
            s12 = s12 + gamma
    totals(floats, _TOTALS, (s0, s1, s2, s3, s4, s5, s6, s7, s8, s9, s10, s11, s12))


@njit(error_model="numpy", forceinline=True, _nrt=False)
def _add_flat(floats: Any, rows: Any, offsets: Any, begin: Any, first: Any, last: Any) -> None:
    """`_add_splat` after `_weigh_flat`; sums that are not needed are 0."""
    zero = spread(_NOTHING)
    s0, s1, s2, s3, s4, s5, s6, s12 = zero, zero, zero, zero, zero, zero, zero, zero
    p11 = floats[_P11 + np.uint64(rows[first])]
    for strip in range(first, last):
        row, offset = np.uint64(rows[strip]), offsets[strip]
        down, b = floats[_DOWN + row], floats[_B + row]
        for column in range(np.uint64(0), _STRIP, _REGISTER):
            to = (strip - begin) * _STRIP + column
            step = lane_numbers() + np.float32(column) + offset
            x = step + floats[_RIGHT + row]
            w = load(floats, _W + to)
            w_a, w_b = w * (step * p11 + floats[_A + row]), w * b
            s0 = s0 + w
            s1 = s1 + w_a * x
            s2 = s2 + w_a * down
            s3 = s3 + w_a
            s4 = s4 + w_b * x
            s5 = s5 + w_b * down
            s6 = s6 + w_b
            s12 = s12 + load(floats, _GAMMA + to)
    totals(floats, _TOTALS, (s0, s1, s2, s3, s4, s5, s6, zero, zero, zero, zero, zero, s12))
