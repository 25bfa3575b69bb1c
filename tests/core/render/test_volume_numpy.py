"""A set sampled on a grid with numpy alone."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.errors import SettingError
from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.mesh import gaussian_mass_properties, mass_properties
from insideout.core.render.patches_numpy import add_gaussians
from insideout.core.render.volume_numpy import sample_volume
from insideout.core.render.voxels import voxel_averages
from insideout.core.rotations import normalize_quats, quats_to_matrices


@pytest.fixture
def splats():
    rng = np.random.default_rng(6)
    return GaussianSet.create(
        rng.uniform(-10, 10, (300, 3)) * [1, 2, 0.5],
        rng.uniform(0.3, 2.0, (300, 3)),
        quats=rng.normal(size=(300, 4)),
        density=rng.uniform(0.005, 0.05, 300),
        modality=rng.integers(0, 3, 300),
    )


@pytest.mark.parametrize("voxels", [0, 40])
def test_the_grid_holds_the_mass_of_the_splats(splats, voxels):
    volume = sample_volume(splats, voxels)
    summed, exact = mass_properties(volume, 20.0), gaussian_mass_properties(splats, 20.0)

    assert summed.mass_g == pytest.approx(exact.mass_g, rel=0.003)
    np.testing.assert_allclose(summed.center_mm, exact.center_mm, atol=0.02)
    np.testing.assert_allclose(summed.inertia_g_mm2, exact.inertia_g_mm2, atol=0.005 * exact.inertia_g_mm2.max())
    assert len(set(volume.spacing_mm)) == 1


def test_voxels_are_those_of_the_engine(splats):
    volume = sample_volume(splats, 60)

    expected = voxel_averages(splats, volume).values
    np.testing.assert_allclose(volume.values, expected, atol=0.02 * expected.max())


def test_one_splat_is_what_its_formula_says_however_large_its_box():
    """More voxels than are held at once: it is sampled layer by layer."""
    turned = GaussianSet.create([[1.0, -2.0, 3.0]], [[6.0, 2.0, 4.0]], quats=[[0.9, 0.2, -0.3, 0.1]], density=0.03)
    values = np.zeros((130, 110, 120), np.float32)
    origin, side = np.array([-19.0, -18.0, -20.0]), 0.33
    heard = []
    add_gaussians(values, turned, origin, side, 8.0, heard.append)

    x, y, z = (origin[axis] + side * np.arange(values.shape[2 - axis]) for axis in range(3))
    apart = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).swapaxes(0, 2) - turned.means[0]
    squared = np.einsum("...i,ij,...j->...", apart, np.linalg.inv(turned.covariances()[0]), apart)
    np.testing.assert_allclose(values, 0.03 * np.exp(-0.5 * squared), atol=1e-7)
    assert len(heard) > 1


def test_splats_beside_the_grid_add_nothing():
    values, heard = np.zeros((4, 4, 4), np.float32), []
    add_gaussians(values, GaussianSet.create([[100.0, 0, 0]], 1.0, density=1.0), np.zeros(3), 1.0, 4.0, heard.append)

    assert not values.any()
    assert heard == [1.0]


def test_a_thin_long_splat_across_the_grid_loses_no_digits():
    thin = GaussianSet.create([[0.0, 0, 0]], [[300.0, 0.3, 0.3]], quats=[[0.9, 0.1, 0.2, 0.3]], density=0.05)
    values = np.zeros((40, 40, 40), np.float32)
    add_gaussians(values, thin, np.full(3, -19.5), 1.0, 6.0)

    index = np.argwhere(values > 1e-6)
    axes = quats_to_matrices(normalize_quats(thin.quats.astype(np.float64)))[0]
    squared = np.square((index[:, ::-1] - 19.5) @ axes / thin.scales[0]).sum(axis=1)
    np.testing.assert_allclose(values[tuple(index.T)], 0.05 * np.exp(-0.5 * squared), rtol=1e-3)
    assert len(index) > 20


def test_one_that_floats_far_away_does_not_make_voxels_large(splats):
    stray = GaussianSet.create([[500.0, 0, 0]], 0.1, density=0.01, modality=Modality.XRAY)

    volume = sample_volume(GaussianSet.concatenate([splats, stray]), 40)

    assert volume.box_mm[1, 0] < 30


def test_the_caller_hears_how_far_it_is(splats):
    heard = []
    sample_volume(splats, 20, heard.append)

    assert heard == sorted(heard)
    assert heard[-1] == 1.0


@pytest.mark.parametrize("voxels", [-1, 7, 513])
def test_a_senseless_grid_is_refused(splats, voxels):
    with pytest.raises(SettingError, match="give 8 to 512, or 0"):
        sample_volume(splats, voxels)


def test_a_set_without_density_is_refused():
    with pytest.raises(SettingError, match="no splats with density"):
        sample_volume(GaussianSet.create(np.zeros((2, 3)), 1.0))
