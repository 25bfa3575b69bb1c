"""Splats that a wall cuts: they are in the pieces on both sides, each time without what lies beyond. Numpy alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...core.gaussians import GaussianSet
from ..scene.cut_slots import SLOTS
from .cells import Cell, Wall

REACH_SIGMAS = 3.0


@dataclass(frozen=True, eq=False)
class CellSplats:
    """M splats that are seen in a cell, each with the walls that cut it.

    Attributes:
        index: (M,) numbers of the model's splats.
        own: (M,) bool, the cell holds the centre; the others only reach into it.
        normals: (M, SLOTS, 3) unit, out of the cell; 0 where a slot is not used.
        heights: (M, SLOTS) mm from the centre to the wall along its normal, negative where the centre is beyond.
    """

    index: np.ndarray
    own: np.ndarray
    normals: np.ndarray
    heights: np.ndarray


def splats_of_cell(
    cell: Cell, number: int, cell_of_splat: np.ndarray, gaussians: GaussianSet, covariances: np.ndarray
) -> CellSplats:
    """Which splats are seen in a cell, and how its walls cut them.

    Args:
        number: the cell's own.
        cell_of_splat: (N,) number of the cell that each centre is in.
        covariances: (N, 3, 3) mm², of `gaussians`.
    """
    walls = [wall for wall in cell.walls if wall is not None]
    within = np.ones(len(gaussians), bool)
    reach = REACH_SIGMAS * gaussians.scales.max(axis=1)
    for wall in walls:
        within &= wall.heights(gaussians.means) <= reach
    index = np.flatnonzero(within | (cell_of_splat == number))
    own = cell_of_splat[index] == number
    beyond, sigmas = _across(walls, gaussians.means[index].astype(np.float64), covariances[index])
    depth = beyond / np.maximum(sigmas, 1e-12)
    seen = own | (depth <= REACH_SIGMAS).all(axis=1)
    index, own, beyond, depth = index[seen], own[seen], beyond[seen], depth[seen]
    normals, heights = np.zeros((len(index), SLOTS, 3)), np.zeros((len(index), SLOTS))
    nearest = np.argsort(-depth, axis=1, kind="stable")[:, :SLOTS]
    for slot in range(nearest.shape[1]):
        which = nearest[:, slot]
        rows = np.flatnonzero(depth[np.arange(len(index)), which] >= -REACH_SIGMAS)
        normals[rows, slot] = np.array([wall.normal for wall in walls])[which[rows]]
        heights[rows, slot] = -beyond[rows, which[rows]]
    return CellSplats(index, own, normals, heights)


def _across(walls: Sequence[Wall], means: np.ndarray, covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(M, W) how far each centre is beyond each wall, and the splat's standard deviation that way, mm."""
    if not walls:
        return np.zeros((len(means), 0)), np.zeros((len(means), 0))
    beyond = np.stack([wall.heights(means) for wall in walls], axis=1)
    normals = np.array([wall.normal for wall in walls])
    variance = np.einsum("wi,nij,wj->nw", normals, covariances.astype(np.float64), normals, optimize=True)
    return beyond, np.sqrt(np.maximum(variance, 0.0))
