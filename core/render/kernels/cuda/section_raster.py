"""Cuts and slabs in pixels and their gradients: a block of threads a tile."""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import warp as wp

from .blocks import PART, TILE, TILE_PIXELS

# A splat's numbers: c11, c12, c13, c22, c23, c31, c32, c33 of C, η, the amount.
ROW = 10
Row = wp.types.vector(length=ROW, dtype=wp.float32)
# With h = ∂L/∂(amount·w), the sums over a tile's pixels of h·w; then of h·amount times w·x·z, w·y·z, ∂w/∂m·z with
# z = (z₀, z₁, 1), and ∂w/∂η; then, of every channel, of ∂L/∂channel · amount·w.
GEOMETRY_SUMS = 11

_THIN_ETA = wp.constant(wp.float32(0.5))
"""Under this half thickness, in standard deviations, the slab's mean is taken from its series (error 1e-6)."""
_LARGEST_ALPHA = wp.constant(wp.float32(1 - 1e-6))
_SQRT_HALF = wp.constant(wp.float32(0.7071067811865476))
_SQRT_HALF_PI = wp.constant(wp.float32(1.2533141373155003))


class SectionKernels(NamedTuple):
    """`draw` and `draw_backward`, and the Warp vectors of the channels and of a pair's sums."""

    draw: Any
    draw_backward: Any
    channels: Any
    sums: Any


@wp.struct
class _Sample:
    x: wp.float32
    y: wp.float32
    a: wp.float32
    b: wp.float32
    w: wp.float32
    by_m: wp.float32
    by_eta: wp.float32


@wp.func
def _mean_over_slab(m: wp.float32, eta: wp.float32) -> wp.vec3:
    """Mean of exp(−½(m + t)²) over t in ±η, and its derivatives by m and η; η = 0 is the value at m."""
    if eta < _THIN_ETA:
        u = m * m
        e2 = eta * eta / 6.0
        e4 = eta * eta * eta * eta / 120.0
        e6 = e2 * e4 / 7.0
        s0 = 1.0 - e2 + 3.0 * e4 - 15.0 * e6
        s1 = e2 - 6.0 * e4 + 45.0 * e6
        s2 = e4 - 15.0 * e6
        series = s0 + u * (s1 + u * (s2 + u * e6))
        slope = s1 + u * (2.0 * s2 + u * 3.0 * e6)
        d2 = eta / 3.0
        d4 = eta * eta * eta / 30.0
        d6 = d4 * eta * eta / 28.0
        by_eta = (
            -d2 + 3.0 * d4 - 15.0 * d6 + u * (d2 - 6.0 * d4 + 45.0 * d6 + u * (d4 - 15.0 * d6 + u * d6))
        )  # fmt: skip
        bell = wp.exp(-0.5 * u)
        return bell * wp.vec3(series, m * (2.0 * slope - series), by_eta)
    upper = m + eta
    lower = m - eta
    high = wp.exp(-0.5 * upper * upper)
    low = wp.exp(-0.5 * lower * lower)
    mean = 0.5 * _SQRT_HALF_PI / eta * (wp.erf(upper * _SQRT_HALF) - wp.erf(lower * _SQRT_HALF))
    return wp.vec3(mean, 0.5 * (high - low) / eta, (0.5 * (high + low) - mean) / eta)


@wp.func
def _sample(row: Row, base: wp.vec2i, rest: wp.vec2, x: int, y: int, cutoff: wp.float32) -> _Sample:
    """w at a pixel and its derivatives by m and η; 0 beyond the cutoff."""
    s = _Sample()
    s.x = wp.float32(x - base[0]) - rest[0]
    s.y = wp.float32(y - base[1]) - rest[1]
    s.a = row[0] * s.x + row[1] * s.y + row[2]
    s.b = row[3] * s.y + row[4]
    m = row[5] * s.x + row[6] * s.y + row[7]
    q = s.a * s.a + s.b * s.b
    room = cutoff * cutoff
    if row[8] == 0.0:
        room -= m * m
    s.w = wp.float32(0.0)
    s.by_m = wp.float32(0.0)
    s.by_eta = wp.float32(0.0)
    if q <= room and wp.abs(m) <= cutoff + row[8]:
        bell = wp.exp(-0.5 * q)
        mean = _mean_over_slab(m, row[8])
        s.w = bell * wp.max(mean[0], 0.0)
        s.by_m = bell * mean[1]
        s.by_eta = bell * mean[2]
    return s


