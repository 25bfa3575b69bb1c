"""Blending splats into pixels and back: one tile a thread, one splat at a time over a run of the tile's pixels.

All that a tile knows of its 256 pixels lies in one buffer, a plane of 256 floats for each quantity, so that LLVM
sees one pointer with fixed distances and vectorises the loops over pixels without checks for overlap. The rows of
a tile that a splat does not reach are skipped; those it does are one contiguous run.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange

from .math import FAST, exp_negative
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
_PLANES = 10
# How many splats are blended between two looks at whether every pixel is finished.
_LOOK = 16


@njit(parallel=True, cache=True, error_model="numpy")
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
        _open_tile(buffer, x0, y0, width, height)
        pair = starts[tile]
        while pair < starts[tile + 1] and _any_light(buffer):
            stop = min(pair + _LOOK, starts[tile + 1])
            while pair < stop:
                i = splats[pair]
                first, last = _rows(centers[i, 1], attributes[i, HALF], y0)
                p, q = _corner(centers[i], attributes[i], x0, y0)
                _blend(buffer, first, last, p, q, attributes[i])
                pair += 1
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


@njit(parallel=True, cache=True, error_model="numpy")
def rasterize_backward(
    starts: Any,
    splats: Any,
    slots: Any,
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
    """Adds up, for every pair, what its pixels say about its splat, into `sums` (P, SUMS) at the pair's slot.

    Walks front to back as `rasterize` does, with the very same arithmetic, so that both agree about which pixel a
    splat is skipped in. What lies behind a splat is the pixel's total less what was passed.
    """
    height, width = alpha.shape
    columns = (width + TILE - 1) // TILE
    for square in prange(len(starts) - 1):
        tile = np.int64(square)
        x0, y0 = tile % columns * TILE, tile // columns * TILE
        buffer = np.zeros(_PLANES * _PIXELS, np.float32)
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
        for pair in range(starts[tile], starts[tile] + blended[tile]):
            i = splats[pair]
            first, last = _rows(centers[i, 1], attributes[i, HALF], y0)
            p, q = _corner(centers[i], attributes[i], x0, y0)
            _blend_backward(buffer, first, last, p, q, attributes[i], sums[slots[pair]])


@njit
def _open_tile(buffer: Any, x0: Any, y0: Any, width: Any, height: Any) -> None:
    """Pixel offsets, and full light where the tile lies inside the image; pixels outside are finished."""
    for k in range(np.uint64(_PIXELS)):
        column, row = np.int64(k) % TILE, np.int64(k) // TILE
        buffer[_COLUMN + k] = column
        buffer[_ROW + k] = row
        buffer[_LIGHT + k] = 1.0 if x0 + column < width and y0 + row < height else 0.0


@njit(fastmath=FAST, error_model="numpy")
def _any_light(buffer: Any) -> bool:
    light = np.float32(0.0)
    for k in range(np.uint64(_PIXELS)):
        light += buffer[_LIGHT + k]
    return light > 0.0


@njit(inline="always")
def _rows(center_y: Any, half: Any, y0: Any) -> Any:
    """First and one past the last pixel of the tile that a splat reaching `half` up and down touches."""
    first = max(np.ceil(center_y - half - 0.5 - y0), 0.0)
    last = min(np.floor(center_y + half + 0.5 - y0), np.float64(TILE))
    return np.uint64(first * TILE), np.uint64(max(last, first) * TILE)


@njit(inline="always")
def _corner(center: Any, attribute: Any, x0: Any, y0: Any) -> Any:
    """(p, q) of the tile's first pixel centre, from float64 because the difference may be small."""
    dx, dy = x0 + 0.5 - center[0], y0 + 0.5 - center[1]
    return np.float32(attribute[L1] * dx + attribute[K] * dy), np.float32(attribute[L2] * dy)


@njit(fastmath=FAST, error_model="numpy")
def _blend(buffer: Any, first: Any, last: Any, p0: Any, q0: Any, attribute: Any) -> None:
    l1, slant, l2, opacity = attribute[L1], attribute[K], attribute[L2], attribute[OPACITY]
    red, green, blue, z = attribute[RED], attribute[GREEN], attribute[BLUE], attribute[DEPTH]
    for k in range(first, last):
        p = p0 + l1 * buffer[_COLUMN + k] + slant * buffer[_ROW + k]
        q = q0 + l2 * buffer[_ROW + k]
        alpha = opacity * exp_negative(np.float32(-0.5) * (p * p + q * q))
        alpha = alpha if alpha < ALPHA_MAX else ALPHA_MAX
        alpha = alpha if alpha >= ALPHA_MIN else np.float32(0.0)
        light = buffer[_LIGHT + k]
        after = light - light * alpha
        # A finished pixel has no light: nothing is added to it and it stays finished.
        going = after >= TRANSMITTANCE_MIN
        weight = light * alpha if going else np.float32(0.0)
        buffer[_LIGHT + k] = after if going else np.float32(0.0)
        buffer[_R + k] += weight * red
        buffer[_G + k] += weight * green
        buffer[_B + k] += weight * blue
        buffer[_Z + k] += weight * z
        buffer[_A + k] += weight


@njit(fastmath=FAST, error_model="numpy")
def _blend_backward(buffer: Any, first: Any, last: Any, p0: Any, q0: Any, attribute: Any, sums: Any) -> None:
    l1, slant, l2, opacity = attribute[L1], attribute[K], attribute[L2], attribute[OPACITY]
    red, green, blue, z = attribute[RED], attribute[GREEN], attribute[BLUE], attribute[DEPTH]
    h, hp, hq = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    hpp, hpq, hqq = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    to_red, to_green, to_blue, to_z = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for k in range(first, last):
        p = p0 + l1 * buffer[_COLUMN + k] + slant * buffer[_ROW + k]
        q = q0 + l2 * buffer[_ROW + k]
        raw = opacity * exp_negative(np.float32(-0.5) * (p * p + q * q))
        alpha = raw if raw < ALPHA_MAX else ALPHA_MAX
        alpha = alpha if alpha >= ALPHA_MIN else np.float32(0.0)
        light = buffer[_LIGHT + k]
        after = light - light * alpha
        going = after >= TRANSMITTANCE_MIN
        buffer[_LIGHT + k] = after if going else np.float32(0.0)
        # The saturated cap passes no gradient on; neither does a splat that was skipped here.
        used = alpha if going else np.float32(0.0)
        free = used if raw <= ALPHA_MAX else np.float32(0.0)
        weight = light * used
        value = (
            buffer[_R + k] * red
            + buffer[_G + k] * green
            + buffer[_B + k] * blue
            + buffer[_Z + k] * (z - buffer[_MEAN + k])
            + buffer[_A + k]
        )
        behind = buffer[_BEHIND + k] - weight * value
        buffer[_BEHIND + k] = behind
        to_power = (light * value - behind / (np.float32(1.0) - alpha)) * free
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
    sums[0], sums[1], sums[2], sums[3], sums[4], sums[5] = h, hp, hq, hpp, hpq, hqq
    sums[6], sums[7], sums[8], sums[9] = to_red, to_green, to_blue, to_z
