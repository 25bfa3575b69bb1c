"""Blending splats into pixels and back: one tile a thread, one splat at a time over a run of the tile's pixels.

All that a tile knows of its 256 pixels lies in one buffer, a plane of 256 floats for each quantity, so that LLVM
sees one pointer with fixed distances and vectorises the loops over pixels without checks for overlap. The rows of
a tile that a splat does not reach are skipped; those it does are one contiguous run.

The splats of a tile are fetched a block at a time, so that the waits for memory overlap. The work on a pixel is cut
into short loops (opacity, blending, sums) that pass planes on: one long loop runs out of registers, and out of room
to start the next pixels while the first wait for their exponential.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange

from ....threads import loops_only
from .math import FAST, at_least, exp2_negative, kept
from .tiles import TILE

# Columns of the per-splat table `attributes`.
L1, K, L2, OPACITY, RED, GREEN, BLUE, DEPTH, HALF = range(9)
ATTRIBUTES = 9
# Columns of a pair's gradient: with h = ∂L/∂α · α and (p, q) the offset in standard deviations, the sums over
# pixels of h, hp, hq, hp², hpq, hq²; then the gradients of red, green, blue and depth.
SUMS = 10

ALPHA_MAX = np.float32(0.99)
ALPHA_MIN = np.float32(1.0 / 255.0)
TRANSMITTANCE_MIN = np.float32(1e-4)

_PIXELS = TILE * TILE
# Planes of the tile's buffer, as offsets. Indices are unsigned because Numba guards signed ones against negative
# values, which stops vectorising.
_COLUMN, _ROW, _LIGHT, _R, _G, _B, _Z, _A, _MEAN, _BEHIND = (np.uint64(i * _PIXELS) for i in range(10))
_ALPHA, _POWER, _WEIGHT = (np.uint64(i * _PIXELS) for i in range(10, 13))
_PLANES = 13
# How many splats are fetched at once, and blended between two looks at whether every pixel is finished.
_BLOCK = 32
# Columns of a block: (p, q) of the tile's first pixel, then a splat's own numbers, L1, K and L2 divided by `_ROOT`.
_P0, _Q0, _L1, _K, _L2, _OPACITY, _RED, _GREEN, _BLUE, _DEPTH = (np.uint64(i) for i in range(10))
_COLUMNS = 10
# exp(−½r²) = 2^−(r/ROOT)²: distances are divided by this beforehand.
_ROOT = np.sqrt(2 * np.log(2))
_FIRST, _LAST = np.uint64(0), np.uint64(1)


@njit(parallel=loops_only(), cache=True, error_model="numpy")
def rasterize(starts: Any, splats: Any, centers: Any, attributes: Any, background: Any, color: Any, alpha: Any) -> Any:
    """Blends the pairs of every tile front to back.

    Args:
        starts, splats: of `tiles.Tiles`.
        centers: (N, 2) float64 pixels.
        attributes: (N, ATTRIBUTES) float32.
        background: (3,) float32.
        color: (H, W, 3) float32, written.
        alpha: (H, W) float32, written.

    Returns:
        depth (H, W) float32 and blended (tiles,) int32, how many pairs of each tile were needed.
    """
    height, width = alpha.shape
    columns = (width + TILE - 1) // TILE
    depth = np.empty((height, width), np.float32)
    blended = np.empty(len(starts) - 1, np.int32)
    for square in prange(len(starts) - 1):
        tile = np.int64(square)
        x0, y0 = tile % columns * TILE, tile // columns * TILE
        buffer = np.zeros(_PLANES * _PIXELS, np.float32)
        block, rows = np.empty((_BLOCK, _COLUMNS), np.float32), np.empty((_BLOCK, 2), np.uint64)
        _open_tile(buffer, x0, y0, width, height)
        pair = np.int64(starts[tile])
        while pair < starts[tile + 1] and _any_light(buffer):
            count = min(_BLOCK, starts[tile + 1] - pair)
            _fetch(splats[pair : pair + count], centers, attributes, x0, y0, block, rows)
            for j in range(np.uint64(count)):
                _opacities(buffer, block, rows, j)
                _blend(buffer, block, rows, j)
            pair += count
        blended[tile] = pair - starts[tile]
        for y in range(y0, min(y0 + TILE, height)):
            for x in range(x0, min(x0 + TILE, width)):
                k = np.uint64((y - y0) * TILE + x - x0)
                # Summed up, not one less what is left: a faint pixel's depth is a quotient by it.
                covered = buffer[_A + k]
                through = np.float32(1.0) - covered
                color[y, x, 0] = buffer[_R + k] + through * background[0]
                color[y, x, 1] = buffer[_G + k] + through * background[1]
                color[y, x, 2] = buffer[_B + k] + through * background[2]
                alpha[y, x] = covered
                depth[y, x] = buffer[_Z + k] / covered if covered > 0.0 else np.float32(0.0)
    return depth, blended


@njit(parallel=loops_only(), cache=True, error_model="numpy")
def rasterize_backward(
    starts: Any,
    splats: Any,
    blended: Any,
    centers: Any,
    attributes: Any,
    color: Any,
    alpha: Any,
    depth: Any,
    grad_color: Any,
    grad_alpha: Any,
    grad_depth: Any,
    sums: Any,
) -> None:
    """Adds up, for every pair, what its pixels say about its splat, into `sums` (P, SUMS).

    Walks front to back as `rasterize` does, with the very same arithmetic, so that both agree about which pixel a
    splat is skipped in. What lies behind a splat is the pixel's total less what was passed.
    """
    height, width = alpha.shape
    columns = (width + TILE - 1) // TILE
    for square in prange(len(starts) - 1):
        tile = np.int64(square)
        x0, y0 = tile % columns * TILE, tile // columns * TILE
        buffer = np.zeros(_PLANES * _PIXELS, np.float32)
        block, rows = np.empty((_BLOCK, _COLUMNS), np.float32), np.empty((_BLOCK, 2), np.uint64)
        _open_tile(buffer, x0, y0, width, height)
        for y in range(y0, min(y0 + TILE, height)):
            for x in range(x0, min(x0 + TILE, width)):
                k = np.uint64((y - y0) * TILE + x - x0)
                covered = alpha[y, x]
                share = grad_depth[y, x] / covered if covered > 0.0 else np.float32(0.0)
                behind = grad_alpha[y, x] * covered
                for c in range(3):
                    buffer[_R + np.uint64(c * _PIXELS) + k] = grad_color[y, x, c]
                    behind += grad_color[y, x, c] * color[y, x, c]
                buffer[_Z + k] = share
                buffer[_A + k] = grad_alpha[y, x]
                buffer[_MEAN + k] = depth[y, x]
                buffer[_BEHIND + k] = behind
        stop = np.int64(starts[tile] + blended[tile])
        for pair in range(np.int64(starts[tile]), stop, _BLOCK):
            count: Any = min(_BLOCK, stop - pair)
            _fetch(splats[pair : pair + count], centers, attributes, x0, y0, block, rows)
            for j in range(np.uint64(count)):
                _opacities(buffer, block, rows, j)
                _blend_backward(buffer, block, rows, j)
                _add_up(buffer, block, rows, j, sums, np.uint64(pair) + j)


@njit(_nrt=False)
def _open_tile(buffer: Any, x0: Any, y0: Any, width: Any, height: Any) -> None:
    """Pixel offsets, and full light where the tile lies inside the image; pixels outside are finished."""
    for k in range(np.uint64(_PIXELS)):
        column, row = np.int64(k) % TILE, np.int64(k) // TILE
        buffer[_COLUMN + k] = column
        buffer[_ROW + k] = row
        buffer[_LIGHT + k] = 1.0 if x0 + column < width and y0 + row < height else 0.0


@njit(fastmath=FAST, error_model="numpy", _nrt=False)
def _any_light(buffer: Any) -> bool:
    light = np.float32(0.0)
    for k in range(np.uint64(_PIXELS)):
        light += buffer[_LIGHT + k]
    return light > 0.0


@njit(error_model="numpy", _nrt=False)
def _fetch(splats: Any, centers: Any, attributes: Any, x0: Any, y0: Any, block: Any, rows: Any) -> None:
    """Puts splats into the rows of `block`, and into `rows` the run of the tile's pixels that each touches."""
    for n in range(len(splats)):
        j, i = np.uint64(n), np.uint64(splats[n])
        center_y, half = centers[i, 1], attributes[i, HALF]
        first = max(np.ceil(center_y - half - 0.5 - y0), 0.0)
        last = min(np.floor(center_y + half + 0.5 - y0), np.float64(TILE))
        rows[j, _FIRST] = np.int64(first) * TILE
        rows[j, _LAST] = np.int64(max(last, first)) * TILE
        # In float64 because the difference may be small beside both.
        dx, dy = x0 + 0.5 - centers[i, 0], y0 + 0.5 - center_y
        l1, slant, l2 = attributes[i, L1] / _ROOT, attributes[i, K] / _ROOT, attributes[i, L2] / _ROOT
        block[j, _P0] = l1 * dx + slant * dy
        block[j, _Q0] = l2 * dy
        block[j, _L1], block[j, _K], block[j, _L2] = l1, slant, l2
        block[j, _OPACITY], block[j, _DEPTH] = attributes[i, OPACITY], attributes[i, DEPTH]
        block[j, _RED], block[j, _GREEN] = attributes[i, RED], attributes[i, GREEN]
        block[j, _BLUE] = attributes[i, BLUE]


