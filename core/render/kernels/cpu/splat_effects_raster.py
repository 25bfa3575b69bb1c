"""`splat_raster` for splats that are masked or integrated over pixels.

A file of its own, so that the plain kernel has not one instruction for what is not asked of it. Tiles, strips and what
a tile's buffer holds are the plain kernel's.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ....compiled import njit, prange
from ....threads import loops_only
from ..reference.pixel_integral import CUBIC, LINEAR
from .splat_raster import (
    _A,
    _ALPHA,
    _B,
    _BEHIND,
    _BLOCK,
    _BLUE,
    _BUFFER,
    _DEPTH,
    _FIRST,
    _FLOATS,
    _G,
    _GREEN,
    _INTS,
    _L1,
    _LIGHT,
    _MEAN,
    _NOTHING,
    _P,
    _P0,
    _PIXEL,
    _Q,
    _Q0,
    _QQ,
    _R,
    _RED,
    _ROOT,
    _ROOTS,
    _ROW,
    _SPLAT,
    _STRIDE,
    _STRIPS,
    _VECTOR,
    _Z,
    ALPHA_MAX,
    ALPHA_MIN,
    BATCH,
    CENTER_X,
    CENTER_Y,
    STRIP_ROWS,
    STRIP_TOP,
    SUMS,
    TRANSMITTANCE_MIN,
    _any_light,
    _close_tile,
    _cut,
    _first_depth,
    _opacities,
    _open_tile,
    _take_gradients,
    fetch,
)
from .tiles import TILE
from .vectors import (
    aligned,
    exp2,
    lane_numbers,
    least,
    load,
    spread,
    store,
    store_run,
    totals,
    where,
)  # fmt: skip

# Columns of the table `shapes` of integrated splats: 1/σ of y, 1/σ of x given y, how far x's mean moves by a row, and
# opacity · 2π√|Σ'| / (2πσxσy).
INVERSE_Y, INVERSE_X, TILT, AMPLITUDE = range(4)
SHAPES = 4

# In floats, behind what the plain kernel keeps: the numbers of the batch's splats, then of each strip ∂(log of the
# row's factor) by y and by log σy.
_MASK, _INVERSE_Y, _INVERSE_X, _TILT, _AMPLITUDE = (np.uint64(_FLOATS + i * BATCH) for i in range(5))
_BY_Y, _BY_WIDTH = (np.uint64(_FLOATS + 5 * BATCH + i * _STRIPS) for i in range(2))
_ALL_FLOATS = _FLOATS + 5 * BATCH + 2 * _STRIPS

_ONE, _HALF, _TWO = np.float32(1.0), np.float32(0.5), np.float32(2.0)
_LINEAR, _CUBIC = np.float32(LINEAR), np.float32(CUBIC)
_ROOT_2PI = np.float32(np.sqrt(2 * np.pi))
_LOG2_E = np.float32(np.log2(np.e))
# Beyond it a normal distribution function's approximation is 0 or 1 to all digits, and 2ˣ has not yet overflowed.
_FAR = np.float32(60.0)
# Below it (1 − e⁻ᵗ)/t by its series.
_SMALL = np.float32(0.25)


@njit(parallel=loops_only(), cache=True, error_model="numpy")
def rasterize(
    starts: Any, splats: Any, attributes: Any, shapes: Any, masks: Any, background: Any, color: Any, alpha: Any
) -> Any:
    """Blends the pairs of every tile front to back; see `splat_raster.rasterize`.

    Args:
        shapes: (N, SHAPES) float32 of integrated splats; (0, SHAPES) where α is taken at pixel centres.
        masks: (N,) float32.
    """
    height, width = alpha.shape
    columns = (width + TILE - 1) // TILE
    depth = np.empty((height, width), np.float32)
    colors, centers = color.reshape(-1), attributes.view(np.float64)
    blended = np.empty(len(starts) - 1, np.int32)
    for square in prange(len(starts) - 1):
        tile = np.int64(square)
        x0, y0 = tile % columns * TILE, tile // columns * TILE
        buffer, floats, ints = aligned(_BUFFER), aligned(_ALL_FLOATS), np.empty(_INTS, np.int32)
        _open_tile(buffer, x0, y0, width, height)
        pair, stop = np.int64(starts[tile]), np.int64(starts[tile + 1])
        corner = x0, y0, _first_depth(starts, splats, attributes, tile)
        fetched = pair
        while pair < stop and _any_light(buffer):
            if pair == fetched:
                fetched = min(pair + BATCH, stop)
                _fetch(splats, pair, fetched, centers, attributes, shapes, masks, corner, floats, ints)
            first = np.uint64((pair - starts[tile]) % BATCH)
            count: Any = min(_BLOCK, stop - pair)
            strips = _find_opacities(floats, ints, first, np.uint64(count), len(shapes) > 0, False)
            _blend(buffer, floats, ints, strips)
            pair += count
        blended[tile] = pair - starts[tile]
        _close_tile(buffer, corner, background, colors, alpha, depth)
    return depth, blended


@njit(parallel=loops_only(), cache=True, error_model="numpy")
def rasterize_backward(
    starts: Any,
    splats: Any,
    blended: Any,
    attributes: Any,
    shapes: Any,
    masks: Any,
    color: Any,
    alpha: Any,
    depth: Any,
    grad_color: Any,
    grad_alpha: Any,
    grad_depth: Any,
    sums: Any,
    mask_sums: Any,
) -> None:
    """What the pixels of every pair say about its splat, to `sums` (P, SUMS) and, about its mask, `mask_sums` (P,).

    The first six sums of an integrated splat are, with h = ∂L/∂α · α and F the factors of α that a pixel's column and
    row make, those of h, h ∂log Fx/∂x, h ∂log Fy/∂y, h ∂log Fx/∂log σx, h ∂log Fy/∂log σy and h y ∂log Fx/∂x.
    """
    height, width = alpha.shape
    columns = (width + TILE - 1) // TILE
    centers = attributes.view(np.float64)
    colors, grad_colors = color.reshape(-1), grad_color.reshape(-1)
    for square in prange(len(starts) - 1):
        tile = np.int64(square)
        x0, y0 = tile % columns * TILE, tile // columns * TILE
        buffer, floats, ints = aligned(_BUFFER), aligned(_ALL_FLOATS), np.empty(_INTS, np.int32)
        _open_tile(buffer, x0, y0, width, height)
        corner = x0, y0, _first_depth(starts, splats, attributes, tile)
        _take_gradients(buffer, corner, colors, alpha, depth, grad_colors, grad_alpha, grad_depth)
        stop = np.int64(starts[tile] + blended[tile])
        for begin in range(np.int64(starts[tile]), stop, BATCH):
            end: Any = min(begin + BATCH, stop)
            _fetch(splats, begin, end, centers, attributes, shapes, masks, corner, floats, ints)
            for first in range(np.uint64(0), np.uint64(end - begin), np.uint64(_BLOCK)):
                count: Any = min(np.uint64(_BLOCK), np.uint64(end - begin) - first)
                _find_opacities(floats, ints, first, count, len(shapes) > 0, True)
                for j in range(count):
                    pair = np.uint64(begin) + first + j
                    if len(shapes) > 0:
                        _integral_backward(buffer, floats, ints, j, first + j, sums, mask_sums, pair)
                    else:
                        _point_backward(buffer, floats, ints, j, first + j, sums, mask_sums, pair)


@njit(error_model="numpy", _nrt=False)
def _fetch(
    splats: Any, begin: Any, end: Any, centers: Any, attributes: Any, shapes: Any, masks: Any, corner: Any,
    floats: Any, ints: Any,
) -> None:  # fmt: skip
    """`splat_raster.fetch`, then masks and, in the place of an ellipse's numbers, those of an integrated splat."""
    fetch(splats, begin, end, centers, attributes, corner, floats, ints)
    for n in range(np.uint64(end - begin)):
        i = np.uint64(splats[np.uint64(begin) + n])
        floats[_MASK + n] = masks[i]
        if len(shapes) > 0:
            x, y = corner[0] + 0.5 - centers[i, CENTER_X], corner[1] + 0.5 - centers[i, CENTER_Y]
            tilt = shapes[i, TILT]
            floats[_P0 + n], floats[_Q0 + n] = x - tilt * y, y
            floats[_INVERSE_Y + n], floats[_INVERSE_X + n] = shapes[i, INVERSE_Y], shapes[i, INVERSE_X]
            floats[_TILT + n], floats[_AMPLITUDE + n] = tilt, shapes[i, AMPLITUDE]


