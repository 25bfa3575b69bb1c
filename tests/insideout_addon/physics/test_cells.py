"""Convex cells: they fill the box, meet at common walls, and follow seed and impact."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.errors import SettingError
from insideout.core.gaussians import GaussianSet
from insideout.core.mesh.solids import is_closed, volume_and_centroid
from insideout.insideout_addon.physics.cell_mesh import cell_surface
from insideout.insideout_addon.physics.cells import (
    Wall,
    box_cell,
    cells_between,
    choose_seeds,
    nearest_cell,
    nearest_seed,
    voronoi_cells,
)

BOX = np.array([[-40.0, -30.0, -20.0], [40.0, 30.0, 50.0]])
VOLUME = 80 * 60 * 70


def surface(cell, spacing=5.0):
    return cell_surface(cell, spacing, {k: k for k, wall in enumerate(cell.walls) if wall is not None})


def volume(cell):
    made = surface(cell)
    assert is_closed(made.faces)
    return volume_and_centroid(made.vertices, made.faces)[0]


@pytest.mark.parametrize("seed", range(5))
def test_voronoi_cells_are_closed_and_fill_the_box(seed):
    seeds = np.random.default_rng(seed).uniform(*BOX, (12, 3))
    assert sum(volume(cell) for cell in voronoi_cells(seeds, BOX)) == pytest.approx(VOLUME, rel=1e-9)


def test_a_cell_is_what_is_nearest_to_its_seed():
    rng = np.random.default_rng(1)
    seeds, points = rng.uniform(*BOX, (9, 3)), rng.uniform(*BOX, (2000, 3))
    cells = voronoi_cells(seeds, BOX)
    np.testing.assert_array_equal(nearest_cell(points, cells), nearest_seed(points, seeds))


def test_seeds_on_a_lattice_meet_in_edges_of_four_cells():
    """Where more than three cells meet no sliver may open."""
    axes = np.meshgrid([-20.0, 20.0], [-15.0, 15.0], [-2.5, 32.5], indexing="ij")
    cells = voronoi_cells(np.stack(axes, axis=-1).reshape(-1, 3), BOX)
    assert [volume(cell) for cell in cells] == pytest.approx([VOLUME / 8] * 8, rel=1e-9)


def test_planes_part_a_box():
    planes = [Wall(np.array([0, 0, 1.0]), 10.0), Wall(np.array([0.6, 0.8, 0]), 0.0)]
    cells = cells_between(planes, BOX)
    volumes = sorted(volume(cell) for cell in cells)
    assert volumes == pytest.approx(sorted([VOLUME / 2 * 30 / 70, VOLUME / 2 * 40 / 70] * 2), rel=1e-9)


def test_planes_that_miss_the_box_part_nothing():
    (cell,) = cells_between([Wall(np.array([0, 0, 1.0]), 500.0), Wall(np.array([0, 0, 1.0]), -500.0)], BOX)
    np.testing.assert_array_equal(cell.vertices, box_cell(BOX).vertices)


def test_walls_are_fine_and_their_triangles_lie_on_them():
    (below, _) = cells_between([Wall(np.array([0.6, 0, 0.8]), 7.0)], BOX)
    made = surface(below, 4.0)
    on_wall = made.vertices[made.faces[made.wall != -1]]
    np.testing.assert_allclose(on_wall @ [0.6, 0, 0.8], 7.0, atol=1e-9)
    lengths = np.linalg.norm(on_wall - np.roll(on_wall, 1, axis=1), axis=2)
    assert lengths.max() < 2 * 4.0
    assert np.median(lengths) == pytest.approx(4.0, rel=0.3)


def material():
    """Splats all through the box, ten times as many in its lower half."""
    rng = np.random.default_rng(2)
    points = rng.uniform(*BOX, (6000, 3))
    kept = (points[:, 2] < 15) | (rng.uniform(size=6000) < 0.1)
    return GaussianSet.create(points[kept], 2.0, density=0.02)


def test_seeds_are_where_the_material_is_and_keep_apart():
    seeds = choose_seeds(material(), 40, seed=0)
    assert np.count_nonzero(seeds[:, 2] < 15) > 25
    apart = np.linalg.norm(seeds[:, None] - seeds, axis=2) + 1e9 * np.eye(40)
    assert apart.min() > 3.0


def test_the_same_seed_gives_the_same_places():
    first, again, other = (choose_seeds(material(), 12, seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_pieces_are_smaller_where_it_is_hit():
    impact = np.array([30.0, 20.0, 0.0])
    near = [np.linalg.norm(choose_seeds(material(), 30, 0, hit) - impact, axis=1) < 25 for hit in (None, impact)]
    assert near[1].sum() > 2 * near[0].sum()


@pytest.mark.parametrize(("count", "says"), [(1, "no break"), (100_000, "choose fewer")])
def test_numbers_of_pieces_that_cannot_be_are_told(count, says):
    with pytest.raises(SettingError, match=says):
        choose_seeds(material(), count, 0)
