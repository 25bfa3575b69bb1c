"""Splats of a body that bends: exact where there is a formula, finite where the body is crushed."""

import dataclasses

import numpy as np
import pytest

from insideout.core.affine import orthogonal_sh
from insideout.core.deform import MOST_STRETCH, deformed, turned_colors
from insideout.core.gaussians import GaussianSet
from insideout.core.rotations import normalize_quats, quats_to_matrices
from insideout.core.similarity import Similarity
from insideout.core.spherical_harmonics import rotate_sh, rotate_sh_each

FIELDS = ("means", "quats", "scales", "opacities", "sh", "density", "modality")
COUNT = 60
TURN = quats_to_matrices(normalize_quats(np.array([[0.3, -0.8, 0.4, 0.2]])))[0]
SHIFT = np.array([10.0, -3.0, 2.0])
# What a crushed cage may have for a gradient.
CRUSHED = {
    "flat": np.diag([1.0, 1.0, 0.0]),
    "flat and turned": TURN @ np.diag([1.3, 0.0, 0.7]) @ TURN.T,
    "nearly flat": np.diag([1.0, 1.0, 1e-12]),
    "a line": np.diag([1.0, 0.0, 0.0]),
    "a point": np.zeros((3, 3)),
    "inside out": np.diag([1.0, 1.0, -1.0]),
    "inside out and flat": np.diag([1.0, -1e-9, 1.0]),
    "turned inside out": -TURN,
    "torn apart": 1e9 * np.eye(3),
    "pulled to a thread": np.diag([1e6, 1e-6, 1e-6]),
    "not a number": np.full((3, 3), np.nan),
    "partly not a number": np.array([[1.0, np.nan, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    "infinite": np.diag([np.inf, 1.0, 1.0]),
}


def splats(dtype=np.float32, degree=3):
    """Of all shapes; in double precision the formulas can be seen in all their digits."""
    rng = np.random.default_rng(0)
    made = GaussianSet.create(
        rng.normal(size=(COUNT, 3)) * 20,
        rng.uniform(0.1, 2.0, (COUNT, 3)),
        quats=rng.normal(size=(COUNT, 4)),
        opacities=rng.uniform(0.05, 0.95, COUNT),
        sh=rng.normal(size=(COUNT, (degree + 1) ** 2, 3)),
        density=rng.uniform(0.01, 0.1, COUNT),
        modality=rng.integers(0, 3, COUNT),
    )
    floats = {name: getattr(made, name).astype(dtype) for name in FIELDS[:-1]}
    floats["quats"] = normalize_quats(floats["quats"])
    return dataclasses.replace(made, **floats)


def everywhere(gradient, gaussians):
    """The set where the whole body has one gradient, and is shifted."""
    gradients = np.broadcast_to(gradient, (len(gaussians), 3, 3))
    return deformed(gaussians, gaussians.means @ np.nan_to_num(gradient, posinf=1e9).T + SHIFT, gradients)


def gentle(count=COUNT):
    """A different shear and stretch for each splat."""
    return np.eye(3) + 0.25 * np.random.default_rng(1).normal(size=(count, 3, 3))


class TestFormulas:
    def test_a_rotation_gives_the_rotated_set(self):
        before = splats()
        found, expected = everywhere(TURN, before), before.transformed(Similarity(1.0, TURN, SHIFT))
        np.testing.assert_array_equal(found.scales, expected.scales)
        np.testing.assert_array_equal(found.density, before.density)
        np.testing.assert_allclose(found.means, expected.means, atol=1e-5)
        np.testing.assert_allclose(np.abs((found.quats * expected.quats).sum(axis=1)), 1.0, atol=1e-6)
        np.testing.assert_allclose(found.sh, expected.sh, atol=2e-6)

    @pytest.mark.parametrize("stretch", [0.5, 2.0, 7.0])
    def test_a_uniform_stretch_thins_by_its_third_power(self, stretch):
        before = splats(np.float64)
        found = everywhere(stretch * np.eye(3), before)
        np.testing.assert_allclose(found.scales, stretch * before.scales, rtol=1e-12)
        np.testing.assert_allclose(found.density, before.density / stretch**3, rtol=1e-12)

    def test_covariances_become_those_of_the_sheared_body(self):
        before, gradients = splats(np.float64), gentle()
        found = deformed(before, before.means, gradients)
        expected = gradients @ before.covariances() @ gradients.swapaxes(1, 2)
        np.testing.assert_allclose(found.covariances(), expected, rtol=1e-11, atol=1e-12)

    @pytest.mark.parametrize(("dtype", "digits"), [(np.float64, 1e-12), (np.float32, 3e-7)])
    def test_each_splat_keeps_its_mass(self, dtype, digits):
        before = splats(dtype)
        found = deformed(before, before.means, gentle())
        np.testing.assert_allclose(found.integrals(), before.integrals(), rtol=digits)
        assert found.scales.dtype == found.density.dtype == dtype

    def test_what_is_pressed_together_is_denser(self):
        before = splats(np.float64)
        found = everywhere(np.diag([1.0, 1.0, 0.5]), before)
        np.testing.assert_allclose(found.density, 2 * before.density, rtol=1e-12)

    def test_what_is_not_bent_stays_to_the_last_bit(self):
        before = splats()
        found = deformed(before, before.means, np.tile(np.eye(3), (COUNT, 1, 1)))
        for name in FIELDS:
            np.testing.assert_array_equal(getattr(found, name), getattr(before, name), err_msg=name)

    def test_rounding_turns_no_round_splat(self):
        """A cage of single precision at rest."""
        ball = GaussianSet.create(np.zeros((COUNT, 3)), 1.0)
        noise = 1e-7 * np.random.default_rng(2).normal(size=(COUNT, 3, 3))
        found = deformed(ball, ball.means, np.eye(3) + noise)
        np.testing.assert_array_equal(found.quats, ball.quats)

    def test_opacities_and_modalities_stay(self):
        before = splats()
        found = deformed(before, before.means, gentle())
        np.testing.assert_array_equal(found.opacities, before.opacities)
        np.testing.assert_array_equal(found.modality, before.modality)

    def test_no_splats(self):
        assert len(deformed(GaussianSet.empty(2), np.zeros((0, 3)), np.zeros((0, 3, 3)))) == 0


class TestCrushed:
    """Cells that a simulation has flattened, turned inside out or blown up."""

    @pytest.mark.parametrize("name", CRUSHED)
    def test_the_splats_stay_splats(self, name):
        before = splats()
        found = everywhere(CRUSHED[name], before)
        for field in FIELDS:
            assert np.isfinite(getattr(found, field)).all(), field
        assert (found.scales > 0).all()
        np.testing.assert_allclose(np.linalg.norm(found.quats, axis=1), 1.0, atol=1e-6)

    @pytest.mark.parametrize("name", CRUSHED)
    def test_no_mass_is_lost(self, name):
        before = splats()
        np.testing.assert_allclose(everywhere(CRUSHED[name], before).integrals(), before.integrals(), rtol=1e-6)

    @pytest.mark.parametrize("name", CRUSHED)
    def test_axes_and_density_stay_within_bounds(self, name):
        before = splats(np.float64)
        found = everywhere(CRUSHED[name], before)
        thinnest, longest = before.scales.min(axis=1), before.scales.max(axis=1)
        assert (found.scales >= thinnest[:, None] / MOST_STRETCH * (1 - 1e-12)).all()
        assert (found.scales <= longest[:, None] * MOST_STRETCH * (1 + 1e-12)).all()
        most = before.density * before.scales.prod(axis=1) / (thinnest / MOST_STRETCH) ** 3
        assert (found.density <= most * (1 + 1e-12)).all()

    def test_a_flattened_splat_is_thin_across_the_plane(self):
        before = splats(np.float64)
        found = everywhere(CRUSHED["flat"], before)
        heights = np.sqrt(found.covariances()[:, 2, 2])
        np.testing.assert_allclose(heights, before.scales.min(axis=1) / MOST_STRETCH, rtol=1e-6)

    def test_a_mirrored_splat_is_the_mirrored_ellipsoid(self):
        before, mirror = splats(np.float64), CRUSHED["inside out"]
        found = everywhere(mirror, before)
        np.testing.assert_allclose(found.covariances(), mirror @ before.covariances() @ mirror, atol=1e-12)
        np.testing.assert_allclose(found.density, before.density, rtol=1e-12)

    def test_one_crushed_splat_spoils_no_other(self):
        before, gradients = splats(np.float64), gentle()
        alone = deformed(before, before.means, gradients)
        gradients[3], gradients[7] = CRUSHED["not a number"], CRUSHED["a point"]
        found = deformed(before, before.means, gradients)
        others = np.delete(np.arange(COUNT), [3, 7])
        for field in FIELDS:
            np.testing.assert_array_equal(getattr(found, field)[others], getattr(alone, field)[others], err_msg=field)

    def test_where_the_place_is_no_number_the_splat_stays(self):
        before = splats()
        means = before.means.astype(np.float64)
        means[5, 1] = np.nan
        found = deformed(before, means, gentle())
        for field in FIELDS:
            np.testing.assert_allclose(getattr(found, field)[5], getattr(before, field)[5], rtol=1e-6, err_msg=field)

    def test_a_splat_whose_axis_is_no_number_stays_and_spoils_no_other(self):
        before, gradients = splats(), gentle()
        alone = deformed(before, before.means, gradients)
        scales = before.scales.copy()
        scales[5, 1] = np.nan
        before = dataclasses.replace(before, scales=scales)
        found, others = deformed(before, before.means + 1.0, gradients), np.arange(COUNT) != 5
        for field in FIELDS[1:]:
            np.testing.assert_array_equal(getattr(found, field)[others], getattr(alone, field)[others], err_msg=field)
        for field in FIELDS:
            np.testing.assert_allclose(getattr(found, field)[5], getattr(before, field)[5], rtol=1e-6, err_msg=field)

    def test_a_needle_keeps_its_volume_in_the_determinant(self):
        needle = GaussianSet.create(np.zeros((1, 3)), np.array([[1.0, 1e-3, 1e-3]]), density=1.0)
        needle = dataclasses.replace(needle, scales=needle.scales.astype(np.float64))
        gradient = gentle(1)
        found = deformed(needle, needle.means, gradient)
        grown = found.scales.prod() / needle.scales.prod()
        assert grown == pytest.approx(abs(np.linalg.det(gradient[0])), rel=1e-9)


class TestColors:
    @pytest.mark.parametrize("degree", [1, 2, 3])
    def test_each_turns_by_its_own_rotation(self, degree):
        sh = splats(degree=degree).sh
        turns = quats_to_matrices(normalize_quats(np.random.default_rng(3).normal(size=(COUNT, 4))))
        found = rotate_sh_each(sh, turns)
        for n in range(0, COUNT, 7):
            np.testing.assert_allclose(found[n : n + 1], rotate_sh(sh[n : n + 1], turns[n]), atol=2e-6)

    def test_more_than_are_turned_at_once(self):
        sh = np.tile(splats(degree=1).sh[:1], (20_000, 1, 1))
        found = rotate_sh_each(sh, np.broadcast_to(TURN, (20_000, 3, 3)))
        np.testing.assert_allclose(found, np.broadcast_to(rotate_sh(sh[:1], TURN), found.shape), atol=2e-6)

    def test_a_stretch_turns_no_colour(self):
        before = splats()
        np.testing.assert_allclose(everywhere(np.diag([3.0, 1.0, 0.5]), before).sh, before.sh, atol=2e-6)

    def test_of_a_turn_and_a_stretch_the_turn_counts(self):
        before = splats()
        found = everywhere(TURN @ np.diag([3.0, 1.0, 0.5]), before)
        np.testing.assert_allclose(found.sh, rotate_sh(before.sh, TURN), atol=5e-6)

    def test_a_mirror_mirrors(self):
        sh, mirror = splats().sh, TURN @ np.diag([1.0, 1.0, -1.0])
        found = turned_colors(sh, np.broadcast_to(mirror, (COUNT, 3, 3)))
        np.testing.assert_allclose(found, orthogonal_sh(sh, mirror), atol=5e-6)

    @pytest.mark.parametrize("name", ["not a number", "partly not a number", "infinite"])
    def test_where_there_is_no_gradient_colours_stay_and_spoil_no_other(self, name):
        sh, gradients = splats().sh, gentle()
        alone = turned_colors(sh, gradients)
        gradients[3] = CRUSHED[name]
        found = turned_colors(sh, gradients)
        np.testing.assert_allclose(found[3], sh[3], atol=2e-6)
        np.testing.assert_array_equal(np.delete(found, 3, axis=0), np.delete(alone, 3, axis=0))
