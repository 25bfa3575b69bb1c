"""Which rows of a tile a splat is drawn in: all that its ellipse reaches within the tile's columns, and no others."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.render.kernels.cpu import splat_raster
from insideout.core.render.kernels.cpu.splat_geometry import pack_view
from insideout.core.render.kernels.cpu.splat_project import project
from insideout.core.render.kernels.cpu.splat_raster import BATCH, CENTER_X, STRIP_ROWS, STRIP_TOP
from insideout.core.render.kernels.cpu.tiles import TILE
from insideout.core.views import Camera

X0, Y0 = 320, 160
LOW_PASS = 0.3
MARGIN = 2.5e-3
"""Standard deviations by which a row may be drawn beyond the rule, for rounding: the kernel allows itself 1e-3."""


def ellipses(count, longest, seed):
    """The kernel's table and (centres, factors, reaches) of splats around the tile at (X0, Y0).

    Seen along z by a camera whose pixels are units, so that what the kernel projects is known without it.
    """
    rng = np.random.default_rng(seed)
    axes = np.exp(rng.uniform(np.log(0.1), np.log(longest), (count, 2)))
    angle, opacities = rng.uniform(0, np.pi, count), rng.uniform(0.006, 1.0, count)
    reach = np.sqrt(2 * np.log(255 * opacities.astype(np.float32).astype(np.float64)))
    spread = 0.7 * reach * axes.max(axis=1) + TILE
    centers = np.array([X0, Y0]) + 0.5 * TILE + rng.uniform(-1, 1, (count, 2)) * spread[:, None]
    quats = np.stack([np.cos(0.5 * angle), np.zeros(count), np.zeros(count), np.sin(0.5 * angle)], -1)
    means = np.concatenate([centers, np.full((count, 1), 5.0)], -1).astype(np.float32)
    scales = np.concatenate([axes, np.full((count, 1), 1e-3)], -1).astype(np.float32)
    camera = Camera(1000, 1000, 1.0, 1.0, 0.0, 0.0, np.eye(4), orthographic=True)
    view, sh = pack_view(camera, np.eye(4)), np.zeros((count, 1, 3), np.float32)
    _, table, drawn, _ = project(means, quats.astype(np.float32), scales, opacities.astype(np.float32), sh, view, 0)
    turn = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], -1).reshape(-1, 2, 2)
    covariance = np.einsum("nij,nj,nkj->nik", turn, axes**2, turn) + LOW_PASS * np.eye(2)
    # Upper triangular: p = l1 x + k y, q = l2 y.
    yy, xy = covariance[:, 1, 1], covariance[:, 0, 1]
    l1, l2 = np.sqrt(yy / np.linalg.det(covariance)), 1 / np.sqrt(yy)
    seen = drawn > 0
    factors = np.stack([l1, -l1 * xy / yy, l2], -1)
    return table[seen], means[seen, :2].astype(np.float64), factors[seen], reach[seen]


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
        splat_raster.fetch(splats, begin, end, table.view(np.float64), table, (X0, Y0, np.float32(0)), floats, ints)
        top = floats[int(STRIP_TOP) :][: end - begin, None]
        height = ints[int(STRIP_ROWS) :][: end - begin, None]
        found.append((rows >= top) & (rows < top + height))
    return np.concatenate(found)


@pytest.mark.parametrize("longest", [1.0, 5.0, 50.0, 500.0])
def test_rows_are_drawn_where_the_ellipse_reaches_into_the_tile(longest):
    table, centers, factors, reach = ellipses(2000, longest, seed=3)
    distance, found = nearest(centers, factors), drawn(table)
    outside = distance > reach[:, None] + MARGIN
    assert outside.any()
    assert found.any()
    assert found[distance < reach[:, None]].all()
    assert not found[outside].any()


def test_a_splat_beside_the_tile_has_no_rows():
    table, *_ = ellipses(200, 2.0, seed=4)
    table.view(np.float64)[:, CENTER_X] = X0 - 40.0
    assert not drawn(table).any()
