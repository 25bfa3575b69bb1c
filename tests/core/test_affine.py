"""Splats under affine maps: exact where they can be, stable where they are thin or round."""

import numpy as np
import pytest

from insideout.core import affine as affine_module
from insideout.core.affine import (
    Affine,
    Kept,
    affine_in_steps,
    affine_transformed,
    orthogonal_sh,
    principal_axes,
)
from insideout.core.errors import SettingError
from insideout.core.gaussians import GaussianSet
from insideout.core.rotations import normalize_quats, quats_to_matrices
from insideout.core.similarity import Similarity
from insideout.core.spherical_harmonics import sh_basis
from insideout.core.steps import run_through

FIELDS = ("means", "quats", "scales", "opacities", "sh", "density", "modality")
TURN = quats_to_matrices(normalize_quats(np.array([[0.3, -0.8, 0.4, 0.2]])))[0]
SHIFT = np.array([10.0, -3.0, 2.0])
MAPS = {
    "uneven": np.diag([2.0, 0.5, 1.3]),
    "uneven and turned": TURN @ np.diag([2.0, 0.5, 1.3]),
    "sheared": np.array([[1.0, 0.8, 0.0], [0.0, 1.0, -1.5], [0.0, 0.0, 1.0]]),
    "mirrored": np.diag([-1.0, 1.0, 1.0]),
    "turned inside out": -2.0 * TURN,
    "stretched a thousandfold": TURN @ np.diag([1000.0, 1.0, 1.0]) @ TURN.T,
}
SHAPES = {
    "a ball": [1.0, 1.0, 1.0],
    "nearly a ball": [1.0, 1.0 + 1e-7, 1.0 - 1e-7],
    "nearly round across": [3.0, 1.0, 1.0 + 1e-12],
    "a needle": [1.0, 1e-6, 1e-6],
    "a thread": [1.0, 1e-9, 2e-9],
    "a leaf": [1.0, 1.0, 1e-9],
    "a speck": [1e-12, 2e-12, 1e-12],
    "a cloud": [1e9, 1e8, 1e9],
}


@pytest.fixture
def gaussians():
    rng = np.random.default_rng(0)
    return GaussianSet.create(
        rng.normal(size=(40, 3)) * 20,
        rng.uniform(0.1, 2.0, (40, 3)),
        quats=rng.normal(size=(40, 4)),
        opacities=rng.uniform(0.05, 0.95, 40),
        sh=rng.normal(size=(40, 16, 3)),
        density=rng.uniform(0, 0.1, 40),
        modality=rng.integers(0, 3, 40),
    )


def _directions(count=50):
    directions = np.random.default_rng(5).normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _colors(sh, directions):
    return np.einsum("dk,nkc->dnc", sh_basis(directions, 3), sh)


class TestSimilarities:
    """What `GaussianSet.transformed` does already."""

    def test_they_are_the_same(self, gaussians):
        similarity = Similarity(3.7, TURN, SHIFT)
        expected = gaussians.transformed(similarity)
        found = affine_transformed(gaussians, Affine(3.7 * TURN, SHIFT))
        for name in FIELDS:
            np.testing.assert_allclose(
                getattr(found, name), getattr(expected, name), rtol=1e-6, atol=2e-6, err_msg=name
            )

    def test_no_change_changes_no_bit(self, gaussians):
        found = affine_transformed(gaussians, Affine(np.eye(3), np.zeros(3)))
        for name in FIELDS:
            np.testing.assert_array_equal(getattr(found, name), getattr(gaussians, name), err_msg=name)

    def test_a_shift_changes_the_centres_alone(self, gaussians):
        found = affine_transformed(gaussians, Affine(np.eye(3), SHIFT))
        np.testing.assert_allclose(found.means, gaussians.means + SHIFT, rtol=1e-6, atol=1e-5)
        for name in FIELDS[1:]:
            np.testing.assert_array_equal(getattr(found, name), getattr(gaussians, name), err_msg=name)

    def test_a_rounded_matrix_does_not_turn_round_splats(self):
        rng = np.random.default_rng(1)
        round_ones = GaussianSet.create(np.zeros((50, 3)), 1.0, quats=rng.normal(size=(50, 4)))
        rounded = (TURN + rng.uniform(-1e-7, 1e-7, (3, 3))).astype(np.float32)
        found = affine_transformed(round_ones, Affine(rounded, np.zeros(3)))
        expected = round_ones.transformed(Similarity(1.0, TURN))
        np.testing.assert_allclose(found.quats, expected.quats, atol=2e-6)


