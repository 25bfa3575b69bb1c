"""Multiresolution hash encoding of points (Müller et al. 2022, arXiv 2201.05989), as NAF uses it. CPU alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..compiled import njit, prange
from ..threads import Alone, loops_only

# Points a task encodes, and fewer than are encoded before other threads are awake.
_CHUNK = 4096
_FEW = 1000


@dataclass(frozen=True)
class HashGrid:
    """Where the features of all levels lie in one table (rows, 2).

    A level divides the unit cube into cells and holds a row of features for each of their corners, or, where there
    are more corners than `2**log2_entries`, that many rows which corners share by a hash.

    Attributes:
        features: numbers a row; two, as everywhere.
        levels: their number.
        base: cells a side of the coarsest level.
        growth: by which factor cells a side grow from level to level; NAF doubles them.
        log2_entries: of the most rows a level has.
    """

    features: ClassVar[int] = 2
    levels: int = 16
    base: int = 16
    growth: float = 2.0
    log2_entries: int = 19

    def resolutions(self) -> np.ndarray:
        """(levels,) int64 cells a side."""
        return np.floor(self.base * self.growth ** np.arange(self.levels) + 1e-9).astype(np.int64)

    def starts(self) -> np.ndarray:
        """(levels + 1,) int64 first row of each level, and their number."""
        rows = np.minimum((self.resolutions() + 1) ** 3, 2**self.log2_entries)
        return np.concatenate([[0], np.cumsum(rows)]).astype(np.int64)

    @property
    def rows(self) -> int:
        """Rows of the table."""
        return int(self.starts()[-1])

    @property
    def width(self) -> int:
        """Features of a point, all levels together."""
        return self.levels * self.features

    def encode(self, points: Tensor, table: Tensor) -> Tensor:
        """Features of points: trilinear between the corners of their cell, level after level.

        Args:
            points: (P, 3) in 0..1; further out they count as on the border. They get no gradient.
            table: (rows, 2), float32 or float64 as the points.

        Returns:
            (P, width).
        """
        return _Encode.apply(points, table, self.starts(), self.resolutions())


class _Encode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points: Tensor, table: Tensor, starts: np.ndarray, resolutions: np.ndarray) -> Tensor:
        ctx.places = np.ascontiguousarray(points.detach().numpy())
        ctx.starts, ctx.resolutions, ctx.shape = starts, resolutions, tuple(table.shape)
        values = table.detach().contiguous().numpy()
        found = np.empty((len(ctx.places), 2 * len(resolutions)), values.dtype)
        with Alone(len(found) < _FEW):
            encode_points(ctx.places, values, starts, resolutions, found)
        return torch.from_numpy(found)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Any:  # type: ignore[override]
        by_features = grad.contiguous().numpy()
        by_table = np.zeros(ctx.shape, by_features.dtype)
        with Alone(len(by_features) < _FEW):
            add_to_table(ctx.places, by_features, ctx.starts, ctx.resolutions, by_table)
        return None, torch.from_numpy(by_table), None, None


@njit(inline="always")
def _cell(value, resolution):  # type: ignore[no-untyped-def]
    """Cell along an axis, and how far into it the value lies."""
    scaled = min(max(value, type(value)(0)), type(value)(1)) * type(value)(resolution)
    low = min(np.int64(scaled), resolution - 1)
    return low, scaled - type(value)(low)


@njit(inline="always")
def _factors(resolution, rows):  # type: ignore[no-untyped-def]
    """Whether all corners of a level have a row of their own, and what y and z are multiplied by for it."""
    side = np.uint64(resolution + 1)
    if side * side * side <= rows:
        return True, side, side * side
    return False, np.uint64(2654435761), np.uint64(805459861)


@njit(inline="always")
def _row(dense, x, y, z, rows):  # type: ignore[no-untyped-def]
    """Row of a corner within its level, of x and of y and z times their factors."""
    # A level with a hash has a power of two of rows; higher bits than those of 32 fall away with the rest.
    return np.int64(x + y + z if dense else (x ^ y ^ z) & (rows - np.uint64(1)))


@njit(parallel=loops_only(), cache=True, error_model="numpy")
def encode_points(points, table, starts, resolutions, found):  # type: ignore[no-untyped-def]
    """Writes the features of points (P, 3) to `found` (P, 2 · levels)."""
    for chunk in prange((len(points) + _CHUNK - 1) // _CHUNK):
        first, last = chunk * _CHUNK, min((chunk + 1) * _CHUNK, len(points))
        for level in range(len(resolutions)):
            start, resolution = starts[level], resolutions[level]
            rows = np.uint64(starts[level + 1] - start)
            dense, of_y, of_z = _factors(resolution, rows)
            for i in range(first, last):
                x, part_x = _cell(points[i, 0], resolution)
                y, part_y = _cell(points[i, 1], resolution)
                z, part_z = _cell(points[i, 2], resolution)
                one, two = part_x * 0, part_x * 0
                for corner in range(8):
                    a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
                    weight = (part_x if a else 1 - part_x) * (part_y if b else 1 - part_y)
                    weight *= part_z if c else 1 - part_z
                    row = start + _row(dense, np.uint64(x + a), np.uint64(y + b) * of_y, np.uint64(z + c) * of_z, rows)
                    one += weight * table[row, 0]
                    two += weight * table[row, 1]
                found[i, 2 * level] = one
                found[i, 2 * level + 1] = two


@njit(parallel=loops_only(), cache=True, error_model="numpy")
def add_to_table(points, by_features, starts, resolutions, by_table):  # type: ignore[no-untyped-def]
    """Adds gradients (P, 2 · levels) to the rows (rows, 2) that they came from.

    Each level is one task's, so that no two write to a row and sums do not depend on the number of threads.
    """
    levels = len(resolutions)
    for task in prange(levels):
        # The fine levels, which miss the cache, are shared out evenly: first the even ones, then the odd ones.
        level = 2 * task if 2 * task < levels else 2 * (task - (levels + 1) // 2) + 1
        start, resolution = starts[level], resolutions[level]
        rows = np.uint64(starts[level + 1] - start)
        dense, of_y, of_z = _factors(resolution, rows)
        for i in range(len(points)):
            x, part_x = _cell(points[i, 0], resolution)
            y, part_y = _cell(points[i, 1], resolution)
            z, part_z = _cell(points[i, 2], resolution)
            one, two = by_features[i, 2 * level], by_features[i, 2 * level + 1]
            for corner in range(8):
                a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
                weight = (part_x if a else 1 - part_x) * (part_y if b else 1 - part_y)
                weight *= part_z if c else 1 - part_z
                row = start + _row(dense, np.uint64(x + a), np.uint64(y + b) * of_y, np.uint64(z + c) * of_z, rows)
                by_table[row, 0] += weight * one
                by_table[row, 1] += weight * two
