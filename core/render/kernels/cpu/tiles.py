"""Which splats touch which square of pixels, in the order they are blended."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import get_num_threads

from ....compiled import njit, prange
from ....errors import SettingError
from ....threads import loops_only
from .math import bits_of_float

TILE = 16
_MOST_PAIRS = 2**31 - 1

# Unsigned indices spare Numba's test for negative ones.
_LEFT, _RIGHT, _ONE = np.uint64(0), np.uint64(1), np.uint64(1)


class Tiles(NamedTuple):
    """The (splat, tile) pairs of an image cut into `TILE` x `TILE` squares, row by row.

    Attributes:
        columns, rows: number of tiles across and down.
        starts: (columns * rows + 1,) int32; the pairs of tile t are starts[t] : starts[t + 1].
        splats: (P,) int32 splat of each pair, in the given order within a tile.
        slots: (P,) int32 row of each pair in a table that has all pairs of one splat together; where a tile's
            gradient for one splat is put, so that no two threads write to one place. Splats that `order` leaves
            out have rows too, which no pair names: give them an empty box or a reach of 0 to avoid that.
        slot_starts: (N + 1,) int32; the slots of splat i are slot_starts[i] : slot_starts[i + 1].
    """

    columns: int
    rows: int
    starts: np.ndarray
    splats: np.ndarray
    slots: np.ndarray
    slot_starts: np.ndarray


def bin_ellipses(
    centers: np.ndarray, factors: np.ndarray, reach: np.ndarray, order: np.ndarray, width: int, height: int
) -> Tiles:
    """Tiles that hold a point of the ellipses ‖B (p − center)‖ ≤ reach, p anywhere in a tile's pixel centres.

    Args:
        centers: (N, 2) float64 pixels.
        factors: (N, 3 or more) float32, first l1, k, l2: B = [[l1, k], [0, l2]], the upper triangular factor of
            the inverse covariance, so that splats too thin for a covariance in float32 are still placed right.
        reach: (N,) float32 in standard deviations; ≤ 0 leaves a splat out.
        order: (M,) int32 splats to place, in blending order (see `depth_order`).
        width, height: image size in pixels.

    Raises:
        SettingError: there are more pairs than int32 counts.
    """
    columns, rows = _grid(width, height)
    spans = _ellipse_spans(centers, factors, reach, width, height)
    runs = spans[2]
    if len(runs) * columns > _MOST_PAIRS:
        pairs = int((runs[:, 1] - runs[:, 0]).sum(dtype=np.int64))
        if pairs > _MOST_PAIRS:
            raise SettingError(
                "Splats meet {pairs} tiles of an image, more than the kernel '{kernel}' can list; use smaller images, "
                "or fewer and smaller splats.",
                kernel="cpu",
                pairs=pairs,
            )
    return Tiles(columns, rows, *_fill(*spans, order, columns, rows, get_num_threads()))


@njit(cache=True, error_model="numpy")
def depth_order(depth: Any, drawn: Any) -> Any:
    """Rows (M,) int32 that `drawn` (N,) bool allows, nearest first; equal depths keep their order.

    A radix sort of the bits of `depth` (N,) float32, finite, of any sign.
    """
    count = 0
    for i in range(len(depth)):
        count += drawn[i]
    keys = np.empty(count, np.uint32)
    rows = np.empty(count, np.int32)
    n = 0
    for i in range(len(depth)):
        if drawn[i]:
            bits = np.uint32(bits_of_float(depth[i]))
            # Flips the bits so that unsigned order is the order of the floats, negative ones included.
            keys[n] = ~bits if bits >> np.uint32(31) else bits | np.uint32(0x80000000)
            rows[n] = i
            n += 1
    spare_keys = np.empty_like(keys)
    spare_rows = np.empty_like(rows)
    for shift in (0, 11, 22):
        begin = np.zeros(2049, np.int32)
        for i in range(count):
            begin[((keys[i] >> np.uint32(shift)) & np.uint32(2047)) + 1] += 1
        for digit in range(2048):
            begin[digit + 1] += begin[digit]
        for i in range(count):
            digit = (keys[i] >> np.uint32(shift)) & np.uint32(2047)
            to = begin[digit]
            begin[digit] = to + 1
            spare_keys[to] = keys[i]
            spare_rows[to] = rows[i]
        keys, spare_keys = spare_keys, keys
        rows, spare_rows = spare_rows, rows
    return rows


@njit(cache=True)
def pairs_of_slots(slots: Any) -> Any:
    """The pair (P,) int32 in each slot, when all slots are named by a pair."""
    pairs = np.empty(len(slots), np.int32)
    for pair in range(len(slots)):
        pairs[slots[pair]] = pair
    return pairs


def _grid(width: int, height: int) -> tuple[int, int]:
    return (width + TILE - 1) // TILE, (height + TILE - 1) // TILE


@njit(inline="always", error_model="numpy")
def _tile_range(low: Any, high: Any, size: Any) -> Any:
    """First and one past the last tile with a pixel centre in low..high, within 0..size pixels; NaN gives none."""
    first = max(np.ceil(low - 0.5), 0.0)
    last = min(np.floor(high - 0.5), size - 1.0)
    if low <= high and first <= last:
        return int(first) // TILE, int(last) // TILE + 1
    return 0, 0


@njit(parallel=loops_only(), cache=True, error_model="numpy")
def _ellipse_spans(centers: Any, factors: Any, reach: Any, width: Any, height: Any) -> Any:
    """For every splat the tile rows it touches, and for each of those the tile columns (see `_fill`).

    Within a row of tiles an ellipse, being convex, touches one run of columns.
    """
    count = len(centers)
    tops = np.empty(count, np.int32)
    row_starts = np.zeros(count + 1, np.int32)
    for i in prange(count):
        top, bottom = 0, 0
        if reach[i] > 0.0:
            half = reach[i] / np.float64(factors[i, 2])
            top, bottom = _tile_range(centers[i, 1] - half, centers[i, 1] + half, height)
        tops[i] = top
        row_starts[i + 1] = bottom - top
    for i in range(count):
        row_starts[i + 1] += row_starts[i]
    spans = np.empty((row_starts[count], 2), np.int32)
    for i in prange(count):
        for entry in range(row_starts[i], row_starts[i + 1]):
            y = TILE * (tops[i] + entry - row_starts[i]) + 0.5 - centers[i, 1]
            left, right = _ellipse_run(
                np.float64(factors[i, 0]), np.float64(factors[i, 1]), np.float64(factors[i, 2]),
                np.float64(reach[i]), y, y + (TILE - 1),
            )  # fmt: skip
            first, last = _tile_range(centers[i, 0] + left, centers[i, 0] + right, width)
            spans[entry, 0] = first
            spans[entry, 1] = last
    return tops, row_starts, spans


@njit(inline="always", error_model="numpy")
def _ellipse_run(l1: Any, k: Any, l2: Any, reach: Any, low: Any, high: Any) -> Any:
    """Smallest and largest x of the ellipse ‖B (x, y)‖ ≤ reach with y in low..high."""
    top = reach / l2
    low, high = max(low, -top), min(high, top)
    # The y of the ellipse's rightmost point, Σxy·reach / √Σxx; the leftmost is opposite.
    y = -k / l2 * reach / np.sqrt(l2 * l2 + k * k)
    right = min(max(y, low), high)
    left = min(max(-y, low), high)
    return (
        (-k * left - np.sqrt(max(reach * reach - l2 * l2 * left * left, 0.0))) / l1,
        (-k * right + np.sqrt(max(reach * reach - l2 * l2 * right * right, 0.0))) / l1,
    )


@njit(parallel=loops_only(), cache=True, error_model="numpy")
def _fill(tops: Any, row_starts: Any, spans: Any, order: Any, columns: Any, rows: Any, parts: Any) -> Any:
    """The pairs of each tile in `order`; see `Tiles` for what is returned.

    Each part of `order` counts its pairs in every tile and then writes them where the parts before it end: no
    atomics, and the result does not depend on how many parts there are.

    Args:
        tops: (N,) first tile row of each splat.
        row_starts: (N + 1,) entries of splat i in `spans`: one for each tile row, downwards.
        spans: (R, 2) first and one past the last tile column.
        parts: in how many parts the splats are shared out among threads.
    """
    count = len(tops)
    entry_slots = np.zeros(len(spans) + 1, np.int32)
    for entry in range(np.uint64(len(spans))):
        entry_slots[entry + _ONE] = entry_slots[entry] + spans[entry, _RIGHT] - spans[entry, _LEFT]
    slot_starts = np.empty(count + 1, np.int32)
    for i in range(np.uint64(count + 1)):
        slot_starts[i] = entry_slots[np.uint64(row_starts[i])]
    changes = np.zeros((parts, rows, columns + 1), np.int32)
    for part in prange(parts):
        some = order[part * len(order) // parts : (part + 1) * len(order) // parts]
        _count_pairs(some, tops, row_starts, spans, np.uint64(columns + 1), changes[part].reshape(-1))
    starts, places = _first_places(changes, columns, rows, parts)
    splats = np.empty(starts[-1], np.int32)
    slots = np.empty(starts[-1], np.int32)
    for part in prange(parts):
        some = order[part * len(order) // parts : (part + 1) * len(order) // parts]
        _put_pairs(some, tops, row_starts, spans, np.uint64(columns), places[part], entry_slots, splats, slots)
    return starts, splats, slots, slot_starts


@njit(error_model="numpy", _nrt=False)
def _count_pairs(order: Any, tops: Any, row_starts: Any, spans: Any, stride: Any, changes: Any) -> None:
    """Adds to `changes` (rows · stride,) by how much the number of pairs changes from a tile to its right neighbour."""
    for n in range(np.uint64(len(order))):
        i = np.uint64(order[n])
        row = np.uint64(tops[i]) * stride
        for entry in range(np.uint64(row_starts[i]), np.uint64(row_starts[i + _ONE])):
            changes[row + np.uint64(spans[entry, _LEFT])] += np.int32(1)
            changes[row + np.uint64(spans[entry, _RIGHT])] -= np.int32(1)
            row += stride


@njit(error_model="numpy")
def _first_places(changes: Any, columns: Any, rows: Any, parts: Any) -> Any:
    """Where each tile's pairs begin (columns · rows + 1,), and in them each part's (parts, columns · rows)."""
    starts = np.empty(columns * rows + 1, np.int32)
    places = np.empty((parts, columns * rows), np.int32)
    counts = np.zeros(parts, np.int32)
    total = np.int32(0)
    for tile in range(columns * rows):
        row, column = tile // columns, tile % columns
        if column == 0:
            counts[:] = 0
        starts[tile] = total
        for part in range(parts):
            counts[part] += changes[part, row, column]
            places[part, tile] = total
            total += counts[part]
    starts[columns * rows] = total
    return starts, places


@njit(error_model="numpy", _nrt=False)
def _put_pairs(
    order: Any, tops: Any, row_starts: Any, spans: Any, columns: Any, places: Any, entry_slots: Any, splats: Any,
    slots: Any,
) -> None:  # fmt: skip
    """Writes the pairs of some splats, in order; `places` moves on."""
    for n in range(np.uint64(len(order))):
        i = np.uint64(order[n])
        row = np.uint64(tops[i]) * columns
        for entry in range(np.uint64(row_starts[i]), np.uint64(row_starts[i + _ONE])):
            slot = entry_slots[entry]
            for tile in range(row + np.uint64(spans[entry, _LEFT]), row + np.uint64(spans[entry, _RIGHT])):
                to = np.uint64(places[tile])
                places[tile] += np.int32(1)
                splats[to] = np.int32(i)
                slots[to] = slot
                slot += np.int32(1)
            row += columns
