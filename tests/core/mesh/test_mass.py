"""Mass, centre and inertia of bodies that have a formula."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.errors import SettingError
from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.mesh import gaussian_mass_properties, mass_properties
from insideout.core.volume import Volume


def test_ball(ball_volume):
    # 20 g/cm³ per mm⁻¹ makes 0.05 mm⁻¹ weigh 1 g/cm³.
    found = mass_properties(ball_volume(), 20.0)

    mass = 4 / 3 * np.pi * 10**3 * 1e-3
    assert found.mass_g == pytest.approx(mass, rel=0.005)
    np.testing.assert_allclose(found.center_mm, [1, 2, -1], atol=1e-3)
    np.testing.assert_allclose(found.principal_moments, 0.4 * mass * 10**2, rtol=0.01)


def test_box_about_its_own_axes():
    values = np.full((4, 3, 2), 0.1, np.float32)
    volume = Volume(values, np.array([1.0, 2.0, 3.0]), np.array([5.0, -7.0, 1.0]))

    found = mass_properties(volume, 10.0)

    size = np.array([2.0, 6.0, 12.0])
    mass = size.prod() * 1e-3
    assert found.mass_g == pytest.approx(mass)
    np.testing.assert_allclose(found.center_mm, [5.5, -5.0, 5.5])
    expected = mass / 12 * np.diag(np.sum(size**2) - size**2)
    np.testing.assert_allclose(found.inertia_g_mm2, expected, atol=1e-9)


def test_products_of_inertia_have_the_right_sign():
    values = np.zeros((3, 3, 3), np.float32)
    values[1, 0, 0] = values[1, 2, 2] = 1.0

    found = mass_properties(Volume.centered(values, np.ones(3)), 1.0)

    assert found.inertia_g_mm2[0, 1] == pytest.approx(-2e-3)
    assert found.inertia_g_mm2[0, 2] == pytest.approx(0, abs=1e-12)


def test_level_leaves_noise_in_air_out(ball_volume):
    volume = ball_volume()
    noisy = Volume(volume.values + np.float32(0.004), volume.spacing_mm, volume.origin_mm)

    assert mass_properties(noisy, 20.0).mass_g > 1.3 * mass_properties(noisy, 20.0, level_mm_inv=0.025).mass_g


def test_density_map_may_be_a_curve(ball_volume):
    stepped = mass_properties(ball_volume(), lambda a: np.where(a > 0.025, 7.8, 0.0))

    assert stepped.mass_g == pytest.approx(4 / 3 * np.pi * 7.8, rel=0.01)


def test_gaussians_agree_with_their_voxels():
    rng = np.random.default_rng(3)
    gaussians = GaussianSet.create(
        rng.uniform(-4, 4, (20, 3)),
        rng.uniform(1.0, 2.0, (20, 3)),
        quats=rng.standard_normal((20, 4)),
        density=rng.uniform(0.01, 0.05, 20),
        modality=Modality.XRAY,
    )
    axis = np.arange(-12, 12.1, 0.5)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    inverse = np.linalg.inv(gaussians.covariances())
    values = np.zeros(len(points))
    for mean, precision, density in zip(gaussians.means, inverse, gaussians.density, strict=True):
        offset = points - mean
        values += density * np.exp(-0.5 * np.einsum("ni,ij,nj->n", offset, precision, offset))
    volume = Volume(values.reshape(x.shape).astype(np.float32), np.full(3, 0.5), np.full(3, -12.0))

    exact, summed = gaussian_mass_properties(gaussians, 15.0), mass_properties(volume, 15.0)

    assert exact.mass_g == pytest.approx(summed.mass_g, rel=1e-3)
    np.testing.assert_allclose(exact.center_mm, summed.center_mm, atol=5e-3)
    np.testing.assert_allclose(exact.inertia_g_mm2, summed.inertia_g_mm2, rtol=0.01, atol=0.01)


def test_clones_weigh_nothing():
    one = GaussianSet.create([[0, 0, 0]], 1.0, density=0.1, modality=Modality.XRAY)
    clone = GaussianSet.create([[5, 0, 0]], 1.0, density=0.1, modality=Modality.CLONE)

    both = gaussian_mass_properties(GaussianSet.concatenate([one, clone]), 10.0)

    np.testing.assert_allclose(both.center_mm, 0)


def test_no_mass_is_said(ball_volume):
    with pytest.raises(SettingError, match="mass comes out as 0 g"):
        mass_properties(ball_volume(), 0.0)
