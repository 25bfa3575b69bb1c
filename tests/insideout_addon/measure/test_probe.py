"""What is told of one place of a model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from insideout.core.errors import SettingError
from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.render.section_numpy import section_density
from insideout.core.views import Plane
from insideout.insideout_addon.measure.probe import probe


def _sh(*rgb):
    """Of one colour, 0..1."""
    return ((np.array(rgb) - 0.5) / 0.28209479177387814).reshape(1, 1, 3)


def test_density_falls_off_as_the_gaussian_does(one_ball):
    for steps in (0.0, 1.0, 2.5):
        found = probe(one_ball, [3 + 5 * steps, -2, 1])
        assert found.density == pytest.approx(0.04 * np.exp(-0.5 * steps**2), rel=1e-6)
        assert found.distance_mm == pytest.approx(5 * steps, abs=1e-6)


def test_far_away_there_is_no_density(one_ball):
    """Of 0.04 mm⁻¹ at a σ of 5 mm: a part in 10⁹ is left at 6.44 σ."""
    assert probe(one_ball, [3 + 5 * 6.4, -2, 1]).density == pytest.approx(0.04 * np.exp(-0.5 * 6.4**2), rel=1e-6)
    for steps in (6.5, 20.0, 37.0, 1e4):
        assert probe(one_ball, [3 + 5 * steps, -2, 1]).density == 0.0
    faint = replace(one_ball, density=np.full(1, 1e-37, np.float32))
    assert probe(faint, [3, -2, 1]).density == pytest.approx(1e-37)
    assert probe(faint, [3 + 5 * 5, -2, 1]).density == 0.0, "less than single precision holds"


def test_density_is_that_of_the_section_through_the_place(random_set):
    point = np.array([2.0, -3.0, 4.5])
    plane = Plane(point - [2.5, 2.5, 0], [1, 0, 0], [0, 1, 0], 5, 5)
    assert probe(random_set, point).density == pytest.approx(section_density(random_set, plane)[2, 2], rel=1e-4)


def test_the_nearest_splat_is_told_with_its_size_and_origin(random_set):
    point = random_set.means[17] + [0.01, 0, 0]
    found = probe(random_set, point)
    assert found.nearest == 17
    assert found.modality == random_set.modality[17]
    assert found.distance_mm == pytest.approx(0.01, abs=1e-5)
    np.testing.assert_allclose(found.center_mm, random_set.means[17])
    np.testing.assert_allclose(found.scales_mm, random_set.scales[17])


def test_turned_splats_are_looked_at_along_their_axes():
    half = np.sqrt(0.5)
    splats = GaussianSet.create([[0, 0, 0]], [[4.0, 1.0, 1.0]], quats=[half, 0, 0, half], density=1.0)
    assert probe(splats, [0, 4, 0]).density == pytest.approx(np.exp(-0.5), rel=1e-6)
    assert probe(splats, [4, 0, 0]).density == pytest.approx(np.exp(-8), rel=1e-5)


class TestColour:
    RED_AND_BLUE = GaussianSet.create(
        [[0, 0, 0], [10, 0, 0]], 2.0, opacities=[0.6, 0.3], sh=np.concatenate([_sh(0.9, 0.1, 0.1), _sh(0.1, 0.1, 0.9)])
    )

    def test_it_is_the_mean_of_the_splats_there(self):
        found = probe(self.RED_AND_BLUE, [5, 0, 0])
        assert not found.color_is_here, "two and a half standard deviations away nothing is left"
        near = replace(self.RED_AND_BLUE, scales=np.full((2, 3), 5.0, np.float32))
        found = probe(near, [5, 0, 0])
        assert found.color_is_here
        np.testing.assert_allclose(found.color, np.array([0.9 * 2 + 0.1, 0.3, 0.1 * 2 + 0.9]) / 3, atol=1e-6)

    def test_in_empty_space_it_is_that_of_the_nearest_opaque_splat(self):
        found = probe(self.RED_AND_BLUE, [40, 0, 0])
        assert found.nearest == 1
        assert not found.color_is_here
        np.testing.assert_allclose(found.color, [0.9, 0.1, 0.1], atol=1e-6)

    def test_where_nothing_is_opaque_there_is_none(self):
        faint = replace(self.RED_AND_BLUE, opacities=np.full(2, 0.01, np.float32))
        assert probe(faint, [5, 0, 0]).color is None


def test_clones_show_colour_but_do_not_attenuate():
    clone = GaussianSet.create([[0, 0, 0]], 1.0, sh=_sh(0.2, 0.4, 0.6), density=0.5, modality=Modality.CLONE)
    found = probe(clone, [0, 0, 0])
    assert found.density == 0
    assert found.modality is Modality.CLONE
    np.testing.assert_allclose(found.color, [0.2, 0.4, 0.6], atol=1e-6)


def test_broken_splats_are_passed_over(one_ball):
    broken = replace(one_ball, means=np.full((1, 3), np.nan, np.float32))
    found = probe(GaussianSet.concatenate([broken, one_ball]), [3, -2, 1])
    assert found.nearest == 1
    assert found.density == pytest.approx(0.04)
    with pytest.raises(SettingError, match="no splats"):
        probe(broken, [0, 0, 0])


def test_a_place_must_be_one(one_ball):
    with pytest.raises(SettingError, match="three numbers"):
        probe(one_ball, [0, np.inf, 0])
