"""The object found before the background that photos alone bring."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.gaussians import GaussianSet
from insideout.insideout_addon.scene.framing import find_body, reach, without_background


def _cloud(rng, object_means, scale=0.02, far=300):
    """An object, `far` floaters up to 30 times as far away, and one near it as large as a house."""
    directions = rng.normal(size=(far, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    floaters = directions * rng.uniform(5, 30, (far, 1)) + object_means.mean(axis=0)
    means = np.concatenate([object_means, floaters, object_means[:1]])
    scales = np.concatenate([np.full(len(object_means), scale), np.full(far, 0.8), [9.0]])
    return GaussianSet.create(means, np.repeat(scales[:, None], 3, axis=1), opacities=np.full(len(means), 0.6))


def _ball(rng, count=2000):
    directions = rng.normal(size=(count, 3))
    return np.array([3.0, 1.0, -2.0]) + directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _rod(rng, count=2000):
    return np.array([3.0, 1.0, -2.0]) + rng.uniform(-1, 1, (count, 1)) * np.array([[0.3, 1.0, 0.2]])


@pytest.mark.parametrize("shape", [_ball, _rod])
def test_the_object_is_told_from_floaters_and_from_what_is_huge(shape):
    rng = np.random.default_rng(3)
    means = shape(rng)
    kept = without_background(_cloud(rng, means))
    np.testing.assert_array_equal(kept.means, means.astype(np.float32))


def test_the_background_may_be_a_third_of_the_splats_when_it_is_faint():
    rng = np.random.default_rng(4)
    cloud = _cloud(rng, _ball(rng), far=1000)
    cloud.opacities[2000:] = 0.2
    body = find_body(cloud)
    np.testing.assert_allclose(body.center, [3, 1, -2], atol=0.15)
    assert 1.0 < body.radius < 4.0


def test_nothing_is_taken_from_an_object_without_a_background():
    rng = np.random.default_rng(5)
    alone = GaussianSet.create(_ball(rng), 0.02)
    assert find_body(alone) is None
    assert without_background(alone) is alone


def test_nothing_is_taken_where_the_xrays_say_what_the_object_is():
    rng = np.random.default_rng(6)
    cloud = _cloud(rng, _ball(rng))
    cloud.density[0] = 0.02
    assert find_body(cloud) is None


def test_at_least_half_of_a_scene_without_an_object_stays():
    """Heaps that lie far from each other, none of which holds half."""
    rng = np.random.default_rng(7)
    heaps = np.concatenate([rng.normal(size=(300, 3)) * 10.0**k + 40.0**k for k in range(-1, 3)])
    found = without_background(GaussianSet.create(heaps, 0.01))
    assert len(found) >= 0.5 * len(heaps)


def test_what_is_not_finite_does_no_harm():
    rng = np.random.default_rng(8)
    cloud = _cloud(rng, _ball(rng))
    cloud.means[5] = np.nan
    assert len(without_background(cloud)) == 1999


def test_reach_is_the_distance_and_two_deviations():
    one = GaussianSet.create([[3.0, 4.0, 0.0]], [[0.5, 0.1, 0.2]])
    assert reach(one, np.zeros(3)) == pytest.approx([6.0])


def test_empty_sets_have_no_body():
    assert find_body(GaussianSet.empty()) is None
