"""Sparse equations of sightings of points, whose points are eliminated first, each by itself (Schur's complement)."""

from __future__ import annotations

import numpy as np
from scipy import sparse


def in_places(blocks: np.ndarray, column: np.ndarray, columns: int) -> sparse.csr_array:
    """(2 E, K · columns) of blocks (E, 2, K), each in its own place of the columns; nothing of those in a place below
    0."""
    known = np.flatnonzero(column >= 0)
    count, _, wide = blocks.shape
    rows = np.broadcast_to(np.arange(2 * count).reshape(count, 2, 1), blocks.shape)[known]
    places = np.broadcast_to((wide * column)[:, None, None] + np.arange(wide), blocks.shape)[known]
    shape = 2 * count, wide * columns
    return sparse.csr_array((blocks[known].ravel(), (rows.ravel(), places.ravel())), shape=shape)


def inverse_blocks(matrix: sparse.csr_array) -> sparse.bsr_array:
    """Of a matrix of 3 x 3 blocks on its diagonal."""
    count, whole = matrix.shape[0] // 3, matrix.tocoo()
    blocks = np.zeros((count, 3, 3))
    np.add.at(blocks, (whole.row // 3, whole.row % 3, whole.col % 3), whole.data)
    # A point that is seen from one side alone may lie at any depth.
    blocks += 1e-9 * np.maximum(np.trace(blocks, axis1=1, axis2=2), 1e-12)[:, None, None] * np.eye(3)
    return sparse.bsr_array((np.linalg.inv(blocks), np.arange(count), np.arange(count + 1)), shape=matrix.shape)