class TestShapes:
    """Σ' = A Σ Aᵀ, as rotation and standard deviations."""

    @pytest.mark.parametrize("name", MAPS)
    def test_covariances_go_with_the_map(self, gaussians, name):
        linear = MAPS[name]
        found = affine_transformed(gaussians, Affine(linear, SHIFT))
        expected = linear @ gaussians.covariances().astype(np.float64) @ linear.T
        np.testing.assert_allclose(found.covariances(), expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max())
        np.testing.assert_allclose(found.means, gaussians.means @ linear.T + SHIFT, rtol=1e-5, atol=1e-4)
        assert (found.scales > 0).all()
        np.testing.assert_allclose(np.linalg.norm(found.quats, axis=1), 1.0, atol=1e-6)

    @pytest.mark.parametrize("name", MAPS)
    @pytest.mark.parametrize("shape", SHAPES)
    def test_hard_shapes_stay_exact_in_their_thinnest_direction(self, shape, name):
        """Points keep their distance in standard deviations, in which a lost thin axis would be all the error."""
        lengths, linear = np.array(SHAPES[shape]), MAPS[name]
        turns = quats_to_matrices(normalize_quats(np.random.default_rng(2).normal(size=(30, 4))))
        shapes = linear @ (turns * lengths)
        quats, scales = principal_axes(shapes)
        assert np.isfinite(quats).all()
        assert (scales > 0).all()
        axes = quats_to_matrices(quats)
        np.testing.assert_allclose(axes @ axes.swapaxes(1, 2), np.broadcast_to(np.eye(3), (30, 3, 3)), atol=1e-13)
        np.testing.assert_allclose(np.linalg.det(axes), 1.0, atol=1e-13)
        # Of S⁻¹Rᵀ·M, which is orthogonal where R·S·S·Rᵀ = M·Mᵀ. Axes far longer than the thin one multiply rounding.
        whitened = axes.swapaxes(1, 2) @ shapes / scales[:, :, None]
        slack = 1e-13 * float((scales.max(axis=1) / scales.min(axis=1)).max())
        np.testing.assert_allclose(
            whitened @ whitened.swapaxes(1, 2), np.broadcast_to(np.eye(3), (30, 3, 3)), atol=max(slack, 1e-12)
        )

    @pytest.mark.parametrize("name", MAPS)
    @pytest.mark.parametrize("shape", SHAPES)
    def test_the_volume_of_thin_splats_is_exact(self, shape, name):
        """The product of the axes is the determinant; squaring first would lose an axis 1e-9 as long as another."""
        turns = quats_to_matrices(normalize_quats(np.random.default_rng(3).normal(size=(30, 4))))
        _, scales = principal_axes(MAPS[name] @ (turns * np.array(SHAPES[shape])))
        grown = abs(np.linalg.det(MAPS[name]))
        np.testing.assert_allclose(scales.prod(axis=1), grown * np.prod(SHAPES[shape]), rtol=1e-9)

    def test_a_little_stretch_turns_axes_a_little(self, gaussians):
        found = affine_transformed(gaussians, Affine(np.diag([1.0, 1.0, 1.0001]), np.zeros(3)))
        spread = np.sort(gaussians.scales, axis=1)
        apart = (np.diff(spread, axis=1) > 0.05 * spread[:, 1:]).all(axis=1)
        assert apart.sum() > 20
        np.testing.assert_allclose(found.quats[apart], gaussians.quats[apart], atol=3e-3)
        np.testing.assert_allclose(found.scales[apart], gaussians.scales[apart], rtol=2e-4)

    def test_there_and_back(self, gaussians):
        linear = MAPS["sheared"]
        there = affine_transformed(gaussians, Affine(linear, SHIFT))
        inverse = np.linalg.inv(linear)
        back = affine_transformed(there, Affine(inverse, -inverse @ SHIFT))
        np.testing.assert_allclose(back.means, gaussians.means, atol=1e-4)
        np.testing.assert_allclose(back.covariances(), gaussians.covariances(), atol=1e-5)

    def test_a_splat_without_a_size_gets_the_least_there_is(self):
        flat = GaussianSet.create(np.zeros((1, 3)), np.array([[1.0, 1.0, 0.0]]))
        found = affine_transformed(flat, Affine(MAPS["sheared"], np.zeros(3)))
        assert np.isfinite(found.quats).all()
        assert (found.scales > 0).all()

    def test_no_splats(self):
        assert len(affine_transformed(GaussianSet.empty(2), Affine(MAPS["sheared"], SHIFT))) == 0


