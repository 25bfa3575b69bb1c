"""Where on the image a splat stands, for the kernels of all renderers."""

from __future__ import annotations

import warp as wp

from .rotations import ONE, ZERO

_FARTHEST = wp.constant(wp.float64(1 << 30))


@wp.func
def nearest_pixel(place: wp.vec2d) -> wp.vec2i:
    """Pixels count from there, so that distances do not cancel in float32."""
    x, y = wp.clamp(wp.rint(place[0]), -_FARTHEST, _FARTHEST), wp.clamp(wp.rint(place[1]), -_FARTHEST, _FARTHEST)
    return wp.vec2i(int(x), int(y))


@wp.func
def rest_of(place: wp.vec2d, whole: wp.vec2i) -> wp.vec2:
    """What is left of a place beside its `nearest_pixel`."""
    return wp.vec2(wp.float32(place[0] - wp.float64(whole[0])), wp.float32(place[1] - wp.float64(whole[1])))


@wp.func
def pixel_range(low: wp.float64, high: wp.float64, size: wp.float64) -> wp.vec2i:
    """First and one past the last of the whole numbers in low..high within 0..size; NaN gives everything."""
    first, stop = wp.int32(0), wp.int32(size)
    if low > ZERO:
        first = wp.int32(wp.ceil(wp.min(low, size)))
    if high < size - ONE:
        stop = wp.int32(wp.floor(wp.max(high, -ONE))) + 1
    return wp.vec2i(first, stop)
