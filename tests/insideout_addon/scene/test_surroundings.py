"""Splats that float in air are told from material."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from insideout.core.gaussians import GaussianSet
from insideout.insideout_addon.scene.surroundings import floating_threshold, surrounding_density


def _block_with_floaters():
    rng = np.random.default_rng(0)
    block = GaussianSet.create(rng.uniform(-10, 10, (4000, 3)), 0.8, density=0.01)
    floaters = GaussianSet.create(rng.uniform(25, 40, (20, 3)), 0.8, density=0.002)
    return GaussianSet.concatenate([block, floaters])


def test_inside_a_block_it_is_the_blocks_density():
    """4000 splats of mass 0.01·(2π)^1.5·0.8³ in 20³ mm³."""
    around = surrounding_density(_block_with_floaters())
    middle = np.linalg.norm(_block_with_floaters().means, axis=1) < 6
    expected = 4000 * 0.01 * (2 * np.pi) ** 1.5 * 0.8**3 / 20**3
    assert around[middle].mean() == pytest.approx(expected, rel=0.15)


def test_floaters_are_below_the_threshold_and_the_block_is_not():
    around = surrounding_density(_block_with_floaters())
    threshold = floating_threshold(around, np.ones(4020, bool))
    assert (around[4000:] < threshold).all()
    assert (around[:4000] > threshold).mean() > 0.97


@pytest.mark.parametrize("what", ["means", "scales", "density"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_splat_that_is_no_number_is_nowhere_and_changes_no_other(what, value):
    """Other programs leave some; Export asks to delete them, which takes an import."""
    whole = _block_with_floaters()
    spoiled = getattr(whole, what).copy()
    spoiled[7] = value
    around = surrounding_density(dataclasses.replace(whole, **{what: spoiled}))
    others = np.arange(len(whole)) != 7
    assert around[7] == 0
    np.testing.assert_array_equal(around[others], surrounding_density(whole.select(others)))


def test_where_no_splat_is_a_number_nothing_is_dense():
    lost = GaussianSet.create(np.full((3, 3), np.nan), 0.8, density=0.01)
    assert surrounding_density(lost).tolist() == [0, 0, 0]


def test_a_model_without_x_rays_has_no_threshold():
    assert floating_threshold(np.ones(3), np.zeros(3, bool)) == 0.0
    assert len(surrounding_density(GaussianSet.empty())) == 0
