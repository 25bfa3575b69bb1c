"""Line integrals of splats in pixels and their gradients: a block of threads a tile."""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import warp as wp

from .blocks import PART, TILE, TILE_PIXELS

# A splat's numbers: p11, p12, p13, p22, p23 of P, r11, r12, r13, r22, r23, r33 of R, and the amplitude.
ROW = 12
Row = wp.types.vector(length=ROW, dtype=wp.float32)
# With h = ∂L/∂value, w = value / amplitude, τ = h·value / (2 den) and γ = τ·(num/den − 1), the sums over a tile's
# pixels of h·w; τ·x·z and τ·y·z with (x, y) = P z; γ·(z₀², z₀z₁, z₁², z₀, z₁, 1).
SUMS = 13
Sums = wp.types.vector(length=SUMS, dtype=wp.float32)
Sums64 = wp.types.vector(length=SUMS, dtype=wp.float64)


class RayKernels(NamedTuple):
    """`integrate` and `integrate_backward`, for a number of pixels a thread."""

    integrate: Any
    integrate_backward: Any


@wp.struct
class _Sample:
    x: wp.float32
    y: wp.float32
    a: wp.float32
    b: wp.float32
    inverse: wp.float32
    q: wp.float32
    w: wp.float32


@wp.func
def _sample(row: Row, base: wp.vec2i, rest: wp.vec2, x: int, y: int, limit: wp.float32) -> _Sample:
    """w = den^(−1/2)·exp(−½ num/den) at a pixel, and what it is made of; 0 beyond the cutoff."""
    s = _Sample()
    s.x = wp.float32(x - base[0]) - rest[0]
    s.y = wp.float32(y - base[1]) - rest[1]
    s.a = row[0] * s.x + row[1] * s.y + row[2]
    s.b = row[3] * s.y + row[4]
    along = row[5] * s.x + row[6] * s.y + row[7]
    across = row[8] * s.y + row[9]
    s.inverse = 1.0 / (along * along + across * across + row[10] * row[10])
    s.q = (s.a * s.a + s.b * s.b) * s.inverse
    s.w = wp.float32(0.0)
    if s.q <= limit:
        s.w = wp.sqrt(s.inverse) * wp.exp(-0.5 * s.q)
    return s


@cache
def ray_kernels(pixels: int) -> RayKernels:
    """Compiles for threads that take `pixels` pixels of a tile each."""
    threads = TILE_PIXELS // pixels
    Plane = wp.types.vector(length=pixels, dtype=wp.float32)

    @wp.kernel(module="unique", enable_backward=False)
    def integrate(
        starts: wp.array(dtype=wp.int32),
        splats: wp.array(dtype=wp.int32),
        bases: wp.array(dtype=wp.vec2i),
        rests: wp.array(dtype=wp.vec2),
        rows: wp.array(dtype=Row),
        limit: wp.float32,
        width: int,
        height: int,
        image: wp.array2d(dtype=wp.float32),
    ):
        tile, thread = wp.tid()
        columns = (width + TILE - 1) // TILE
        for k in range(pixels):
            place = k * threads + thread
            x = tile % columns * TILE + place % TILE
            y = tile // columns * TILE + place // TILE
            if x < width and y < height:
                total = wp.float32(0.0)
                part = wp.float32(0.0)
                for pair in range(starts[tile], starts[tile + 1]):
                    i = splats[pair]
                    row = rows[i]
                    s = _sample(row, bases[i], rests[i], x, y, limit)
                    part += row[11] * s.w
                    if pair % PART == 0:
                        total += part
                        part = wp.float32(0.0)
                image[y, x] = total + part

    @wp.kernel(module="unique", enable_backward=False)
    def integrate_backward(
        starts: wp.array(dtype=wp.int32),
        splats: wp.array(dtype=wp.int32),
        slots: wp.array(dtype=wp.int32),
        bases: wp.array(dtype=wp.vec2i),
        rests: wp.array(dtype=wp.vec2),
        rows: wp.array(dtype=Row),
        limit: wp.float32,
        width: int,
        height: int,
        grad: wp.array2d(dtype=wp.float32),
        sums: wp.array(dtype=Sums),
    ):
        tile, thread = wp.tid()
        columns = (width + TILE - 1) // TILE
        incoming = Plane()
        for k in range(pixels):
            place = k * threads + thread
            x = tile % columns * TILE + place % TILE
            y = tile // columns * TILE + place // TILE
            if x < width and y < height:
                incoming[k] = grad[y, x]
        for pair in range(starts[tile], starts[tile + 1]):
            i = splats[pair]
            row = rows[i]
            total = Sums()
            for k in range(pixels):
                place = k * threads + thread
                x = tile % columns * TILE + place % TILE
                y = tile // columns * TILE + place // TILE
                s = _sample(row, bases[i], rests[i], x, y, limit)
                if s.w > 0.0:
                    hw = incoming[k] * s.w
                    tau = 0.5 * row[11] * hw * s.inverse
                    gamma = tau * (s.q - 1.0)
                    tau_a = tau * s.a
                    tau_b = tau * s.b
                    total[0] += hw
                    total[1] += tau_a * s.x
                    total[2] += tau_a * s.y
                    total[3] += tau_a
                    total[4] += tau_b * s.x
                    total[5] += tau_b * s.y
                    total[6] += tau_b
                    total[7] += gamma * s.x * s.x
                    total[8] += gamma * s.x * s.y
                    total[9] += gamma * s.y * s.y
                    total[10] += gamma * s.x
                    total[11] += gamma * s.y
                    total[12] += gamma
            wp.tile_store(sums, wp.tile_sum(wp.tile(total, preserve_type=True)), offset=slots[pair])

    return RayKernels(integrate, integrate_backward)
