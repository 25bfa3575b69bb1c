"""Binning into tiles, the depth sort and the exponential that the Numba kernels rest on."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit

from insideout.core.errors import SettingError
from insideout.core.render.kernels.cpu.math import FAST, exp_negative
from insideout.core.render.kernels.cpu.tiles import TILE, bin_ellipses, depth_order

WIDTH, HEIGHT = 83, 50


@pytest.fixture
def ellipses() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """300 ellipses, some needles, some outside the image, some with no reach: centres, factors, reach."""
    rng = np.random.default_rng(0)
    centers = rng.uniform(-20, [WIDTH + 20, HEIGHT + 20], (300, 2))
    spread = rng.normal(size=(300, 2, 2)) * np.exp(rng.normal(size=(300, 1, 2)) * 2)
    cov = spread @ spread.transpose(0, 2, 1) + 0.3 * np.eye(2)
    inverse = np.linalg.inv(cov)
    l1 = np.sqrt(inverse[:, 0, 0])
    factors = np.stack([l1, inverse[:, 0, 1] / l1, cov[:, 1, 1] ** -0.5], axis=1)
    return centers, factors.astype(np.float32), rng.uniform(-0.5, 3, 300).astype(np.float32)


def test_every_tile_lists_all_splats_with_a_pixel_in_it_in_order(ellipses) -> None:
    centers, factors, reach = ellipses
    order = np.random.default_rng(1).permutation(300).astype(np.int32)
    tiles = bin_ellipses(centers, factors, reach, order, WIDTH, HEIGHT)
    assert (tiles.columns, tiles.rows) == (6, 4)
    rank = np.argsort(order)
    ys, xs = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    wanted = spare = 0
    for tile in range(tiles.columns * tiles.rows):
        listed = tiles.splats[tiles.starts[tile] : tiles.starts[tile + 1]]
        assert (np.diff(rank[listed]) > 0).all()
        x, y = tile % tiles.columns * TILE, tile // tiles.columns * TILE
        dx = xs[y : y + TILE, x : x + TILE] - centers[:, 0, None, None]
        dy = ys[y : y + TILE, x : x + TILE] - centers[:, 1, None, None]
        l1, k, l2 = factors.astype(np.float64).T[:, :, None, None]
        squared = (l1 * dx + k * dy) ** 2 + (l2 * dy) ** 2
        touching = (reach > 0) & (squared <= np.maximum(reach, 0)[:, None, None] ** 2).any((1, 2))
        assert set(np.flatnonzero(touching)) <= set(listed)
        wanted += int(touching.sum())
        spare += len(listed) - int(touching.sum())
    assert spare < 0.1 * wanted


def test_slots_keep_the_pairs_of_a_splat_together(ellipses) -> None:
    centers, factors, reach = ellipses
    tiles = bin_ellipses(centers, factors, reach, np.arange(300, dtype=np.int32), WIDTH, HEIGHT)
    assert sorted(tiles.slots) == list(range(len(tiles.splats)))
    owner = np.repeat(np.arange(300), np.diff(tiles.slot_starts))
    np.testing.assert_array_equal(owner[tiles.slots], tiles.splats)


def test_no_splats_make_empty_tiles() -> None:
    none = np.zeros(0, np.int32)
    tiles = bin_ellipses(np.zeros((0, 2)), np.zeros((0, 3), np.float32), np.zeros(0, np.float32), none, WIDTH, HEIGHT)
    assert not tiles.starts.any()
    assert len(tiles.splats) == 0


def test_more_pairs_than_can_be_counted_are_refused() -> None:
    """One image of 4096 x 4096 tiles, all of them under each of 129 splats."""
    side = 4096 * TILE
    factors = np.full((129, 3), 1e-6, np.float32)
    factors[:, 1] = 0.0
    order, reach = np.arange(129, dtype=np.int32), np.full(129, 3.0, np.float32)
    with pytest.raises(SettingError, match="more than the kernel 'cpu' can list"):
        bin_ellipses(np.full((129, 2), side / 2.0), factors, reach, order, side, side)


def test_depth_order_is_a_stable_sort_of_what_is_drawn() -> None:
    rng = np.random.default_rng(2)
    depth = rng.normal(size=5000).astype(np.float32)
    depth[::5] = depth[0]
    drawn = rng.random(5000) < 0.7
    rows = np.flatnonzero(drawn)
    expected = rows[np.argsort(depth[rows], kind="stable")]
    np.testing.assert_array_equal(depth_order(depth, drawn), expected)


def test_exp_negative_is_exp() -> None:
    x = np.linspace(-86, 0, 20001).astype(np.float32)
    truth = np.exp(x.astype(np.float64))
    error = np.abs(_map(x) / truth - 1)
    assert (error < 3e-7 * (1 - x)).all()
    assert _map(np.zeros(1, np.float32))[0] == 1.0


def test_exp_negative_far_out_is_next_to_nothing() -> None:
    found = _map(np.array([-100.0, -1e10, -np.inf], np.float32))
    assert (found >= 0).all()
    assert (found < 2e-38).all()


@njit(fastmath=FAST)
def _map(x):
    y = np.empty_like(x)
    for i in range(len(x)):
        y[i] = exp_negative(x[i])
    return y
