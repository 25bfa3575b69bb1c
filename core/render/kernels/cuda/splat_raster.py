"""Blending splats into pixels and back: a block of threads a tile, the same walk in both directions."""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import warp as wp

from .blocks import TILE, TILE_PIXELS

# With h = ∂L/∂α · α and (p, q) the offset in standard deviations, the sums over a tile's pixels of
# h, hp, hq, hp², hpq, hq²; then the gradients of red, green, blue and depth.
SUMS = 10
Sums = wp.types.vector(length=SUMS, dtype=wp.float32)
Sums64 = wp.types.vector(length=SUMS, dtype=wp.float64)

_ALPHA_MAX = wp.constant(wp.float32(0.99))
_ALPHA_MIN = wp.constant(wp.float32(1.0 / 255.0))
_TRANSMITTANCE_MIN = wp.constant(wp.float32(1e-4))


class BlendKernels(NamedTuple):
    """`blend` and `blend_backward`, for a number of pixels a thread."""

    blend: Any
    blend_backward: Any


@wp.func
def offset_in_sigmas(base: wp.vec2i, rest: wp.vec2, shape: wp.vec4, x: int, y: int) -> wp.vec2:
    """(p, q) = B (pixel − center), the centre given as a whole number of pixels and the rest: nothing cancels."""
    dx = wp.float32(x - base[0]) - rest[0]
    dy = wp.float32(y - base[1]) - rest[1]
    return wp.vec2(shape[0] * dx + shape[1] * dy, shape[2] * dy)


@wp.func
def raw_alpha(offset: wp.vec2, opacity: wp.float32) -> wp.float32:
    return opacity * wp.exp(-0.5 * (offset[0] * offset[0] + offset[1] * offset[1]))


@wp.func
def drawn_alpha(raw: wp.float32) -> wp.float32:
    alpha = wp.min(raw, _ALPHA_MAX)
    if not (alpha >= _ALPHA_MIN):
        alpha = wp.float32(0.0)
    return alpha


