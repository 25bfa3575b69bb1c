"""Relocation leaves the image as it is to first order, the cap holds, and nothing becomes NaN."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from insideout.core.gaussians import GaussianSet
from insideout.core.render import splat
from insideout.core.train.mcmc import McmcStrategy, relocated
from insideout.core.train.parameters import GROUPS, Parameters
from insideout.core.views import Camera

CAMERA = Camera(48, 40, 60.0, 60.0, 24.0, 20.0, np.eye(4))


def a_set(count=12, opacity=0.5, seed=0):
    rng = np.random.default_rng(seed)
    means = rng.uniform([-0.8, -0.8, 2.2], [0.8, 0.8, 3.8], (count, 3))
    return GaussianSet.create(
        means,
        rng.uniform(0.1, 0.3, (count, 3)),
        quats=rng.normal(size=(count, 4)),
        opacities=np.broadcast_to(opacity, count),
        sh=rng.normal(size=(count, 1, 3)) * 0.5,
        density=0.2,
    )


def at_work(gaussians, **rules):
    parameters = Parameters(gaussians, GROUPS)
    return McmcStrategy(**rules).begin(parameters, 5.0, 1000, 3), parameters


def shown(gaussians):
    return splat(gaussians.to_torch(torch.float64), CAMERA, [0.2, 0.3, 0.4], kernel="reference").color.numpy()


@pytest.mark.parametrize("count", [1, 2, 3, 10, 50])
@pytest.mark.parametrize("opacity", [1e-5, 0.01, 0.5, 0.99, 1 - 1e-5])
def test_as_many_splats_let_through_what_one_did_and_have_its_integral(count, opacity):
    """On a line through the centre: ∫ 1 − (1 − o' e^(−x²/2s'²))^N dx is ∫ o e^(−x²/2s²) dx."""
    (new,), (factor,) = relocated(np.array([opacity]), np.array([count]))
    assert 1 - (1 - new) ** count == pytest.approx(opacity, rel=1e-9)
    x = np.linspace(-12, 12, 40_001)
    with np.errstate(under="ignore"):
        many = 1 - (1 - new * np.exp(-0.5 * (x / factor) ** 2)) ** count
        one = opacity * np.exp(-0.5 * x**2)
    assert many.sum() == pytest.approx(one.sum(), rel=1e-6)


def test_a_relocation_changes_the_image_in_second_order_only(monkeypatch):
    """Copies as opaque as what they are copies of change it in first order."""
    # What a renderer skips for being faint, more of it the more splats share it, would hide the law.
    monkeypatch.setattr("insideout.core.render.kernels.reference.splat.ALPHA_MIN", 1e-9)
    errors, naive_errors = [], []
    for opacity in (0.4, 0.2, 0.1, 0.05):
        start = a_set(opacity=opacity)
        dead = a_set(6, 1e-8, seed=1)
        control, parameters = at_work(GaussianSet.concatenate([start, dead]), dead=0.001)
        before = shown(parameters.to_set())
        assert control.relocate(100)
        after = parameters.to_set()
        assert len(after) == 18
        assert (after.opacities > 0.001).all()
        hosts = np.argmin(np.linalg.norm(after.means[:, None] - start.means, axis=2), axis=1)
        naive = replace(after, opacities=start.opacities[hosts], scales=start.scales[hosts])
        errors.append(np.abs(shown(after) - before).max())
        naive_errors.append(np.abs(shown(naive) - before).max())
    assert all(error < 0.2 * naive for error, naive in zip(errors, naive_errors, strict=True))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    naive_orders = np.log2(np.array(naive_errors[:-1]) / naive_errors[1:])
    assert (orders > 1.6).all(), (errors, orders)
    assert (naive_orders < 1.4).all(), naive_orders


def test_moments_of_the_moved_are_forgotten_and_of_the_others_kept():
    start = a_set(8)
    start.opacities[[1, 4]] = 0.001
    control, parameters = at_work(start)
    for group in GROUPS:
        parameters.gradient(group)[:] = 1.0
    parameters.step(dict.fromkeys(GROUPS, 1e-6))
    before = parameters.to_set()
    control.relocate(100)
    moved = np.any(parameters.to_set().opacities[:, None] != before.opacities[:, None], axis=1)
    assert moved[[1, 4]].all()
    assert 3 <= moved.sum() <= 4
    state = parameters.state()
    first = dict(zip(GROUPS, torch.split(state["first"], [state["raw"][name].numel() for name in GROUPS]), strict=True))
    means = first["means"].reshape(-1, 3).numpy()
    assert not means[[1, 4]].any()
    assert np.delete(means, [1, 4], axis=0).all()


def test_density_is_shared_so_that_attenuation_stays():
    start = a_set(8)
    start.opacities[[1, 4]] = 0.001
    start.density[[1, 4]] = 1e-9
    control, parameters = at_work(start)
    masses = [float((one.density * one.scales.prod(axis=1)).sum()) for one in (start,)]
    control.relocate(100)
    after = parameters.to_set()
    assert float((after.density * after.scales.prod(axis=1)).sum()) == pytest.approx(masses[0], rel=1e-5)


def test_the_count_grows_by_a_twentieth_and_stops_at_the_cap():
    control, parameters = at_work(a_set(100), most=130, every=1, start=0.0, stop=1.0)
    counts = []
    for iteration in range(12):
        control.after_step(iteration, {"means": 1e-4})
        counts.append(len(parameters))
    assert counts[:2] == [105, 110]
    assert max(counts) == counts[-1] == 130


@pytest.mark.parametrize("count", [0, 5])
def test_when_all_are_dead_nothing_is_moved_or_added_and_all_stays_finite(count):
    control, parameters = at_work(a_set(count, 0.0), every=1, start=0.0, stop=1.0)
    for iteration in range(5):
        assert not control.after_step(iteration, {"means": 1e-4})
    assert len(parameters) == count
    assert all(np.isfinite(value).all() for value in vars(parameters.to_set()).values())


def test_one_live_splat_takes_no_more_than_its_share_of_the_dead():
    start = a_set(200, 0.0)
    start.opacities[7] = 0.9
    control, parameters = at_work(start, copies=50)
    control.relocate(100)
    after = parameters.to_set()
    near = np.linalg.norm(after.means - start.means[7], axis=1) < 1e-6
    assert near.sum() == 50
    assert 1 - np.prod(1 - after.opacities[near].astype(np.float64)) == pytest.approx(0.9, rel=1e-4)


def test_splats_outside_the_box_are_brought_in():
    start = a_set(6)
    start.means[2] = 100.0
    parameters = Parameters(start, GROUPS)
    control = McmcStrategy().begin(parameters, 5.0, 1000, 0, np.array([[-9.0, -9, -9], [9, 9, 9]]))
    control.relocate(1)
    assert np.abs(parameters.to_set().means).max() < 9


def test_noise_is_along_the_splat_fades_with_opacity_and_follows_from_seed_and_iteration():
    count = 4000
    quat = np.tile([[0.9, 0.1, -0.3, 0.2]], (count, 1))
    start = GaussianSet.create(np.zeros((count, 3)), np.array([[0.3, 0.1, 0.02]]).repeat(count, 0), quats=quat)
    start.opacities[: count // 2], start.opacities[count // 2 :] = 0.001, 0.5

    def moved(iteration, unit=1.0):
        scaled = replace(start, means=start.means * unit, scales=start.scales * np.float32(unit))
        parameters = Parameters(scaled, GROUPS)
        McmcStrategy().begin(parameters, 5.0 * unit, 1000, 3).after_step(iteration, {"means": 1e-6 * unit})
        return parameters.to_set().means

    one = moved(0)
    assert not one[count // 2 :].any()
    covariance = start.covariances()[0].astype(np.float64)
    share = 5e5 * 1e-6 / (1 + np.exp(-100 * (0.999 - 0.995)))
    expected = share**2 * covariance @ covariance
    found = np.cov(one[: count // 2].T)
    np.testing.assert_allclose(found, expected, atol=0.08 * np.abs(expected).max())
    np.testing.assert_array_equal(one, moved(0))
    assert not np.array_equal(one, moved(1))
    # In another unit the noise is as large beside the scene.
    np.testing.assert_allclose(moved(0, 1000.0), 1000 * one, rtol=1e-3, atol=1e-3)


def test_the_penalty_is_of_mean_opacity_and_mean_scale():
    control, parameters = at_work(a_set(8))
    control.penalty(parameters.activate()).backward()
    current = parameters.to_set()
    np.testing.assert_allclose(
        parameters.gradient("opacities"), 0.01 / 8 * current.opacities * (1 - current.opacities), rtol=1e-4
    )
    np.testing.assert_allclose(parameters.gradient("scales"), 0.01 / 24 * current.scales, rtol=1e-4)
