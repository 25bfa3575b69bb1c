"""Which splats touch which tile, in blending order: the pairs of `kernels.cpu.tiles` by sorting, in torch."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from .blocks import TILE


@dataclass(frozen=True)
class Tiles:
    """The P (splat, tile) pairs of an image cut into tiles, row by row.

    Attributes:
        count: number of tiles.
        starts: (count + 1,) int32; the pairs of tile t are starts[t] : starts[t + 1].
        splats: (P,) int32 splat of each pair; within a tile in rising order.
        slots: (P,) int32 row of each pair in a table that has all pairs of one splat together, tile by tile. A
            tile's gradient for one splat goes there, so nothing is added up in an order that chance decides.
        slot_starts: (N + 1,) int64; the slots of splat i are slot_starts[i] : slot_starts[i + 1].
    """

    count: int
    starts: Tensor
    splats: Tensor
    slots: Tensor
    slot_starts: Tensor


def bin_ellipses(centers: Tensor, factors: Tensor, reach: Tensor, width: int, height: int) -> Tiles:
    """Tiles that hold a point of the ellipses ‖B (p − center)‖ ≤ reach, p anywhere in a tile's pixel centres.

    Args:
        centers: (N, 2) float64 pixels, the splats nearest first.
        factors: (N, 3) float64 l1, k, l2 of B = [[l1, k], [0, l2]].
        reach: (N,) float64 standard deviations; ≤ 0 leaves a splat out.
    """
    half = reach / factors[:, 2]
    top, bottom = _tile_range(centers[:, 1] - half, centers[:, 1] + half, height)
    bottom = torch.where(reach > 0, bottom, top)
    # One entry for each row of tiles that a splat reaches; an ellipse is convex, so it touches one run of columns.
    splat, row = _expand(bottom - top)
    row += top[splat]
    y = TILE * row + 0.5 - centers[splat, 1]
    left, right = _ellipse_run(factors[splat], reach[splat], y, y + (TILE - 1))
    first, last = _tile_range(centers[splat, 0] + left, centers[splat, 0] + right, width)
    entry, column = _expand(last - first)
    tile = row[entry] * _tiles_across(width) + first[entry] + column
    return _sorted_pairs(splat[entry], tile, len(centers), width, height)


def bin_boxes(boxes: Tensor, width: int, height: int) -> Tiles:
    """Tiles that boxes (N, 4) int64 of pixels meet: first and one past the last column, the same of the row."""
    empty = (boxes[:, 0] >= boxes[:, 1]) | (boxes[:, 2] >= boxes[:, 3])
    first, top = boxes[:, 0] // TILE, boxes[:, 2] // TILE
    across = (boxes[:, 1] + TILE - 1) // TILE - first
    down = (boxes[:, 3] + TILE - 1) // TILE - top
    splat, place = _expand(torch.where(empty, 0, across * down))
    row, column = top[splat] + place // across[splat], first[splat] + place % across[splat]
    return _sorted_pairs(splat, row * _tiles_across(width) + column, len(boxes), width, height)


def _tiles_across(size: int) -> int:
    return (size + TILE - 1) // TILE


def _tile_range(low: Tensor, high: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """First and one past the last tile with a pixel centre in low..high, within 0..size pixels; NaN gives none."""
    first = torch.ceil(low - 0.5).clamp_min(0.0)
    last = torch.floor(high - 0.5).clamp_max(size - 1.0)
    some = (low <= high) & (first <= last)
    first, last = torch.where(some, first, 0.0), torch.where(some, last, -1.0)
    return first.long() // TILE, torch.div(last.long(), TILE, rounding_mode="floor") + 1


def _ellipse_run(factors: Tensor, reach: Tensor, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Smallest and largest x of the ellipses ‖B (x, y)‖ ≤ reach with y in low..high."""
    l1, k, l2 = factors.unbind(1)
    top = reach / l2
    low, high = torch.maximum(low, -top), torch.minimum(high, top)
    # The y of the ellipse's rightmost point, Σxy·reach / √Σxx; the leftmost is opposite.
    y = -k / l2 * reach / torch.hypot(l2, k)
    right = torch.minimum(torch.maximum(y, low), high)
    left = torch.minimum(torch.maximum(-y, low), high)
    square = reach * reach
    return (
        (-k * left - (square - (l2 * left) ** 2).clamp_min(0).sqrt()) / l1,
        (-k * right + (square - (l2 * right) ** 2).clamp_min(0).sqrt()) / l1,
    )


def _expand(counts: Tensor) -> tuple[Tensor, Tensor]:
    """For counts (N,): the owner of each of Σ counts things, and its number among its owner's."""
    owner = torch.repeat_interleave(counts)
    starts = counts.cumsum(0) - counts
    return owner, torch.arange(len(owner), device=counts.device) - starts[owner]


def _sorted_pairs(splats: Tensor, tiles: Tensor, count: int, width: int, height: int) -> Tiles:
    """From pairs (P,) in the order of their splats."""
    number = _tiles_across(width) * _tiles_across(height)
    tiles, slots = torch.sort(tiles.int(), stable=True)
    edges = torch.arange(number + 1, dtype=torch.int32, device=tiles.device)
    starts = torch.searchsorted(tiles, edges, out_int32=True)
    owners = torch.arange(count + 1, device=tiles.device)
    slot_starts = torch.searchsorted(splats, owners)
    return Tiles(number, starts, splats[slots].int(), slots.int(), slot_starts)
