"""Blending splats into pixels and back: one tile a thread, sixteen splats at a time.

The splats of a tile are fetched a batch at a time, so that the waits for memory overlap. A block of them becomes as
many *strips* as its splats have rows in the tile: runs of 16 pixels. Opacities are found in a loop before the one that
blends: a strip waits some hundred cycles for one result after another, and only while a loop is short can a processor
work on enough strips at once to make use of that time.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ....compiled import njit, prange
from ....threads import loops_only
from .tiles import TILE
from .vectors import (
    LANES,
    aligned,
    any_lane,
    exp2_negative,
    lane_numbers,
    least,
    load,
    prefetch,
    spread,
    store,
    store_run,
    totals,
    where,
)  # fmt: skip

# Columns of the per-splat table `attributes`, a line of the cache for each splat. The projected centre takes the first
# four: two float64. The last three say where the ellipse lies: an ellipse's points at x pixels to the right of its
# centre are y = SLOPE · x ± DEEP · √(reach² − (L1 · L2 · DEEP · x)²) pixels below, and x = LEAN at its lowest point.
CENTER_X, CENTER_Y = range(2)
L1, K, L2, REACH, OPACITY, RED, GREEN, BLUE, DEPTH, SLOPE, DEEP, LEAN = range(4, 16)
ATTRIBUTES = 16
# Columns of a pair's gradient: with h = ∂L/∂α · α and (p, q) the offset in standard deviations, the sums over
# pixels of h, hp, hq, hp², hpq, hq²; then the gradients of red, green, blue and depth.
SUMS = 10

ALPHA_MAX = np.float32(0.99)
ALPHA_MIN = np.float32(1.0 / 255.0)
TRANSMITTANCE_MIN = np.float32(1e-4)

# Indices are unsigned because Numba guards signed ones against negative values.
_ROW, _VECTOR = np.uint64(TILE), np.uint64(LANES)
# What a tile knows of its pixels lies in one buffer: for each row 16 floats of every quantity. Planes of 256 floats
# would put some of a strip's numbers 4096 bytes apart, and a processor takes a store and a load at such a distance for
# the same place at first.
_LIGHT, _R, _G, _B, _Z, _A, _MEAN, _BEHIND = (np.uint64(i * TILE) for i in range(8))
_STRIDE = 8 * TILE
_BUFFER = TILE * _STRIDE
# How many splats are fetched at once, and how many are blended between two looks at whether every pixel is finished.
BATCH, _BLOCK = 64, 16
# One splat's more than a block can have: each is written as if it had 16.
_STRIPS = (_BLOCK + 1) * TILE
# In floats: (p, q, q²) at each strip's first pixel; α of each of its pixels; then the numbers of the batch's splats,
# those of lengths divided by `_ROOT`.
_P, _Q, _QQ, _ALPHA = (np.uint64(i * _STRIPS) for i in range(4))
_SPLATS = (3 + TILE) * _STRIPS
_L1, _K, _L2, _REACH, _OPACITY, _RED, _GREEN, _BLUE, _DEPTH, _SLOPE, _DEEP, _LEAN, _X0, _Y0, _P0, _Q0, STRIP_TOP = (
    np.uint64(_SPLATS + i * BATCH) for i in range(17)
)
_FLOATS = _SPLATS + 17 * BATCH
# In whole numbers: each strip's first pixel and splat; each splat's first strip and number of strips.
_PIXEL, _SPLAT, _FIRST, STRIP_ROWS = (np.uint64(i * _STRIPS) for i in range(4))
_INTS = 4 * _STRIPS
# exp(−½r²) = 2^−(r/ROOT)²: distances are divided by this beforehand.
_ROOT = np.sqrt(2 * np.log(2))
_PER_ROOT, _ROOTS = np.float32(1 / _ROOT), np.float32(_ROOT * _ROOT)
_NOTHING = np.float32(0.0)
_RGB, _ONE, _TWO = np.uint64(3), np.uint64(1), np.uint64(2)


@njit(parallel=loops_only(), cache=True, error_model="numpy")
def rasterize(starts: Any, splats: Any, attributes: Any, background: Any, color: Any, alpha: Any) -> Any:
    """Blends the pairs of every tile front to back.

    Args:
        starts, splats: of `tiles.Tiles`.
        attributes: (N, ATTRIBUTES) float32, contiguous.
        background: (3,) float32.
        color: (H, W, 3) float32, written.
        alpha: (H, W) float32, written.

    Returns:
        depth (H, W) float32 and blended (tiles,) int32, how many pairs of each tile were needed.
    """
    height, width = alpha.shape
    columns = (width + TILE - 1) // TILE
    depth = np.empty((height, width), np.float32)
    colors, centers = color.reshape(-1), attributes.view(np.float64)
    blended = np.empty(len(starts) - 1, np.int32)
    for square in prange(len(starts) - 1):
        tile = np.int64(square)
        x0, y0 = tile % columns * TILE, tile // columns * TILE
        buffer, (floats, ints) = aligned(_BUFFER), empty_block()
        _open_tile(buffer, x0, y0, width, height)
        pair, stop = np.int64(starts[tile]), np.int64(starts[tile + 1])
        corner = x0, y0, _first_depth(starts, splats, attributes, tile)
        fetched = pair
        while pair < stop and _any_light(buffer):
            if pair == fetched:
                fetched = min(pair + BATCH, stop)
                fetch(splats, pair, fetched, centers, attributes, corner, floats, ints)
            first = np.uint64((pair - starts[tile]) % BATCH)
            count: Any = min(_BLOCK, stop - pair)
            strips = _cut(floats, ints, first, np.uint64(count))
            _opacities(floats, ints, strips)
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
    color: Any,
    alpha: Any,
    depth: Any,
    grad_color: Any,
    grad_alpha: Any,
    grad_depth: Any,
    sums: Any,
) -> None:
    """Adds up, for every pair, what its pixels say about its splat; written to `sums` (P, SUMS), zeros before.

    Walks front to back as `rasterize` does, with the very same arithmetic, so that both agree about which pixel a
    splat is skipped in. What lies behind a splat is the pixel's total less what was passed.
    """
    height, width = alpha.shape
    columns = (width + TILE - 1) // TILE
    centers = attributes.view(np.float64)
    # Flat, because LLVM cannot know of an array that three colours lie side by side in it.
    colors, grad_colors = color.reshape(-1), grad_color.reshape(-1)
    for square in prange(len(starts) - 1):
        tile = np.int64(square)
        x0, y0 = tile % columns * TILE, tile // columns * TILE
        buffer, (floats, ints) = aligned(_BUFFER), empty_block()
        _open_tile(buffer, x0, y0, width, height)
        corner = x0, y0, _first_depth(starts, splats, attributes, tile)
        _take_gradients(buffer, corner, colors, alpha, depth, grad_colors, grad_alpha, grad_depth)
        stop = np.int64(starts[tile] + blended[tile])
        for begin in range(np.int64(starts[tile]), stop, BATCH):
            end: Any = min(begin + BATCH, stop)
            fetch(splats, begin, end, centers, attributes, corner, floats, ints)
            for first in range(np.uint64(0), np.uint64(end - begin), np.uint64(_BLOCK)):
                count: Any = min(np.uint64(_BLOCK), np.uint64(end - begin) - first)
                strips = _cut(floats, ints, first, count)
                _opacities(floats, ints, strips)
                for j in range(count):
                    _blend_backward(buffer, floats, ints, j, first + j, sums, np.uint64(begin) + first + j)


@njit(_nrt=False)
def _open_tile(buffer: Any, x0: Any, y0: Any, width: Any, height: Any) -> None:
    """Nothing anywhere but full light where the tile lies inside the image; pixels outside are finished."""
    for k in range(np.uint64(_BUFFER)):
        buffer[k] = 0.0
    for row in range(np.uint64(min(TILE, height - y0))):
        for column in range(np.uint64(min(TILE, width - x0))):
            buffer[row * np.uint64(_STRIDE) + _LIGHT + column] = 1.0


@njit(error_model="numpy", fastmath={"contract"}, _nrt=False)
def _close_tile(buffer: Any, corner: Any, background: Any, colors: Any, alpha: Any, depth: Any) -> None:
    """Puts what a tile found into the images."""
    height, width = alpha.shape
    x0, y0, z0 = np.uint64(corner[0]), np.uint64(corner[1]), corner[2]
    red, green, blue = background[0], background[1], background[2]
    for y in range(y0, min(y0 + _ROW, np.uint64(height))):
        row = (y - y0) * np.uint64(_STRIDE)
        for x in range(x0, min(x0 + _ROW, np.uint64(width))):
            k = row + x - x0
            # Summed up, not one less what is left: a faint pixel's depth is a quotient by it.
            covered = buffer[_A + k]
            through = np.float32(1.0) - covered
            n = y * np.uint64(width) + x
            colors[_RGB * n] = buffer[_R + k] + through * red
            colors[_RGB * n + _ONE] = buffer[_G + k] + through * green
            colors[_RGB * n + _TWO] = buffer[_B + k] + through * blue
            alpha[y, x] = covered
            depth[y, x] = z0 + buffer[_Z + k] / covered if covered > 0.0 else _NOTHING


@njit(error_model="numpy", fastmath={"contract"}, _nrt=False)
def _take_gradients(
    buffer: Any,
    corner: Any,
    colors: Any,
    alpha: Any,
    depth: Any,
    grad_colors: Any,
    grad_alpha: Any,
    grad_depth: Any,
) -> None:
    """Puts into a tile's buffer what the loss says about its pixels."""
    height, width = alpha.shape
    x0, y0, z0 = np.uint64(corner[0]), np.uint64(corner[1]), corner[2]
    for y in range(y0, min(y0 + _ROW, np.uint64(height))):
        row = (y - y0) * np.uint64(_STRIDE)
        for x in range(x0, min(x0 + _ROW, np.uint64(width))):
            k, n, covered = row + x - x0, y * np.uint64(width) + x, alpha[y, x]
            red, green, blue = grad_colors[_RGB * n], grad_colors[_RGB * n + _ONE], grad_colors[_RGB * n + _TWO]
            buffer[_R + k], buffer[_G + k], buffer[_B + k] = red, green, blue
            buffer[_Z + k] = grad_depth[y, x] / covered if covered > 0.0 else _NOTHING
            buffer[_A + k] = grad_alpha[y, x]
            buffer[_MEAN + k] = depth[y, x] - z0
            behind = red * colors[_RGB * n] + green * colors[_RGB * n + _ONE] + blue * colors[_RGB * n + _TWO]
            buffer[_BEHIND + k] = behind + grad_alpha[y, x] * covered


