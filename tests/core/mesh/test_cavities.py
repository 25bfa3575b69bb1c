"""Closed hollows whose volume has a formula."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.errors import SettingError
from insideout.core.mesh.cavities import find_cavities
from insideout.core.volume import Volume


def ball_mm3(radius):
    return 4 / 3 * np.pi * radius**3


def blurred(volume, sigma_voxels):
    ndimage = pytest.importorskip("scipy.ndimage")
    values = ndimage.gaussian_filter(volume.values, sigma_voxels, mode="constant")
    return Volume(values, volume.spacing_mm, volume.origin_mm)


def test_a_hollow_ball(ball_volume):
    (cavity,) = find_cavities(ball_volume(cavity=6.0), 0.025)

    assert cavity.volume_mm3 == pytest.approx(ball_mm3(6), rel=0.005)
    np.testing.assert_allclose(cavity.center_mm, [1, 2, -1], atol=0.01)


@pytest.mark.parametrize("sigma_voxels", [1.0, 1.5, 2.0])
def test_blur_takes_nothing_from_a_cavity(ball_volume, sigma_voxels):
    """At half of the wall's attenuation the surface of this hollow lies up to 2 % of its radius too far out."""
    (cavity,) = find_cavities(blurred(ball_volume(radius=12.0, cavity=6.0), sigma_voxels), 0.025)

    assert cavity.volume_mm3 == pytest.approx(ball_mm3(6), rel=0.01)


def test_noise_and_haze(ball_volume):
    volume = ball_volume(radius=12.0, cavity=8.0)
    noise = np.random.default_rng(5).normal(0, 0.03 * 0.05, volume.values.shape).astype(np.float32)
    noisy = Volume(
        volume.values + noise + np.float32(0.0005) * (volume.values < 0.025), volume.spacing_mm, volume.origin_mm
    )

    (cavity,) = find_cavities(blurred(noisy, 0.7), 0.025)

    assert cavity.volume_mm3 == pytest.approx(ball_mm3(8), rel=0.01)


def test_nested_shells(ball_volume):
    """Two hollows: between the shells, and inside the inner one."""
    values = ball_volume(13.0, 10.0).values + ball_volume(7.0, 4.0).values

    between, innermost = find_cavities(Volume.centered(values, np.full(3, 0.5)), 0.025)

    assert between.volume_mm3 == pytest.approx(ball_mm3(10) - ball_mm3(7), rel=0.01)
    assert innermost.volume_mm3 == pytest.approx(ball_mm3(4), rel=0.01)
    np.testing.assert_allclose([between.center_mm, innermost.center_mm], [[1, 2, -1]] * 2, atol=0.02)


def test_walls_of_different_materials_count_each_by_its_own(ball_volume):
    """A light shell around a loose heavy ball."""
    values = ball_volume(13.0, 10.0, attenuation=0.02).values + ball_volume(4.0, attenuation=0.4).values

    (cavity,) = find_cavities(blurred(Volume.centered(values, np.full(3, 0.5)), 1.0), 0.01)

    assert cavity.volume_mm3 == pytest.approx(ball_mm3(10) - ball_mm3(4), rel=0.01)


def test_what_opens_to_the_outside_is_no_cavity(ball_volume):
    volume = ball_volume(cavity=6.0)
    volume.values[28:30, 30:34, 28:] = 0

    assert find_cavities(volume, 0.025) == []


def test_what_the_volume_cuts_open_is_no_cavity(ball_volume):
    volume = ball_volume(cavity=6.0)
    half = Volume(volume.values[:28], volume.spacing_mm, volume.origin_mm)

    assert find_cavities(half, 0.025) == []


def test_a_wall_that_only_meets_at_edges_closes():
    values = np.ones((7, 7, 7), np.float32)
    values[1:6, 1:6, 1:6] = 0
    values[0, 0] = values[0, :, 0] = 0

    (cavity,) = find_cavities(Volume.centered(values, np.ones(3)), 0.5)

    assert cavity.volume_mm3 == pytest.approx(125)


def test_small_ones_are_left_out(ball_volume):
    values = ball_volume(cavity=6.0).values
    values[28, 34, 45:47] = 0
    volume = Volume.centered(values, np.full(3, 0.5))

    assert len(find_cavities(volume, 0.025)) == 1
    assert len(find_cavities(volume, 0.025, smallest_mm3=0.1)) == 2
    assert find_cavities(volume, 0.025, smallest_mm3=1000.0) == []


def test_voxels_need_not_be_cubes():
    z, y, x = np.meshgrid(np.arange(60) - 29.5, np.arange(40) - 19.5, np.arange(30) - 14.5, indexing="ij")
    distance = np.sqrt((z * 0.5) ** 2 + (y * 0.75) ** 2 + x**2)
    values = np.clip(11 - distance + 0.5, 0, 1) - np.clip(6 - distance + 0.5, 0, 1)
    volume = Volume(values.astype(np.float32), np.array([1.0, 0.75, 0.5]), np.array([5.0, 6.0, 7.0]))

    (cavity,) = find_cavities(volume, 0.5)

    assert cavity.volume_mm3 == pytest.approx(ball_mm3(6), rel=0.01)
    np.testing.assert_allclose(cavity.center_mm, volume.box_mm.mean(axis=0), atol=1e-3)


def test_thin_and_empty_volumes_have_none():
    for values in (np.zeros((5, 5, 5)), np.ones((1, 1, 1)), np.ones((1, 9, 9)), np.full((4, 4, 4), np.nan)):
        assert find_cavities(Volume.centered(values.astype(np.float32), np.ones(3)), 0.5) == []


@pytest.mark.parametrize("level", [0.0, -1.0, float("nan")])
def test_a_level_that_parts_nothing_is_refused(ball_volume, level):
    with pytest.raises(SettingError, match="give an attenuation above 0"):
        find_cavities(ball_volume(), level)