@njit(fastmath=FAST, error_model="numpy", forceinline=True, _nrt=False)
def _opacities(buffer: Any, block: Any, rows: Any, j: Any) -> None:
    """α of splat j of the block before its cap, 0 where it is skipped, into the plane _ALPHA."""
    p0, q0, l1, slant, l2 = block[j, _P0], block[j, _Q0], block[j, _L1], block[j, _K], block[j, _L2]
    opacity = block[j, _OPACITY]
    for k in range(rows[j, _FIRST], rows[j, _LAST]):
        p = p0 + l1 * buffer[_COLUMN + k] + slant * buffer[_ROW + k]
        q = q0 + l2 * buffer[_ROW + k]
        alpha = opacity * exp2_negative(-(p * p + q * q))
        buffer[_ALPHA + k] = kept(at_least(alpha, ALPHA_MIN), alpha)


@njit(fastmath=FAST, error_model="numpy", forceinline=True, _nrt=False)
def _blend(buffer: Any, block: Any, rows: Any, j: Any) -> None:
    red, green, blue, z = block[j, _RED], block[j, _GREEN], block[j, _BLUE], block[j, _DEPTH]
    for k in range(rows[j, _FIRST], rows[j, _LAST]):
        raw = buffer[_ALPHA + k]
        alpha = raw if raw < ALPHA_MAX else ALPHA_MAX
        light = buffer[_LIGHT + k]
        weight = light * alpha
        after = light - weight
        # A finished pixel has no light: nothing is added to it and it stays finished.
        going = at_least(after, TRANSMITTANCE_MIN)
        weight = kept(going, weight)
        buffer[_LIGHT + k] = kept(going, after)
        buffer[_R + k] += weight * red
        buffer[_G + k] += weight * green
        buffer[_B + k] += weight * blue
        buffer[_Z + k] += weight * z
        buffer[_A + k] += weight


