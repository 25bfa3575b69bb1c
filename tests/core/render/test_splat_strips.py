"""Which rows of a tile a splat is drawn in: all that its ellipse reaches within the tile's columns, and no others."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.render.kernels.cpu import splat_raster
from insideout.core.render.kernels.cpu.splat_raster import (
    ATTRIBUTES,
    BATCH,
    CENTER_X,
    CENTER_Y,
    DEEP,
    HEIGHT,
    L1,
    L2,
    LEAN,
    REACH,
    SLOPE,
    K,
)
from insideout.core.render.kernels.cpu.tiles import TILE
from insideout.core.render.kernels.cpu.vectors import aligned

X0, Y0 = 320, 160
MARGIN = 1e-3
"""Standard deviations by which a row may be drawn or left out against the rule, for rounding."""


def ellipses(count, longest, seed):
    """Table and (centres, factors, reaches) of splats around the tile at (X0, Y0), up to `longest` pixels long."""
    rng = np.random.default_rng(seed)
    axes = np.exp(rng.uniform(np.log(0.55), np.log(longest), (count, 2)))
    angle = rng.uniform(0, np.pi, count)
    turn = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], -1).reshape(-1, 2, 2)
    covariance = np.einsum("nij,nj,nkj->nik", turn, axes**2, turn)
    # Upper triangular, as the projection has it: p = l1 x + k y, q = l2 y.
    yy, xy = covariance[:, 1, 1], covariance[:, 0, 1]
    l1 = np.sqrt(yy / np.linalg.det(covariance))
    k, l2 = -l1 * xy / yy, 1 / np.sqrt(yy)
    reach = rng.uniform(0.3, 3.3, count)
    spread = 0.7 * reach * axes.max(axis=1) + TILE
    centers = np.array([X0, Y0]) + 0.5 * TILE + rng.uniform(-1, 1, (count, 2)) * spread[:, None]
    table = aligned(count * ATTRIBUTES).reshape(count, ATTRIBUTES)
    table[:] = 0
    table.view(np.float64)[:, [CENTER_X, CENTER_Y]] = centers
    deep = 1 / np.hypot(k, l2)
    columns = (L1, K, L2, REACH, SLOPE, DEEP, LEAN)
    table[:, columns] = np.stack([l1, k, l2, reach, -l1 * k * deep**2, deep, -k * reach / (l1 * l2)], -1)
    return table, centers, np.stack([l1, k, l2], -1), reach


def nearest(centers, factors):
    """(N, TILE) the smallest distance in standard deviations that a row's stretch between its end pixels has."""
    (l1, k, l2), (x, y) = factors.T[:, :, None], centers.T[:, :, None]
    dy = Y0 + 0.5 + np.arange(TILE) - y
    left, right = X0 + 0.5 - x, X0 + TILE - 0.5 - x
    dx = np.clip(-k * dy / l1, left, right)
    return np.hypot(l1 * dx + k * dy, l2 * dy)


def drawn(table):
    """(N, TILE) whether each row is."""
    found = []
    splats, (floats, ints) = np.arange(len(table), dtype=np.int32), splat_raster.empty_block()
    rows = np.arange(TILE)
    for begin in range(0, len(table), BATCH):
        end = min(begin + BATCH, len(table))
        splat_raster.fetch(splats, begin, end, table.view(np.float64), table, X0, Y0, floats, ints)
        top = floats[int(splat_raster.TOP) :][: end - begin, None]
        height = ints[int(HEIGHT) :][: end - begin, None]
        found.append((rows >= top) & (rows < top + height))
    return np.concatenate(found)


@pytest.mark.parametrize("longest", [1.0, 5.0, 50.0, 500.0])
def test_rows_are_drawn_where_the_ellipse_reaches_into_the_tile(longest):
    table, centers, factors, reach = ellipses(2000, longest, seed=3)
    distance, found = nearest(centers, factors), drawn(table)
    inside, outside = distance < reach[:, None] - MARGIN, distance > reach[:, None] + MARGIN
    assert inside.any()
    assert outside.any()
    assert found[inside].all()
    assert not found[outside].any()


def test_a_splat_beside_the_tile_has_no_rows():
    table, *_ = ellipses(200, 2.0, seed=4)
    table.view(np.float64)[:, CENTER_X] = X0 - 40.0
    assert not drawn(table).any()
