"""Splats at a wall: in the pieces on both sides, each with the plane that cuts it there."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.gaussians import GaussianSet
from insideout.insideout_addon.physics.cells import Wall, cells_between, nearest_cell
from insideout.insideout_addon.physics.splat_cuts import REACH_SIGMAS, splats_of_cell

BOX = np.array([[-50.0] * 3, [50.0] * 3])
CELLS = cells_between([Wall(np.array([0, 0, 1.0]), 5.0)], BOX)


def seen_in(cell, gaussians, cells=CELLS):
    of = nearest_cell(gaussians.means, cells)
    return splats_of_cell(cells[cell], cell, of, gaussians, gaussians.covariances())


def test_only_splats_that_reach_across_are_on_both_sides():
    heights = np.array([-20.0, 5 - 2.9, 5 + 2.9, 5 + 3.1, 40.0])
    splats = GaussianSet.create(np.stack([0 * heights, 0 * heights, heights], axis=1), 1.0)
    below, above = (seen_in(cell, splats) for cell in range(2))
    assert below.index.tolist() == [0, 1, 2]
    assert below.own.tolist() == [True, True, False]
    assert above.index.tolist() == [1, 2, 3, 4]
    assert above.own.tolist() == [False, True, True, True]


def test_a_cut_is_the_wall_seen_from_the_centre():
    splats = GaussianSet.create([[1.0, 2.0, 3.0]], 1.0)
    for cell, up in ((0, 1.0), (1, -1.0)):
        seen = seen_in(cell, splats)
        np.testing.assert_allclose(seen.normals[0], [[0, 0, up], *[[0, 0, 0]] * 5])
        # The hidden side begins so far along the normal.
        np.testing.assert_allclose(seen.heights[0], [2 * up, *[0] * 5], atol=1e-6)


def test_how_far_a_splat_reaches_depends_on_where_it_points():
    """A needle lying along the wall does not reach it, the same one standing up does."""
    half = np.sqrt(0.5)
    needle = {"means": [[0, 0, 0]], "scales": [[4.0, 0.1, 0.1]]}
    assert len(seen_in(1, GaussianSet.create(**needle)).index) == 0
    assert len(seen_in(1, GaussianSet.create(**needle, quats=np.array([[half, 0, half, 0]]))).index) == 1


def test_a_splat_in_a_corner_has_a_slot_for_each_wall():
    planes = [Wall(np.eye(3)[axis], 0.0) for axis in range(3)]
    cells = cells_between(planes, BOX)
    splats = GaussianSet.create([[-0.5, -1.0, -1.5]], 1.0)
    own = int(nearest_cell(splats.means, cells)[0])
    seen = seen_in(own, splats, cells)
    used = np.linalg.norm(seen.normals[0], axis=1) > 0
    # The nearest wall is in the first.
    np.testing.assert_allclose(seen.heights[0][used], [0.5, 1.0, 1.5], atol=1e-6)
    np.testing.assert_allclose(seen.normals[0][used], np.eye(3), atol=1e-12)
    assert sum(len(seen_in(cell, splats, cells).index) for cell in range(8)) == 8


def test_more_walls_than_slots_leave_out_the_farthest():
    turns = 2 * np.pi * np.arange(9) / 9
    planes = [Wall(np.array([np.cos(a), np.sin(a), 0]), 1.0 + 0.1 * k) for k, a in enumerate(turns)]
    cells = cells_between(planes, BOX)
    splats = GaussianSet.create([[0.0, 0.0, 0.0]], 1.0)
    own = int(nearest_cell(splats.means, cells)[0])
    seen = seen_in(own, splats, cells)
    assert sorted(seen.heights[0]) == pytest.approx([1.0 + 0.1 * k for k in range(6)], abs=1e-6)
    assert (seen.heights[0] < REACH_SIGMAS).all()