@njit(error_model="numpy", _nrt=False)
def _find_opacities(floats: Any, ints: Any, first: Any, count: Any, integrated: Any, backward: Any) -> Any:
    """Cuts a block into strips and finds α of their pixels before its cap; returns how many strips."""
    if integrated:
        strips = _cut_rows(floats, ints, first, count, backward)
        _integrals(floats, ints, strips)
    else:
        strips = _cut(floats, ints, first, count)
        _opacities(floats, ints, strips)
    return strips


@njit(error_model="numpy", forceinline=True, _nrt=False)
def _cut_rows(floats: Any, ints: Any, first: Any, count: Any, backward: Any) -> Any:
    """Makes strips of integrated splats: x of the first pixel from the row's mean, y, and the row's share of α."""
    strips = np.uint64(0)
    for n in range(count):
        splat = first + n
        ints[_FIRST + n] = strips
        top = floats[STRIP_TOP + splat]
        for part in range(np.uint64(0), _ROW, _VECTOR):
            strip, row = strips + part, lane_numbers() + (top + np.float32(part))
            y = row + floats[_Q0 + splat]
            store(floats, _P + strip, floats[_P0 + splat] - row * floats[_TILT + splat])
            store(floats, _Q + strip, y)
            store(floats, _QQ + strip, _window(y, floats[_INVERSE_Y + splat]) * floats[_AMPLITUDE + splat])
            if backward:
                by_y, by_width = _window_slopes(y, floats[_INVERSE_Y + splat])
                store(floats, _BY_Y + strip, by_y)
                store(floats, _BY_WIDTH + strip, by_width)
            store_run(ints, _PIXEL + strip, np.int32(top + np.float32(part)) * np.int32(_STRIDE), np.int32(_STRIDE))
            store_run(ints, _SPLAT + strip, np.int32(splat), np.int32(0))
        strips += np.uint64(ints[STRIP_ROWS + splat])
    ints[_SPLAT + strips] = -1
    return strips