class TestColors:
    """Colour functions turn with the object; a mirror mirrors them."""

    @pytest.mark.parametrize("mirror", [np.diag([-1.0, 1.0, 1.0]), -np.eye(3), TURN @ np.diag([1.0, 1.0, -1.0])])
    def test_a_mirrored_splat_shows_to_the_mirrored_side_what_it_showed(self, gaussians, mirror):
        found = orthogonal_sh(gaussians.sh.astype(np.float64), mirror)
        np.testing.assert_allclose(
            _colors(found, _directions() @ mirror.T), _colors(gaussians.sh, _directions()), atol=1e-6
        )

    def test_mirrored_twice_is_what_it_was(self, gaussians):
        mirror = Affine(MAPS["mirrored"], np.zeros(3))
        back = affine_transformed(affine_transformed(gaussians, mirror), mirror)
        for name in ("means", "scales", "density"):
            np.testing.assert_allclose(getattr(back, name), getattr(gaussians, name), rtol=1e-6, err_msg=name)
        np.testing.assert_allclose(back.sh, gaussians.sh, atol=1e-5)
        np.testing.assert_allclose(back.covariances(), gaussians.covariances(), atol=1e-5)

    def test_a_stretch_along_the_axes_turns_no_colour(self, gaussians):
        found = affine_transformed(gaussians, Affine(np.diag([3.0, 1.0, 0.5]), np.zeros(3)))
        np.testing.assert_allclose(found.sh, gaussians.sh, atol=1e-6)

    def test_of_a_turn_and_a_stretch_the_turn_counts(self, gaussians):
        found = affine_transformed(gaussians, Affine(TURN @ np.diag([3.0, 1.0, 0.5]), np.zeros(3)))
        np.testing.assert_allclose(
            _colors(found.sh, _directions() @ TURN.T), _colors(gaussians.sh, _directions()), atol=1e-5
        )


class TestDensity:
    """In mm⁻¹: it stays with the material, or the line integrals stay."""

    @pytest.mark.parametrize("name", MAPS)
    def test_material_stays_what_it_is(self, gaussians, name):
        found = affine_transformed(gaussians, Affine(MAPS[name], SHIFT), Kept.MATERIAL)
        np.testing.assert_array_equal(found.density, gaussians.density)

    @pytest.mark.parametrize("name", MAPS)
    def test_line_integrals_stay_in_the_mean_of_three_directions(self, name):
        """Through the middle of a ball, ∫ρ = ρ·√(2π)·σ along its axes."""
        ball = GaussianSet.create(np.zeros((1, 3)), 2.0, density=0.04)
        found = affine_transformed(ball, Affine(MAPS[name], SHIFT))
        integrals = found.density[0].astype(np.float64) * found.scales[0]
        assert np.prod(integrals) ** (1 / 3) == pytest.approx(0.04 * 2.0, rel=1e-5)


@pytest.mark.parametrize(
    ("linear", "words"),
    [
        (np.diag([1.0, 1.0, 0.0]), "squeezes it flat"),
        (np.zeros((3, 3)), "squeezes it flat"),
        (np.diag([1.0, 1.0, 1e-9]), "give it a size"),
        (np.diag([1.0, np.nan, 1.0]), "not finite"),
    ],
)
def test_a_map_that_leaves_nothing_is_refused(gaussians, linear, words):
    with pytest.raises(SettingError, match=words):
        affine_transformed(gaussians, Affine(linear, SHIFT))


def test_a_matrix_of_blender():
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = MAPS["sheared"], SHIFT
    points = np.random.default_rng(4).normal(size=(5, 3))
    np.testing.assert_allclose(Affine.of_matrix(matrix).apply(points), points @ MAPS["sheared"].T + SHIFT)


@pytest.mark.parametrize("count", [40, 0])
def test_in_steps_it_is_the_same(gaussians, count, monkeypatch):
    monkeypatch.setattr(affine_module, "_AT_ONCE", 16)
    affine, shares, some = Affine(MAPS["uneven and turned"], SHIFT), [], gaussians.select(slice(0, count))
    found = run_through(affine_in_steps(some, affine, Kept.MATERIAL), shares.append)
    assert shares == ([0.0, 0.4, 0.8] if count else [0.0])
    expected = affine_transformed(some, affine, Kept.MATERIAL)
    for name in FIELDS:
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-6, atol=1e-6)
