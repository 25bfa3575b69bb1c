"""From the sums of (splat, tile) pairs to those of splats, always in the same order: the same bits every time."""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch import Tensor

from .blocks import launch_threads, view


@wp.kernel(enable_backward=False)
def _add_up(
    slot_starts: wp.array(dtype=wp.int64), sums: wp.array2d(dtype=wp.float32), totals: wp.array2d(dtype=wp.float64)
):
    thread = wp.tid()
    columns = sums.shape[1]
    splat = thread // columns
    column = thread % columns
    total = wp.float64(0.0)
    for slot in range(wp.int32(slot_starts[splat]), wp.int32(slot_starts[splat + 1])):
        total += wp.float64(sums[slot, column])
    totals[splat, column] = total


def add_up(slot_starts: Tensor, sums: Tensor) -> Any:
    """(N, columns) float64 totals of the rows of `sums` (P, columns) float32 that belong to each of N splats."""
    totals = sums.new_zeros(len(slot_starts) - 1, sums.shape[1], dtype=torch.float64)
    launch_threads(_add_up, totals.numel(), [view(slot_starts), view(sums), view(totals)], sums.device)
    return totals
