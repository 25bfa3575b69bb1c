"""Where on the image a splat stands, for the kernels of all renderers."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor

from .blocks import view
from .rotations import ONE, ZERO

_FARTHEST = wp.constant(wp.float64(1 << 30))


class OnImage(NamedTuple):
    """N splats as the pixels of an additive renderer see them.

    Attributes:
        boxes: (N, 4) int32 pixels outside of which nothing reaches the cutoff; see `tiles.bin_boxes`. Empty for a
            splat that is left out, of which nothing else is set.
        whole, rests: (N, 2) int32 and float32: nearest pixel of the place that a splat is counted from, and the rest.
        rows: (N, numbers of the renderer's row) float32.
    """

    boxes: Tensor
    whole: Tensor
    rests: Tensor
    rows: Tensor

    @classmethod
    def unset(cls, count: int, row: Any, device: torch.device) -> OnImage:
        """For a kernel to fill in; `row` is the renderer's Warp vector."""
        boxes, whole = (torch.empty(count, size, dtype=torch.int32, device=device) for size in (4, 2))
        rests, rows = (torch.empty(count, size, device=device) for size in (2, len(row())))
        return cls(boxes, whole, rests, rows)

    def of_pixels(self, row: Any) -> tuple[Any, ...]:
        """What the kernels over pixels take."""
        return view(self.whole, wp.vec2i), view(self.rests, wp.vec2), view(self.rows, row)


@wp.func
def drawn_in(value: wp.float64, low: wp.float64, high: wp.float64) -> wp.float64:
    """Clamped; 0 if it is no number."""
    drawn = ZERO
    if wp.isfinite(value):
        drawn = wp.clamp(value, low, high)
    return drawn


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