@njit(error_model="numpy", forceinline=True, _nrt=False)
def _integrals(floats: Any, ints: Any, strips: Any) -> None:
    """`splat_raster._opacities` of integrated splats."""
    for strip in range(strips):
        splat = np.uint64(ints[_SPLAT + strip])
        for column in range(np.uint64(0), _ROW, _VECTOR):
            x = lane_numbers() + (np.float32(column) + floats[_P + strip])
            alpha = _window(x, floats[_INVERSE_X + splat]) * floats[_QQ + strip]
            store(floats, _ALPHA + strip * _ROW + column, where(alpha >= ALPHA_MIN, alpha))


@njit(error_model="numpy", forceinline=True, _nrt=False)
def _kept(x: Any) -> Any:
    """x within ±60."""
    return _NOTHING - least(_NOTHING - least(x, _FAR), _FAR)


@njit(error_model="numpy", forceinline=True, _nrt=False)
def _decay(t: Any, falling: Any) -> Any:
    """(1 − e⁻ᵗ)/t for t ≥ 0 and e⁻ᵗ."""
    series = t * np.float32(-1 / 720) + np.float32(1 / 120)
    series = series * t - np.float32(1 / 24)
    series = series * t + np.float32(1 / 6)
    series = (series * t - _HALF) * t + _ONE
    return where(t < _SMALL, series) + where(t >= _SMALL, (_ONE - falling) / t)


@njit(error_model="numpy", forceinline=True, _nrt=False)
def _window(x: Any, inverse: Any) -> Any:
    """`pixel_integral.window` of a vector and a number."""
    half = _HALF * inverse
    middle = x * inverse
    low, high = middle - half, middle + half
    low = _kept(low * (_LINEAR + _CUBIC * low * low))
    high = _kept(high * (_LINEAR + _CUBIC * high * high))
    slope = _CUBIC * (np.float32(3) * middle * middle + half * half) + _LINEAR
    apart = slope * inverse
    falling = exp2(least(apart, _FAR) * (_NOTHING - _LOG2_E))
    sides = (_ONE + exp2(high * (_NOTHING - _LOG2_E))) * (_ONE + exp2(low * _LOG2_E))
    return _ROOT_2PI * slope * _decay(apart, falling) / sides