@njit(fastmath=FAST, error_model="numpy", forceinline=True, _nrt=False)
def _blend_backward(buffer: Any, block: Any, rows: Any, j: Any) -> None:
    """∂L/∂(log α) into the plane _POWER and the splat's share of each pixel into _WEIGHT."""
    red, green, blue, z = block[j, _RED], block[j, _GREEN], block[j, _BLUE], block[j, _DEPTH]
    for k in range(rows[j, _FIRST], rows[j, _LAST]):
        raw = buffer[_ALPHA + k]
        alpha = raw if raw < ALPHA_MAX else ALPHA_MAX
        light = buffer[_LIGHT + k]
        weight = light * alpha
        after = light - weight
        going = at_least(after, TRANSMITTANCE_MIN)
        buffer[_LIGHT + k] = kept(going, after)
        weight = kept(going, weight)
        # The saturated cap passes no gradient on; neither does a splat that was skipped here.
        free = kept(going & at_least(ALPHA_MAX, raw), raw)
        value = (
            buffer[_R + k] * red
            + buffer[_G + k] * green
            + buffer[_B + k] * blue
            + buffer[_Z + k] * (z - buffer[_MEAN + k])
            + buffer[_A + k]
        )
        behind = buffer[_BEHIND + k] - weight * value
        buffer[_BEHIND + k] = behind
        buffer[_WEIGHT + k] = weight
        buffer[_POWER + k] = (light * value - behind / (np.float32(1.0) - alpha)) * free


@njit(fastmath=FAST, error_model="numpy", forceinline=True, _nrt=False)
def _add_up(buffer: Any, block: Any, rows: Any, j: Any, sums: Any, pair: Any) -> None:
    p0, q0, l1, slant, l2 = block[j, _P0], block[j, _Q0], block[j, _L1], block[j, _K], block[j, _L2]
    h, hp, hq = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    hpp, hpq, hqq = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    to_red, to_green, to_blue, to_z = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for k in range(rows[j, _FIRST], rows[j, _LAST]):
        p = p0 + l1 * buffer[_COLUMN + k] + slant * buffer[_ROW + k]
        q = q0 + l2 * buffer[_ROW + k]
        to_power, weight = buffer[_POWER + k], buffer[_WEIGHT + k]
        h += to_power
        hp += to_power * p
        hq += to_power * q
        hpp += to_power * p * p
        hpq += to_power * p * q
        hqq += to_power * q * q
        to_red += weight * buffer[_R + k]
        to_green += weight * buffer[_G + k]
        to_blue += weight * buffer[_B + k]
        to_z += weight * buffer[_Z + k]
    once, twice = np.float32(_ROOT), np.float32(_ROOT * _ROOT)
    sums[pair, 0], sums[pair, 1], sums[pair, 2] = h, once * hp, once * hq
    sums[pair, 3], sums[pair, 4], sums[pair, 5] = twice * hpp, twice * hpq, twice * hqq
    sums[pair, 6], sums[pair, 7], sums[pair, 8], sums[pair, 9] = to_red, to_green, to_blue, to_z
