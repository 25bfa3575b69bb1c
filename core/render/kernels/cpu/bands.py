"""What the additive renderers share: bands of rows, in which each thread adds the splats in their order."""

from __future__ import annotations

from typing import Any

import numpy as np

from ....compiled import njit
from .math import FAST, exp_negative

LANES = 16
"""Pixels of a row that are evaluated together."""
BAND_ROWS = 8
PART = 1024
"""Splats added up before their sum is added to the image: a running float32 sum of 1e6 like terms errs by 0.5 %."""
SUMS = 13
"""Sums over pixels that say all about a splat's gradient."""
STRETCHES_A_SUM = 64
"""Stretches added up in float32 before their sum is added in float64."""
FARTHEST = np.float32(40.0)
"""Pixels whose squared distance is larger have no part in a splat: exp(−½·) is 2e-9 there.

A stretch has many that lie much farther off. Products of what they would weigh with small gradients are numbers that
float32 has no full precision for, with which processors calculate several times slower: where they weighed down to
2e-35, a backward pass of `radiograph` over trained splats took twice, one of `section` three times as long.
"""


@njit(inline="always")
def bell(q: Any) -> Any:
    """exp(−q/2) of a squared distance q in float32; 0 beyond `FARTHEST`, and of what is not a number."""
    value = exp_negative(np.float32(-0.5) * (q if q < FARTHEST else FARTHEST))
    return value if q < FARTHEST else np.float32(0.0)


def padded_width(width: int) -> int:
    """Row length of the image buffers: room for a stretch that starts at the last pixel."""
    return width + LANES


@njit
def aligned_zeros(count: int) -> Any:
    """(count,) float32 at a multiple of a vector register's size: no access touches two lines of the cache."""
    buffer = np.zeros(count + LANES, np.float32)
    skipped = -(buffer.ctypes.data // 4) % LANES
    return buffer[skipped : skipped + count]


@njit(error_model="numpy", cache=True)
def list_bands(boxes: Any, height: int) -> Any:
    """Splats of each band of rows in their order: starts (bands + 1,) and splats (P,), int32."""
    bands = (height + BAND_ROWS - 1) // BAND_ROWS
    starts = np.zeros(bands + 1, np.int64)
    for n in range(len(boxes)):
        if boxes[n, 0] < boxes[n, 1] and boxes[n, 2] < boxes[n, 3]:
            for band in range(boxes[n, 2] // BAND_ROWS, (boxes[n, 3] - 1) // BAND_ROWS + 1):
                starts[band + 1] += 1
    for band in range(bands):
        starts[band + 1] += starts[band]
    splats = np.empty(starts[bands], np.int32)
    filled = starts[:-1].copy()
    for n in range(len(boxes)):
        if boxes[n, 0] < boxes[n, 1] and boxes[n, 2] < boxes[n, 3]:
            for band in range(boxes[n, 2] // BAND_ROWS, (boxes[n, 3] - 1) // BAND_ROWS + 1):
                splats[filled[band]] = n
                filled[band] += 1
    return starts, splats


@njit(fastmath=FAST, error_model="numpy", cache=True, _nrt=False)
def add_lanes(lanes: Any, sums: Any) -> None:
    """Adds what the lanes have to `sums`, and makes them 0."""
    for place in range(np.uint64(SUMS)):
        total = np.float32(0.0)
        for lane in range(np.uint64(LANES)):
            total += lanes[np.uint64(LANES) * place + lane]
        sums[place] += total
    lanes[:] = np.float32(0.0)