@njit(error_model="numpy", _nrt=False)
def _first_depth(starts: Any, splats: Any, attributes: Any, tile: Any) -> Any:
    """Of the tile's nearest splat. Depths are counted from it, so that where only one is seen its depth is exact."""
    if starts[tile] == starts[tile + 1]:
        return _NOTHING
    return attributes[splats[starts[tile]], DEPTH]


@njit(error_model="numpy", _nrt=False)
def _any_light(buffer: Any) -> bool:
    for row in range(_LIGHT, _LIGHT + np.uint64(_BUFFER), np.uint64(_STRIDE)):
        for column in range(np.uint64(0), _ROW, _VECTOR):
            if any_lane(load(buffer, row + column) >= TRANSMITTANCE_MIN):
                return True
    return False


@njit
def empty_block() -> Any:
    """Room for what `fetch` finds, floats and whole numbers."""
    return aligned(_FLOATS), np.empty(_INTS, np.int32)


@njit(error_model="numpy", _nrt=False)
def fetch(
    splats: Any, begin: Any, end: Any, centers: Any, attributes: Any, corner: Any, floats: Any, ints: Any
) -> None:
    """What a tile has to know of the splats of its pairs begin..end, up to a batch.

    Args:
        corner: of the tile: its first column and row, and a depth that those of splats are counted from.
    """
    x0, y0, z0 = corner
    for pair in range(np.uint64(end), np.uint64(min(end + BATCH, len(splats)))):
        prefetch(attributes, np.uint64(splats[pair]) * np.uint64(ATTRIBUTES))
    for n in range(np.uint64(end - begin)):
        i = np.uint64(splats[np.uint64(begin) + n])
        # In float64 because the differences, and far from a needle's centre the sum, may be small beside their parts.
        x, y = x0 + 0.5 - centers[i, CENTER_X], y0 + 0.5 - centers[i, CENTER_Y]
        l1, k, l2 = attributes[i, L1] * _PER_ROOT, attributes[i, K] * _PER_ROOT, attributes[i, L2] * _PER_ROOT
        floats[_X0 + n], floats[_Y0 + n] = x, y
        floats[_P0 + n], floats[_Q0 + n] = l1 * x + k * y, l2 * y
        floats[_L1 + n], floats[_K + n], floats[_L2 + n] = l1, k, l2
        floats[_REACH + n], floats[_OPACITY + n] = attributes[i, REACH], attributes[i, OPACITY]
        floats[_RED + n], floats[_GREEN + n] = attributes[i, RED], attributes[i, GREEN]
        floats[_BLUE + n], floats[_DEPTH + n] = attributes[i, BLUE], attributes[i, DEPTH] - z0
        floats[_SLOPE + n], floats[_DEEP + n] = attributes[i, SLOPE], attributes[i, DEEP]
        floats[_LEAN + n] = attributes[i, LEAN]
    for first in range(np.uint64(0), np.uint64(end - begin), np.uint64(_BLOCK)):
        _find_rows(floats, ints, first)