@njit(error_model="numpy", forceinline=True, _nrt=False)
def _window_slopes(x: Any, inverse: Any) -> Any:
    """The logarithm's derivatives of `_window` by x, and by log σ."""
    half = _HALF * inverse
    middle = x * inverse
    low, high = middle - half, middle + half
    low_slope, high_slope = np.float32(3) * _CUBIC * low * low, np.float32(3) * _CUBIC * high * high
    below = exp2(_kept(low * (_LINEAR + _CUBIC * low * low)) * _LOG2_E)
    above = exp2(_kept(high * (_LINEAR + _CUBIC * high * high)) * (_NOTHING - _LOG2_E))
    left = (low_slope + _LINEAR) * below / (_ONE + below)
    right = (high_slope + _LINEAR) * above / (_ONE + above)
    slope = _CUBIC * (np.float32(3) * middle * middle + half * half) + _LINEAR
    apart = slope * inverse
    falling = exp2(least(apart, _FAR) * (_NOTHING - _LOG2_E))
    # Of the logarithm of (1 − e⁻ᵗ)/t.
    series = (apart * apart * np.float32(-1 / 720) + np.float32(1 / 12)) * apart - _HALF
    decay = where(apart < _SMALL, series) + where(apart >= _SMALL, falling / (_ONE - falling) - _ONE / apart)
    bend, spread_out = np.float32(6) * _CUBIC * middle, _TWO * _CUBIC * half
    by_middle = right - left + bend / slope + decay * bend * inverse
    by_half = right + left + spread_out / slope + decay * (_TWO * slope + spread_out * inverse)
    return by_middle * inverse, _NOTHING - middle * by_middle - by_half * half


@njit(error_model="numpy", forceinline=True, _nrt=False)
def _pass(buffer: Any, k: Any, raw: Any, mask: Any) -> Any:
    """`splat_raster._pass` of a splat whose α is multiplied by its mask."""
    alpha, light = least(raw, ALPHA_MAX), load(buffer, _LIGHT + k)
    weight = light * (alpha * mask)
    after = light - weight
    going = after >= TRANSMITTANCE_MIN
    store(buffer, _LIGHT + k, where(going, after))
    return alpha, light, going, where(going, weight)


@njit(error_model="numpy", forceinline=True, _nrt=False)
def _blend(buffer: Any, floats: Any, ints: Any, strips: Any) -> None:
    for strip in range(strips):
        splat, pixel = np.uint64(ints[_SPLAT + strip]), np.uint64(ints[_PIXEL + strip])
        for column in range(np.uint64(0), _ROW, _VECTOR):
            k = pixel + column
            raw = load(floats, _ALPHA + strip * _ROW + column)
            _, _, _, weight = _pass(buffer, k, raw, floats[_MASK + splat])
            store(buffer, _R + k, load(buffer, _R + k) + weight * floats[_RED + splat])
            store(buffer, _G + k, load(buffer, _G + k) + weight * floats[_GREEN + splat])
            store(buffer, _B + k, load(buffer, _B + k) + weight * floats[_BLUE + splat])
            store(buffer, _Z + k, load(buffer, _Z + k) + weight * floats[_DEPTH + splat])
            store(buffer, _A + k, load(buffer, _A + k) + weight)


@njit(error_model="numpy", forceinline=True, _nrt=False)
def _pixels_backward(buffer: Any, floats: Any, splat: Any, k: Any, raw: Any) -> Any:
    """Passes a splat in `LANES` pixels; h, ∂L/∂mask, and the gradients of red, green, blue and depth."""
    mask = floats[_MASK + splat]
    alpha, light, going, weight = _pass(buffer, k, raw, mask)
    r, g, b, share = load(buffer, _R + k), load(buffer, _G + k), load(buffer, _B + k), load(buffer, _Z + k)
    value = r * floats[_RED + splat] + g * floats[_GREEN + splat] + b * floats[_BLUE + splat]
    value = value + share * (floats[_DEPTH + splat] - load(buffer, _MEAN + k)) + load(buffer, _A + k)
    behind = load(buffer, _BEHIND + k) - weight * value
    store(buffer, _BEHIND + k, behind)
    # By the product of α and mask. The light may be another's already where a pixel is finished.
    slope = where(going, light * value - behind / (_ONE - alpha * mask))
    free = where(raw < ALPHA_MAX, raw)
    return slope * free * mask, slope * alpha, weight * r, weight * g, weight * b, weight * share


