"""Which splats touch which tile, in blending order: the pairs of `kernels.cpu.tiles`, a thread a splat, then sorted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch import Tensor

from ....errors import SettingError
from .blocks import TILE, launch_threads, view
from .rotations import ZERO

_HALF, _ONE_LESS = wp.constant(wp.float64(0.5)), wp.constant(wp.float64(TILE - 1))

MOST_PAIRS = 2**31 - 1
"""They are numbered in int32."""


@dataclass(frozen=True)
class Tiles:
    """The P (splat, tile) pairs of an image cut into tiles, row by row.

    Attributes:
        count: number of tiles.
        starts: (count + 1,) int32; the pairs of tile t are starts[t] : starts[t + 1].
        splats: (P,) int32 splat of each pair; within a tile in the order that the splats were given in.
        slots: (P,) int32 row of each pair in a table that has all pairs of one splat together, tile by tile. A
            tile's gradient for one splat goes there, so nothing is added up in an order that chance decides.
        slot_starts: (N + 1,) int64; the slots of the splat in place i of that order are
            slot_starts[i] : slot_starts[i + 1].
    """

    count: int
    starts: Tensor
    splats: Tensor
    slots: Tensor
    slot_starts: Tensor


def bin_ellipses(centers: Tensor, factors: Tensor, reach: Tensor, order: Tensor, width: int, height: int) -> Tiles:
    """Tiles that hold a point of the ellipses ‖B (p − center)‖ ≤ reach, p anywhere in a tile's pixel centres.

    Args:
        centers: (N, 2) float64 pixels.
        factors: (N, 3) float64 l1, k, l2 of B = [[l1, k], [0, l2]].
        reach: (N,) float64 standard deviations; of splats with ≤ 0, which are left out, nothing else is read.
        order: (N,) int64 splats, nearest first.
    """
    ellipses = [view(centers, wp.vec2d), view(factors, wp.vec3d), view(reach), view(order)]
    inputs = [*ellipses, float(width), float(height)]
    return _sorted_pairs(_count_ellipses, _list_ellipses, inputs, reach, width, height)


def bin_boxes(boxes: Tensor, width: int, height: int) -> Tiles:
    """Tiles that boxes (N, 4) int32 of pixels meet: first and one past the last column, the same of the row."""
    return _sorted_pairs(_count_boxes, _list_boxes, [view(boxes, wp.vec4i)], boxes, width, height)


def _tiles_across(size: int) -> int:
    return (size + TILE - 1) // TILE


def _sorted_pairs(count: Any, enlist: Any, inputs: Sequence[Any], splats: Tensor, width: int, height: int) -> Tiles:
    """Runs a kernel that counts each splat's tiles and one that lists them, and sorts the list by tile.

    Raises:
        SettingError: there are more than `MOST_PAIRS`.
    """
    device, across = splats.device, _tiles_across(width)
    number = across * _tiles_across(height)
    counts = torch.zeros(len(splats) + 1, dtype=torch.int32, device=device)
    launch_threads(count, len(splats), [*inputs, view(counts)], device)
    slot_starts = counts.cumsum(0)
    # The one wait for a card: how many there are, it alone knows.
    pairs = int(slot_starts[-1])
    if pairs > MOST_PAIRS:
        raise SettingError(
            "Splats meet {pairs} tiles of an image, more than the kernel '{kernel}' can list; use smaller images, or "
            "fewer and smaller splats.",
            kernel="cuda",
            pairs=pairs,
        )
    tiles = torch.empty(pairs, dtype=torch.int32, device=device)
    owners = torch.empty_like(tiles)
    launch_threads(enlist, len(splats), [*inputs, across, view(slot_starts), view(tiles), view(owners)], device)
    tiles, slots = torch.sort(tiles, stable=True)
    edges = torch.arange(number + 1, dtype=torch.int32, device=device)
    starts = torch.searchsorted(tiles, edges, out_int32=True)
    return Tiles(number, starts, owners[slots], slots.int(), slot_starts)


@wp.func
def _tile_range(low: wp.float64, high: wp.float64, size: wp.float64) -> wp.vec2i:
    """First and one past the last tile with a pixel centre in low..high, within 0..size pixels; NaN gives none."""
    first, last = wp.max(wp.ceil(low - _HALF), ZERO), wp.min(wp.floor(high - _HALF), size - wp.float64(1.0))
    found = wp.vec2i(0, 0)
    if low <= high and first <= last:
        found = wp.vec2i(int(first) // TILE, int(last) // TILE + 1)
    return found


@wp.func
def _ellipse_rows(center: wp.vec2d, factor: wp.vec3d, reach: wp.float64, height: wp.float64) -> wp.vec2i:
    """The rows of tiles that an ellipse reaches."""
    found = wp.vec2i(0, 0)
    if reach > ZERO:
        half = reach / factor[2]
        found = _tile_range(center[1] - half, center[1] + half, height)
    return found


@wp.func
def _ellipse_run(center: wp.vec2d, factor: wp.vec3d, reach: wp.float64, row: int, width: wp.float64) -> wp.vec2i:
    """The tiles of one row of tiles that an ellipse reaches: being convex, it touches one run of them."""
    l1, k, l2 = factor[0], factor[1], factor[2]
    top = reach / l2
    y = wp.float64(TILE * row) + _HALF - center[1]
    low, high = wp.max(y, -top), wp.min(y + _ONE_LESS, top)
    # The y of the ellipse's rightmost point, Σxy·reach / √Σxx; the leftmost is opposite.
    farthest = -k / l2 * reach / wp.sqrt(l2 * l2 + k * k)
    right, left = wp.min(wp.max(farthest, low), high), wp.min(wp.max(-farthest, low), high)
    square = reach * reach
    back = wp.sqrt(wp.max(square - l2 * left * l2 * left, ZERO))
    forth = wp.sqrt(wp.max(square - l2 * right * l2 * right, ZERO))
    return _tile_range(center[0] + (-k * left - back) / l1, center[0] + (-k * right + forth) / l1, width)


@wp.kernel(enable_backward=False)
def _count_ellipses(
    centers: wp.array(dtype=wp.vec2d),
    factors: wp.array(dtype=wp.vec3d),
    reach: wp.array(dtype=wp.float64),
    order: wp.array(dtype=wp.int64),
    width: wp.float64,
    height: wp.float64,
    counts: wp.array(dtype=wp.int32),
):
    place = wp.tid()
    i = int(order[place])
    rows = _ellipse_rows(centers[i], factors[i], reach[i], height)
    total = wp.int32(0)
    for row in range(rows[0], rows[1]):
        run = _ellipse_run(centers[i], factors[i], reach[i], row, width)
        total += run[1] - run[0]
    counts[place + 1] = total


@wp.kernel(enable_backward=False)
def _list_ellipses(
    centers: wp.array(dtype=wp.vec2d),
    factors: wp.array(dtype=wp.vec3d),
    reach: wp.array(dtype=wp.float64),
    order: wp.array(dtype=wp.int64),
    width: wp.float64,
    height: wp.float64,
    across: int,
    slot_starts: wp.array(dtype=wp.int64),
    tiles: wp.array(dtype=wp.int32),
    owners: wp.array(dtype=wp.int32),
):
    place = wp.tid()
    i = int(order[place])
    rows = _ellipse_rows(centers[i], factors[i], reach[i], height)
    slot = int(slot_starts[place])
    for row in range(rows[0], rows[1]):
        run = _ellipse_run(centers[i], factors[i], reach[i], row, width)
        for column in range(run[0], run[1]):
            tiles[slot] = row * across + column
            owners[slot] = i
            slot += 1


@wp.func
def _tiles_of_box(box: wp.vec4i) -> wp.vec4i:
    """First and one past the last column of tiles, the same of rows."""
    found = wp.vec4i(0, 0, 0, 0)
    if box[0] < box[1] and box[2] < box[3]:
        found = wp.vec4i(box[0] // TILE, (box[1] + TILE - 1) // TILE, box[2] // TILE, (box[3] + TILE - 1) // TILE)
    return found


@wp.kernel(enable_backward=False)
def _count_boxes(boxes: wp.array(dtype=wp.vec4i), counts: wp.array(dtype=wp.int32)):
    i = wp.tid()
    found = _tiles_of_box(boxes[i])
    counts[i + 1] = (found[1] - found[0]) * (found[3] - found[2])


@wp.kernel(enable_backward=False)
def _list_boxes(
    boxes: wp.array(dtype=wp.vec4i),
    across: int,
    slot_starts: wp.array(dtype=wp.int64),
    tiles: wp.array(dtype=wp.int32),
    owners: wp.array(dtype=wp.int32),
):
    i = wp.tid()
    found = _tiles_of_box(boxes[i])
    slot = int(slot_starts[i])
    for row in range(found[2], found[3]):
        for column in range(found[0], found[1]):
            tiles[slot] = row * across + column
            owners[slot] = i
            slot += 1