@njit(error_model="numpy", forceinline=True, _nrt=False)
def _cut(floats: Any, ints: Any, first: Any, count: Any) -> Any:
    """Makes strips of some splats of the batch; returns how many."""
    strips = np.uint64(0)
    for n in range(count):
        splat = first + n
        ints[_FIRST + n] = strips
        top = floats[STRIP_TOP + splat]
        # Always 16, so that no branch depends on how many there are; the next splat overwrites what is too many.
        for part in range(np.uint64(0), _ROW, _VECTOR):
            strip, row = strips + part, lane_numbers() + (top + np.float32(part))
            q = row * floats[_L2 + splat] + floats[_Q0 + splat]
            store(floats, _P + strip, row * floats[_K + splat] + floats[_P0 + splat])
            store(floats, _Q + strip, q)
            store(floats, _QQ + strip, q * q)
            store_run(ints, _PIXEL + strip, np.int32(top + np.float32(part)) * np.int32(_STRIDE), np.int32(_STRIDE))
            store_run(ints, _SPLAT + strip, np.int32(splat), np.int32(0))
        strips += np.uint64(ints[STRIP_ROWS + splat])
    ints[_SPLAT + strips] = -1
    return strips


@njit(error_model="numpy", fastmath={"contract"}, _nrt=False)
def _find_rows(floats: Any, ints: Any, first: Any) -> None:
    """The rows of the tile that each splat of the block touches: the first, and how many."""
    size, last_column = np.float32(TILE), np.float32(TILE - 1)
    for n in range(first, first + np.uint64(_BLOCK)):
        x, y, reach = floats[_X0 + n], floats[_Y0 + n], floats[_REACH + n]
        slope, deep, lean = floats[_SLOPE + n], floats[_DEEP + n], floats[_LEAN + n]
        # The lowest point of the ellipse, or of its part in the tile's columns; and the highest.
        under, over = min(max(lean, x), x + last_column), min(max(-lean, x), x + last_column)
        narrow, far = floats[_L1 + n] * floats[_L2 + n] * deep * _ROOTS, reach * reach
        low = slope * under + deep * np.sqrt(max(far - (narrow * under) * (narrow * under), _NOTHING))
        high = slope * over - deep * np.sqrt(max(far - (narrow * over) * (narrow * over), _NOTHING))
        top = min(max(np.ceil(high - y), _NOTHING), size)
        bottom = min(np.floor(low - y) + np.float32(1.0), size)
        floats[STRIP_TOP + n] = top
        ints[STRIP_ROWS + n] = np.int32(bottom - top if bottom > top else _NOTHING)


