"""The cage around a model: what it weighs, how stiff it is, which boxes it is made of."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from insideout.core.errors import SettingError
from insideout.core.gaussians import GaussianSet, Modality
from insideout.insideout_addon.physics.cage import build_cage
from insideout.insideout_addon.physics.cage_cells import chosen_cells, nearest_chosen
from insideout.insideout_addon.physics.masses import splat_masses
from insideout.insideout_addon.scene.following import bent

CUBE = np.array([[-20.0, -20.0, -20.0], [20.0, 20.0, 20.0]])


@pytest.fixture
def cube(shapes):
    """An even cube of 40 mm, its masses."""
    splats = shapes.filling(lambda p: np.abs(p).max(axis=1) < 19.5, 20.0)
    return splats, splat_masses(splats, 50.0)


class TestParts:
    def test_what_does_not_hang_together_has_another_number(self, shapes):
        """Two balls, one above the other."""
        centers = np.array([[0.0, 0, -30], [0, 0, 30]])
        splats = shapes.filling(lambda p: np.linalg.norm(p[:, None] - centers, axis=2).min(axis=1) < 9, 40.0)
        box = np.array([[-10.0, -10, -40], [10, 10, 40]])
        cage = build_cage(splats, splat_masses(splats, 50.0), box, 8, 20.0)
        parts = cage.parts()
        assert set(parts) == {0, 1}
        np.testing.assert_array_equal(parts == parts[0], (cage.vertices[:, 2] < 0) == (cage.vertices[0, 2] < 0))

    def test_one_body_is_one_part(self, cube):
        assert not build_cage(*cube, CUBE, 6, 20.0).parts().any()


class TestMasses:
    def test_together_they_are_the_models(self, cube):
        cage = build_cage(*cube, CUBE, 8, 20.0)
        assert cage.masses.sum() == pytest.approx(cube[1].sum(), rel=1e-9)
        assert cage.masses.min() > 0

    def test_they_balance_where_the_model_does(self, shapes):
        """Its lower half four times as heavy."""
        splats = shapes.filling(lambda p: np.abs(p).max(axis=1) < 19.5, 20.0)
        masses = splat_masses(splats, np.where(splats.means[:, 2] < 0, 200.0, 50.0))
        cage = build_cage(splats, masses, CUBE, 8, 20.0)
        center = masses @ splats.means / masses.sum()
        assert center[2] < -5
        np.testing.assert_allclose(cage.masses @ cage.vertices / cage.masses.sum(), center, atol=0.4)

    def test_a_wide_splat_weighs_on_all_the_boxes_that_it_reaches(self):
        wide = GaussianSet.create([[0.0, 0.0, 0.0]], [[8.0, 2.0, 2.0]], density=1.0, modality=Modality.XRAY)
        small = np.random.default_rng(0).uniform(-20, 20, (500, 3))
        dust = GaussianSet.create(small, 1.0, density=0.05, modality=Modality.XRAY)
        both = GaussianSet.concatenate([wide, dust])
        cage = build_cage(both, np.append(1000.0, np.full(500, 2.0)), CUBE, 8, 20.0)
        heavy = cage.vertices[cage.masses > 10]
        assert np.abs(heavy[:, 0]).max() >= 10
        assert np.abs(heavy[:, 1]).max() <= 5

    def test_splats_without_mass_or_place_count_for_nothing(self, cube):
        splats, masses = cube
        lost = GaussianSet.create(np.full((3, 3), np.nan), 1.0, modality=Modality.XRAY)
        rgb = GaussianSet.create(np.zeros((3, 3)), 1.0)
        more = GaussianSet.concatenate([splats, lost, rgb])
        cage = build_cage(more, np.append(masses, np.zeros(6)), CUBE, 8, 20.0)
        np.testing.assert_allclose(cage.masses, build_cage(splats, masses, CUBE, 8, 20.0).masses)


class TestStiffness:
    @pytest.mark.parametrize("resolution", [7, 10])
    def test_an_even_body_has_the_modulus_that_was_asked_for(self, cube, resolution):
        """E = Σ K·l / 6V: around a vertex within, half of each spring's length belongs to it."""
        cage = build_cage(*cube, CUBE, resolution, 20.0)
        inner = np.flatnonzero(np.abs(cage.vertices).max(axis=1) < 20 - 2.5 * cage.sides.max())
        force, length = cage.spring_stiffness(), cage.spring_lengths()
        for vertex in inner[:: max(1, len(inner) // 5)]:
            mine = (cage.springs == vertex).any(axis=1)
            modulus = 0.5 * (force[mine] * length[mine]).sum() / (6 * np.prod(cage.sides))
            # kPa in a N/mm²; splats on a grid are not quite even.
            assert 1e3 * modulus == pytest.approx(20.0, rel=0.05)

    def test_what_is_twice_as_dense_is_twice_as_stiff(self, cube):
        splats, masses = cube
        heavy = np.where(splats.means[:, 0] > 0, 2.0, 1.0) * masses
        cage = build_cage(splats, heavy, CUBE, 8, 20.0)
        left = cage.stiffness[np.abs(cage.vertices - [-10, 0, 0]).max(axis=1) < 3]
        right = cage.stiffness[np.abs(cage.vertices - [10, 0, 0]).max(axis=1) < 3]
        assert right.mean() / left.mean() == pytest.approx(2.0, rel=0.05)

    def test_a_setting_makes_all_of_it_stiffer(self, cube):
        soft, stiff = (build_cage(*cube, CUBE, 8, kpa) for kpa in (5.0, 50.0))
        np.testing.assert_allclose(stiff.stiffness, 10 * soft.stiffness)

    def test_the_quickest_wobble_is_not_quicker_than_said(self, cube):
        """Against the eigenvalues of the lattice, whose springs pull along themselves."""
        cage = build_cage(*cube, CUBE, 3, 20.0)
        count = len(cage.vertices)
        ends = cage.vertices[cage.springs]
        along = (ends[:, 1] - ends[:, 0]) / cage.spring_lengths()[:, None]
        pull = cage.spring_stiffness() / (1e-3 * cage.spring_lengths())
        matrix = np.zeros((count, 3, count, 3))
        for (a, b), n, k in zip(cage.springs, along, pull, strict=True):
            block = k * np.outer(n, n)
            for i, j, sign in ((a, a, 1), (b, b, 1), (a, b, -1), (b, a, -1)):
                matrix[i, :, j] += sign * block
        weights = np.repeat(1 / np.sqrt(1e-3 * cage.masses), 3)
        scaled = matrix.reshape(3 * count, -1) * weights * weights[:, None]
        quickest = np.sqrt(np.linalg.eigvalsh(scaled)[-1])
        assert quickest <= cage.frequency() <= 3 * quickest


class TestBoxes:
    def test_springs_are_there_once_and_hold_every_vertex(self, cube):
        cage = build_cage(*cube, CUBE, 4, 20.0)
        assert len(np.unique(cage.springs, axis=0)) == len(cage.springs)
        assert (cage.springs[:, 0] < cage.springs[:, 1]).all()
        assert set(cage.springs.ravel()) == set(range(len(cage.vertices)))
        # Edges and diagonals of faces, and twice an edge or a diagonal in space.
        steps = np.abs(np.diff(cage.vertices[cage.springs], axis=1)[:, 0] / cage.sides).round().astype(int)
        assert {tuple(sorted(step)) for step in steps} == {(0, 0, 1), (0, 1, 1), (0, 0, 2), (2, 2, 2)}

    def test_the_grid_ends_where_the_surface_does(self, shapes):
        """A slab: as many boxes along each side as it is long."""
        splats = shapes.filling(lambda p: np.abs(p[:, 2]) < 5, 20.0)
        surface = CUBE * [1.0, 1.0, 0.25]
        cage = build_cage(splats, splat_masses(splats, 50.0), surface, 8, 20.0)
        np.testing.assert_allclose([cage.vertices.min(axis=0), cage.vertices.max(axis=0)], surface, atol=1e-9)
        assert cage.index.shape == (8, 8, 2)

    def test_a_place_in_a_box_is_the_place_again(self, cube):
        cage = build_cage(*cube, CUBE, 5, 20.0)
        points = np.random.default_rng(1).uniform(-23, 23, (300, 3))
        boxes, places = cage.locate(points)
        assert (boxes >= 0).all()
        found, gradients = bent(cage.vertices[cage.cells[boxes]], places, cage.sides)
        np.testing.assert_allclose(found, points, atol=1e-9)
        np.testing.assert_allclose(gradients, np.broadcast_to(np.eye(3), gradients.shape), atol=1e-12)

    def test_what_is_far_off_has_no_box(self, cube):
        cage = build_cage(*cube, CUBE, 8, 20.0)
        boxes, _ = cage.locate(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 24.0], [0.0, 0.0, 60.0], [np.nan, 0.0, 0.0]]))
        assert (boxes >= 0).tolist() == [True, True, False, False]

    def test_haze_around_the_body_is_none_of_it(self, cube):
        splats, masses = cube
        haze = GaussianSet.create(np.random.default_rng(2).uniform(-40, 40, (400, 3)), 1.0, density=1e-6)
        wider = 2 * CUBE
        cage = build_cage(
            GaussianSet.concatenate([splats, haze]), np.append(masses, np.full(400, 1e-6)), wider, 16, 20.0
        )
        assert np.abs(cage.vertices).max() <= 20 + 1e-9
        assert cage.masses.sum() == pytest.approx(masses.sum(), rel=1e-5)

    def test_dolls_in_a_doll_hang_together(self):
        grid = np.stack(np.meshgrid(*[np.arange(13) - 6] * 3, indexing="ij"), axis=-1)
        layer = np.abs(grid).max(axis=-1)
        chosen = chosen_cells(np.where((layer == 6) | (layer <= 2), 1.0, 0.0))
        assert chosen[6, 6].all()
        assert chosen[6, :, 6].all()

    def test_parts_side_by_side_stay_apart(self):
        weights = np.zeros((12, 4, 4))
        weights[:4], weights[8:] = 1.0, 1.0
        np.testing.assert_array_equal(chosen_cells(weights), weights > 0)

    def test_where_all_is_dust_the_heaviest_is_the_body(self):
        weights = np.zeros((40, 40, 2))
        weights[::3, ::3, 0] = 1.0
        assert chosen_cells(weights).any()

    def test_the_nearest_of_the_boxes(self):
        chosen = np.zeros((5, 5, 1), bool)
        chosen[0, 0], chosen[4, 4] = True, True
        index = nearest_chosen(chosen)
        assert index[0, 0, 0] == 0
        assert index[1, 1, 0] == -1
        assert index[4, 3, 0] == -2


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"resolution": 1}, "choose 2 to 32"),
        ({"resolution": 200}, "choose 2 to 32"),
        ({"stiffness_kpa": 0.0}, "holds nothing together; choose one above 0"),
        ({"stiffness_kpa": float("nan")}, "holds nothing together"),
        ({"surface": CUBE * [1.0, 1.0, 0.0]}, "is flat, so it has no body"),
    ],
)
def test_settings_that_cannot_be(cube, change, words):
    splats, masses = cube
    given = {"surface": CUBE, "resolution": 8, "stiffness_kpa": 20.0, **change}
    with pytest.raises(SettingError, match=words):
        build_cage(splats, masses, **given)


def test_one_box_is_a_cage(cube):
    splats, masses = cube
    few = dataclasses.replace(splats, means=splats.means * np.float32(0.01))
    cage = build_cage(few, masses, CUBE * [0.01, 0.001, 0.001], 2, 20.0)
    assert len(cage.cells) == 2
    assert np.isfinite(cage.frequency())