@cache
def section_kernels(pixels: int, channels: int, product: bool) -> SectionKernels:
    """Compiles for threads that take `pixels` pixels of a tile each.

    Args:
        channels: numbers of a pixel, Σ amount·w·value for each.
        product: instead Π(1 − amount·w), one channel.
    """
    threads = TILE_PIXELS // pixels
    Channels = wp.types.vector(length=channels, dtype=wp.float32)
    Sums = wp.types.vector(length=GEOMETRY_SUMS + channels, dtype=wp.float32)

    @wp.kernel(module="unique", enable_backward=False)
    def draw(
        starts: wp.array(dtype=wp.int32),
        splats: wp.array(dtype=wp.int32),
        bases: wp.array(dtype=wp.vec2i),
        rests: wp.array(dtype=wp.vec2),
        rows: wp.array(dtype=Row),
        values: wp.array(dtype=Channels),
        cutoff: wp.float32,
        width: int,
        height: int,
        image: wp.array2d(dtype=Channels),
    ):
        tile, thread = wp.tid()
        columns = (width + TILE - 1) // TILE
        for k in range(pixels):
            place = k * threads + thread
            x = tile % columns * TILE + place % TILE
            y = tile // columns * TILE + place // TILE
            if x < width and y < height:
                total = Channels()
                part = Channels()
                empty = wp.float32(1.0)
                for pair in range(starts[tile], starts[tile + 1]):
                    i = splats[pair]
                    row = rows[i]
                    s = _sample(row, bases[i], rests[i], x, y, cutoff)
                    alpha = row[9] * s.w
                    if wp.static(product):
                        empty *= 1.0 - wp.min(alpha, _LARGEST_ALPHA)
                    else:
                        part += alpha * values[i]
                        if pair % PART == 0:
                            total += part
                            part = Channels()
                if wp.static(product):
                    total[0] = empty
                image[y, x] = total + part

    @wp.kernel(module="unique", enable_backward=False)
    def draw_backward(
        starts: wp.array(dtype=wp.int32),
        splats: wp.array(dtype=wp.int32),
        slots: wp.array(dtype=wp.int32),
        bases: wp.array(dtype=wp.vec2i),
        rests: wp.array(dtype=wp.vec2),
        rows: wp.array(dtype=Row),
        values: wp.array(dtype=Channels),
        cutoff: wp.float32,
        width: int,
        height: int,
        grad: wp.array2d(dtype=Channels),
        sums: wp.array(dtype=Sums),
    ):
        tile, thread = wp.tid()
        columns = (width + TILE - 1) // TILE
        for pair in range(starts[tile], starts[tile + 1]):
            i = splats[pair]
            row = rows[i]
            value = Channels(values[i])
            total = Sums()
            for k in range(pixels):
                place = k * threads + thread
                x = tile % columns * TILE + place % TILE
                y = tile // columns * TILE + place // TILE
                if x < width and y < height:
                    s = _sample(row, bases[i], rests[i], x, y, cutoff)
                    alpha = row[9] * s.w
                    incoming = grad[y, x]
                    h = wp.dot(incoming, value)
                    if wp.static(product):
                        if alpha <= _LARGEST_ALPHA:
                            h = h / (1.0 - alpha)
                        else:
                            h = wp.float32(0.0)
                    g = h * row[9]
                    ga = g * s.w * s.a
                    gb = g * s.w * s.b
                    gm = g * s.by_m
                    total[0] += h * s.w
                    total[1] += ga * s.x
                    total[2] += ga * s.y
                    total[3] += ga
                    total[4] += gb * s.x
                    total[5] += gb * s.y
                    total[6] += gb
                    total[7] += gm * s.x
                    total[8] += gm * s.y
                    total[9] += gm
                    total[10] += g * s.by_eta
                    for c in range(channels):
                        total[GEOMETRY_SUMS + c] += incoming[c] * alpha
            wp.tile_store(sums, wp.tile_sum(wp.tile(total, preserve_type=True)), offset=slots[pair])

    return SectionKernels(draw, draw_backward, Channels, Sums)