@njit(error_model="numpy", forceinline=True, _nrt=False)
def _opacities(floats: Any, ints: Any, strips: Any) -> None:
    """α of the block's pixels before its cap, 0 where it is skipped."""
    for strip in range(strips):
        splat = np.uint64(ints[_SPLAT + strip])
        for column in range(np.uint64(0), _ROW, _VECTOR):
            p = (lane_numbers() + np.float32(column)) * floats[_L1 + splat] + floats[_P + strip]
            alpha = exp2_negative(_NOTHING - p * p - floats[_QQ + strip]) * floats[_OPACITY + splat]
            store(floats, _ALPHA + strip * _ROW + column, where(alpha >= ALPHA_MIN, alpha))


@njit(error_model="numpy", forceinline=True, _nrt=False)
def _pass(buffer: Any, k: Any, raw: Any) -> Any:
    """Takes a splat's share of the light; α, the light before, which pixels go on, and the share.

    One function for both directions, which must agree about which pixel a splat is skipped in.
    """
    alpha, light = least(raw, ALPHA_MAX), load(buffer, _LIGHT + k)
    weight = light * alpha
    after = light - weight
    going = after >= TRANSMITTANCE_MIN
    # A finished pixel has no light: nothing is added to it and it stays finished.
    store(buffer, _LIGHT + k, where(going, after))
    return alpha, light, going, where(going, weight)