@cache
def blend_kernels(pixels: int) -> BlendKernels:
    """Compiles for threads that take `pixels` pixels of a tile each."""
    threads = TILE_PIXELS // pixels
    Plane = wp.types.vector(length=pixels, dtype=wp.float32)

    @wp.kernel(module="unique", enable_backward=False)
    def blend(
        starts: wp.array(dtype=wp.int32),
        splats: wp.array(dtype=wp.int32),
        bases: wp.array(dtype=wp.vec2i),
        rests: wp.array(dtype=wp.vec2),
        shapes: wp.array(dtype=wp.vec4),
        features: wp.array(dtype=wp.vec4),
        background: wp.array(dtype=wp.vec3),
        width: int,
        height: int,
        color: wp.array2d(dtype=wp.vec3),
        alphas: wp.array2d(dtype=wp.float32),
        depth: wp.array2d(dtype=wp.float32),
        blended: wp.array(dtype=wp.int32),
    ):
        tile, thread = wp.tid()
        columns = (width + TILE - 1) // TILE
        first = starts[tile]
        last = starts[tile + 1]
        needed = wp.int32(0)
        for k in range(pixels):
            place = k * threads + thread
            x = tile % columns * TILE + place % TILE
            y = tile // columns * TILE + place // TILE
            if x < width and y < height:
                light = wp.float32(1.0)
                covered = wp.float32(0.0)
                seen = wp.vec4()
                pair = wp.int32(first)
                while pair < last:
                    i = splats[pair]
                    shape = shapes[i]
                    offset = offset_in_sigmas(bases[i], rests[i], shape, x, y)
                    alpha = drawn_alpha(raw_alpha(offset, shape[3]))
                    after = light - light * alpha
                    if after < _TRANSMITTANCE_MIN:
                        break
                    seen += (light * alpha) * features[i]
                    covered += light * alpha
                    light = after
                    pair += 1
                needed = wp.max(needed, pair - first)
                color[y, x] = wp.vec3(seen[0], seen[1], seen[2]) + light * background[0]
                # Summed up, not one less what is left: a faint pixel's depth is a quotient by it.
                alphas[y, x] = covered
                mean = wp.float32(0.0)
                if covered > 0.0:
                    mean = seen[3] / covered
                depth[y, x] = mean
        wp.tile_store(blended, wp.tile_max(wp.tile(needed)), offset=tile)

    @wp.kernel(module="unique", enable_backward=False)
    def blend_backward(
        starts: wp.array(dtype=wp.int32),
        splats: wp.array(dtype=wp.int32),
        slots: wp.array(dtype=wp.int32),
        bases: wp.array(dtype=wp.vec2i),
        rests: wp.array(dtype=wp.vec2),
        shapes: wp.array(dtype=wp.vec4),
        features: wp.array(dtype=wp.vec4),
        width: int,
        height: int,
        color: wp.array2d(dtype=wp.vec3),
        alphas: wp.array2d(dtype=wp.float32),
        depth: wp.array2d(dtype=wp.float32),
        blended: wp.array(dtype=wp.int32),
        grad_color: wp.array2d(dtype=wp.vec3),
        grad_alpha: wp.array2d(dtype=wp.float32),
        grad_depth: wp.array2d(dtype=wp.float32),
        sums: wp.array(dtype=Sums),
    ):
        tile, thread = wp.tid()
        columns = (width + TILE - 1) // TILE
        # What is kept for each pixel: the light left, ∂L/∂ of colour, depth and alpha, and Σ of what lies behind.
        light = Plane()
        red = Plane()
        green = Plane()
        blue = Plane()
        far = Plane()
        cover = Plane()
        behind = Plane()
        for k in range(pixels):
            place = k * threads + thread
            x = tile % columns * TILE + place % TILE
            y = tile // columns * TILE + place // TILE
            if x < width and y < height:
                to_color = grad_color[y, x]
                covered = alphas[y, x]
                share = wp.float32(0.0)
                if covered > 0.0:
                    share = grad_depth[y, x] / covered
                light[k] = wp.float32(1.0)
                red[k] = to_color[0]
                green[k] = to_color[1]
                blue[k] = to_color[2]
                far[k] = share
                cover[k] = grad_alpha[y, x] - share * depth[y, x]
                behind[k] = wp.dot(to_color, color[y, x]) + grad_alpha[y, x] * covered
        # The same for every thread of the block, as the sums over the block need it.
        last = starts[tile] + blended[tile]
        for pair in range(starts[tile], last):
            i = splats[pair]
            shape = shapes[i]
            feature = features[i]
            total = Sums()
            for k in range(pixels):
                place = k * threads + thread
                x = tile % columns * TILE + place % TILE
                y = tile // columns * TILE + place // TILE
                offset = offset_in_sigmas(bases[i], rests[i], shape, x, y)
                raw = raw_alpha(offset, shape[3])
                alpha = drawn_alpha(raw)
                after = light[k] - light[k] * alpha
                if after < _TRANSMITTANCE_MIN:
                    # A finished pixel has no light: what comes behind adds nothing.
                    light[k] = wp.float32(0.0)
                elif alpha > 0.0:
                    weight = light[k] * alpha
                    value = (
                        red[k] * feature[0] + green[k] * feature[1] + blue[k] * feature[2] + far[k] * feature[3]
                        + cover[k]
                    )  # fmt: skip
                    behind[k] = behind[k] - weight * value
                    # The saturated cap passes no gradient on.
                    if raw <= _ALPHA_MAX:
                        h = (light[k] * value - behind[k] / (1.0 - alpha)) * alpha
                        hp = h * offset[0]
                        hq = h * offset[1]
                        total[0] += h
                        total[1] += hp
                        total[2] += hq
                        total[3] += hp * offset[0]
                        total[4] += hp * offset[1]
                        total[5] += hq * offset[1]
                    total[6] += weight * red[k]
                    total[7] += weight * green[k]
                    total[8] += weight * blue[k]
                    total[9] += weight * far[k]
                    light[k] = after
            wp.tile_store(sums, wp.tile_sum(wp.tile(total, preserve_type=True)), offset=slots[pair])

    return BlendKernels(blend, blend_backward)