@njit(error_model="numpy", forceinline=True, _nrt=False)
def _point_backward(
    buffer: Any, floats: Any, ints: Any, j: Any, splat: Any, sums: Any, mask_sums: Any, pair: Any
) -> None:
    """Adds up what the pixels of the tile say about a splat whose α is taken at their centres."""
    zero = spread(_NOTHING)
    h, hp, hq, hpp, hpq, hqq = zero, zero, zero, zero, zero, zero
    to_red, to_green, to_blue, to_z, to_mask = zero, zero, zero, zero, zero
    strip = np.uint64(ints[_FIRST + j])
    while np.uint64(ints[_SPLAT + strip]) == splat:
        q, qq = floats[_Q + strip], floats[_QQ + strip]
        for column in range(np.uint64(0), _ROW, _VECTOR):
            raw = load(floats, _ALPHA + strip * _ROW + column)
            k = np.uint64(ints[_PIXEL + strip]) + column
            power, mask, red, green, blue, z = _pixels_backward(buffer, floats, splat, k, raw)
            p = (lane_numbers() + np.float32(column)) * floats[_L1 + splat] + floats[_P + strip]
            pushed = power * p
            h, hp, hq = h + power, hp + pushed, hq + power * q
            hpp, hpq, hqq = hpp + pushed * p, hpq + pushed * q, hqq + power * qq
            to_red, to_green, to_blue, to_z = to_red + red, to_green + green, to_blue + blue, to_z + z
            to_mask = to_mask + mask
        strip += np.uint64(1)
    once, twice = np.float32(_ROOT), _ROOTS
    of_power = h, hp * once, hq * once, hpp * twice, hpq * twice, hqq * twice
    totals(sums, pair * np.uint64(SUMS), (*of_power, to_red, to_green, to_blue, to_z))
    totals(mask_sums, pair, (to_mask,))


@njit(error_model="numpy", forceinline=True, _nrt=False)
def _integral_backward(
    buffer: Any, floats: Any, ints: Any, j: Any, splat: Any, sums: Any, mask_sums: Any, pair: Any
) -> None:
    """Adds up what the pixels of the tile say about an integrated splat."""
    zero = spread(_NOTHING)
    h, h_x, h_y, h_width_x, h_width_y, h_tilt = zero, zero, zero, zero, zero, zero
    to_red, to_green, to_blue, to_z, to_mask = zero, zero, zero, zero, zero
    strip = np.uint64(ints[_FIRST + j])
    while np.uint64(ints[_SPLAT + strip]) == splat:
        for column in range(np.uint64(0), _ROW, _VECTOR):
            raw = load(floats, _ALPHA + strip * _ROW + column)
            k = np.uint64(ints[_PIXEL + strip]) + column
            power, mask, red, green, blue, z = _pixels_backward(buffer, floats, splat, k, raw)
            x = lane_numbers() + (np.float32(column) + floats[_P + strip])
            by_x, by_width = _window_slopes(x, floats[_INVERSE_X + splat])
            pushed = power * by_x
            h, h_x, h_tilt = h + power, h_x + pushed, h_tilt + pushed * floats[_Q + strip]
            h_y, h_width_y = h_y + power * floats[_BY_Y + strip], h_width_y + power * floats[_BY_WIDTH + strip]
            h_width_x = h_width_x + power * by_width
            to_red, to_green, to_blue, to_z = to_red + red, to_green + green, to_blue + blue, to_z + z
            to_mask = to_mask + mask
        strip += np.uint64(1)
    of_power = h, h_x, h_y, h_width_x, h_width_y, h_tilt
    totals(sums, pair * np.uint64(SUMS), (*of_power, to_red, to_green, to_blue, to_z))
    totals(mask_sums, pair, (to_mask,))