@njit(error_model="numpy", forceinline=True, _nrt=False)
def _blend(buffer: Any, floats: Any, ints: Any, strips: Any) -> None:
    for strip in range(strips):
        splat, pixel = np.uint64(ints[_SPLAT + strip]), np.uint64(ints[_PIXEL + strip])
        for column in range(np.uint64(0), _ROW, _VECTOR):
            k = pixel + column
            _, _, _, weight = _pass(buffer, k, load(floats, _ALPHA + strip * _ROW + column))
            store(buffer, _R + k, load(buffer, _R + k) + weight * floats[_RED + splat])
            store(buffer, _G + k, load(buffer, _G + k) + weight * floats[_GREEN + splat])
            store(buffer, _B + k, load(buffer, _B + k) + weight * floats[_BLUE + splat])
            store(buffer, _Z + k, load(buffer, _Z + k) + weight * floats[_DEPTH + splat])
            store(buffer, _A + k, load(buffer, _A + k) + weight)


@njit(error_model="numpy", forceinline=True, _nrt=False)
def _blend_backward(buffer: Any, floats: Any, ints: Any, j: Any, splat: Any, sums: Any, pair: Any) -> None:
    """Adds up what the pixels of the tile say about a splat, and passes it."""
    zero = spread(_NOTHING)
    h, hp, hq, hpp, hpq, hqq = zero, zero, zero, zero, zero, zero
    to_red, to_green, to_blue, to_z = zero, zero, zero, zero
    l1, red, green, blue = floats[_L1 + splat], floats[_RED + splat], floats[_GREEN + splat], floats[_BLUE + splat]
    z = floats[_DEPTH + splat]
    strip = np.uint64(ints[_FIRST + j])
    # Not a range, or LLVM would take two strips at a time, and whether one is left over would be a coin toss.
    while np.uint64(ints[_SPLAT + strip]) == splat:
        pixel = np.uint64(ints[_PIXEL + strip])
        q, qq = floats[_Q + strip], floats[_QQ + strip]
        for column in range(np.uint64(0), _ROW, _VECTOR):
            k, place = pixel + column, strip * _ROW + column
            raw = load(floats, _ALPHA + place)
            alpha, light, going, weight = _pass(buffer, k, raw)
            r, g, b, share = load(buffer, _R + k), load(buffer, _G + k), load(buffer, _B + k), load(buffer, _Z + k)
            value = r * red + g * green + b * blue + share * (z - load(buffer, _MEAN + k)) + load(buffer, _A + k)
            behind = load(buffer, _BEHIND + k) - weight * value
            store(buffer, _BEHIND + k, behind)
            # The saturated cap passes no gradient on; neither does a splat that was skipped here.
            free = where(going & (raw < ALPHA_MAX), raw)
            power = (light * value - behind / (np.float32(1.0) - alpha)) * free
            p = (lane_numbers() + np.float32(column)) * l1 + floats[_P + strip]
            pushed = power * p
            h = h + power
            hp = hp + pushed
            hq = hq + power * q
            hpp = hpp + pushed * p
            hpq = hpq + pushed * q
            hqq = hqq + power * qq
            to_red = to_red + weight * r
            to_green = to_green + weight * g
            to_blue = to_blue + weight * b
            to_z = to_z + weight * share
        strip += np.uint64(1)
    once, twice = np.float32(_ROOT), _ROOTS
    of_power = h, hp * once, hq * once, hpp * twice, hpq * twice, hqq * twice
    totals(sums, pair * np.uint64(SUMS), (*of_power, to_red, to_green, to_blue, to_z))
