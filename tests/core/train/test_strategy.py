"""Densification: who is cloned, split, dropped; that attenuation stays; that a cap holds."""

from dataclasses import replace

import numpy as np
import pytest

from insideout.core.errors import SettingError
from insideout.core.gaussians import GaussianSet
from insideout.core.train.mask import MaskStrategy
from insideout.core.train.mcmc import McmcStrategy
from insideout.core.train.parameters import GROUPS, Parameters
from insideout.core.train.strategy import DefaultStrategy, Densifier

EVERY = DefaultStrategy(start=0.0, stop=1.0, every=1, gradient=1.0, clone_size=0.1)


def a_set(count=6, scale=0.01, opacity=0.5, density=0.2):
    means = np.arange(3 * count).reshape(count, 3)
    return GaussianSet.create(means, scale, opacities=opacity, density=density)


def densified(gaussians, strategy, gradients, box=None):
    parameters = Parameters(gaussians, GROUPS)
    densifier = Densifier(strategy, parameters, extent=1.0, iterations=100, seed=0, box=box)
    densifier.observe(np.asarray(gradients, np.float32), np.ones(len(gaussians), bool))
    densifier.after_step(0)
    return parameters.to_set()


def test_small_splats_with_large_gradients_are_cloned_in_place():
    result = densified(a_set(), EVERY, [2, 0, 0, 2, 0, 0])
    assert len(result) == 8
    np.testing.assert_allclose(result.means[6:], a_set().means[[0, 3]])
    np.testing.assert_allclose(result.scales, 0.01, rtol=1e-5)


def test_large_splats_with_large_gradients_are_split_into_two_smaller_ones():
    result = densified(a_set(scale=0.5), EVERY, [2, 0, 0, 0, 0, 0])
    assert len(result) == 7
    np.testing.assert_allclose(result.scales[5:], 0.5 / 1.6, rtol=1e-5)
    assert np.all(np.linalg.norm(result.means[5:] - a_set().means[0], axis=1) < 5 * 0.5)
    assert not np.array_equal(result.means[5], result.means[6])


@pytest.mark.parametrize("scale", [0.01, 0.5])
@pytest.mark.parametrize("split", ["drawn", "along"])
def test_shared_density_keeps_the_attenuation_of_clones_and_splits(scale, split):
    gaussians = a_set(scale=scale)
    result = densified(gaussians, replace(EVERY, split=split, share_density=True), [2] * 6)
    assert len(result) == 12
    masses = [(one.density * one.scales.prod(axis=1)).sum() for one in (gaussians, result)]
    assert masses[1] == pytest.approx(masses[0], rel=1e-4)


def test_a_split_along_the_longest_axis_keeps_mean_and_covariance():
    quat = np.array([[0.5, 0.3, -0.7, 0.2]])
    parent = GaussianSet.create(np.ones((1, 3)), np.array([[0.2, 0.9, 0.4]]), quats=quat, opacities=0.5)
    result = densified(parent, replace(EVERY, split="along"), [2])
    assert len(result) == 2
    np.testing.assert_allclose(result.means.mean(axis=0), [1, 1, 1], rtol=1e-5)
    apart = result.means - result.means.mean(axis=0)
    between = np.einsum("ni,nj->ij", apart, apart) / 2
    np.testing.assert_allclose(
        result.covariances().mean(axis=0) + between, parent.covariances()[0], rtol=1e-3, atol=1e-5
    )
    assert (result.scales.max(axis=1) < 0.9).all()


def test_clear_splats_and_those_outside_the_box_are_dropped():
    gaussians = a_set()
    gaussians.opacities[2] = 0.001
    box = np.array([[-1, -1, -1], [13, 13, 14.5]])
    result = densified(gaussians, EVERY, [0] * 6, box)
    np.testing.assert_allclose(result.means, a_set().means[[0, 1, 3, 4]])


@pytest.mark.parametrize("split", ["along", "drawn"])
def test_what_is_to_be_dropped_has_no_children_however_large_its_gradient(split):
    """Of a holder that goes on beyond the box rays show the largest differences."""
    gaussians = a_set()
    gaussians.scales[:] = 1.0
    gaussians.opacities[2], gaussians.density[3], gaussians.means[5, 2] = 0.001, 1e-6, 100.0
    box = np.array([[-1, -1, -1], [99, 99, 99]])
    rule = replace(EVERY, split=split, prune_density=1e-4, clone_size=0.01)
    result = densified(gaussians, rule, [0, 0, 9, 9, 5, 9], box)
    assert len(result) == 3 + 1
    assert result.means[:, 2].max() < 99
    assert result.density.min() > 1e-6


def test_thin_splats_are_dropped():
    gaussians = a_set()
    gaussians.density[1] = 1e-6
    result = densified(gaussians, replace(EVERY, prune_density=1e-4), [0] * 6)
    assert len(result) == 5


def test_the_cap_takes_the_largest_gradients_first():
    result = densified(a_set(), replace(EVERY, most=8), [2, 5, 3, 4, 2, 2])
    assert len(result) == 8
    np.testing.assert_allclose(result.means[6:], a_set().means[[1, 3]])


def test_a_full_set_gets_nothing_more():
    assert len(densified(a_set(), replace(EVERY, most=3), [9] * 6)) == 6


def test_gradients_are_means_over_the_views_that_show_a_splat():
    parameters = Parameters(a_set(2), GROUPS)
    densifier = Densifier(replace(EVERY, every=3), parameters, 1.0, 100, 0)
    for gradients, visible in (([3.0, 3.0], [True, True]), ([0.0, 9.0], [True, False]), ([0.0, 9.0], [True, False])):
        densifier.observe(np.array(gradients, np.float32), np.array(visible))
    densifier.after_step(2)
    assert len(parameters) == 3, "a mean of 1 is not above the threshold of 1, a mean of 3 is"


def test_gradients_by_pixels_count_in_normalised_device_coordinates():
    gaussians = GaussianSet.create(np.zeros((3, 3)), 0.1)
    one, two = (Densifier(DefaultStrategy(), Parameters(gaussians, GROUPS), 1.0, 100, 0) for _ in range(2))
    by_pixels = np.array([[3e-3, 4e-3], [1.0, 2.0], [0.0, 5e-3]], np.float32)
    visible = np.array([True, False, True])
    for _ in range(2):
        one.observe_pixels(by_pixels, visible, 40, 30)
        two.observe(np.linalg.norm(by_pixels * np.float32([20, 15]), axis=1), visible)
    for name in ("sum", "count"):
        np.testing.assert_allclose(one.state()[name], two.state()[name], rtol=1e-6)
    assert one.state()["count"].tolist() == [2, 0, 2]


def test_resets_only_lower_opacities():
    gaussians = a_set()
    gaussians.opacities[0] = 0.006
    parameters = Parameters(gaussians, GROUPS)
    densifier = Densifier(replace(EVERY, every=1000, reset_every=5), parameters, 1.0, 100, 0)
    densifier.after_step(4)
    np.testing.assert_allclose(parameters.to_set().opacities, [0.006, *[0.01] * 5], rtol=1e-3)


def test_an_empty_set_is_left_empty():
    assert len(densified(GaussianSet.empty(), EVERY, np.zeros(0))) == 0


def test_with_fewer_iterations_splats_are_added_as_often():
    for strategy in (DefaultStrategy(every=100), McmcStrategy(every=100)):
        assert strategy.sooner(0.5) == replace(strategy, every=50)
        assert strategy.sooner(1e-3).every == 20, "fewer views tell too little"
        assert strategy.sooner(1.0) == strategy.sooner(4.0) == strategy
    assert DefaultStrategy(every=7).sooner(0.1).every == 7
    masked = MaskStrategy().sooner(0.5)
    assert (masked.every, masked.densify.every) == (50, 50)
    assert masked.rate == 2 * MaskStrategy.rate, "as far to go in half of the steps"


def test_a_short_training_reaches_the_number_of_splats_that_a_long_one_does():
    rule = DefaultStrategy(gradient=0.0, budget=True, most=40, clone_size=1.0, prune_opacity=0.0)

    def made(iterations, strategy):
        parameters = Parameters(a_set(5), GROUPS)
        densifier = Densifier(strategy, parameters, extent=1.0, iterations=iterations, seed=0)
        for iteration in range(iterations):
            densifier.observe(np.ones(len(parameters), np.float32), np.ones(len(parameters), bool))
            densifier.after_step(iteration)
        return len(parameters)

    assert made(2000, rule) == made(400, rule.sooner(0.2)) == 40
    assert made(400, rule) == 20


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"split": "alogn"}, "split is 'alogn'; choose drawn or along"),
        ({"every": 0}, "every is 0; choose 1 iteration or more"),
        ({"share_density": True, "halve_density": True}, "both on; choose one of them"),
    ],
)
def test_rules_that_there_are_not_are_refused_before_a_run(wrong, told):
    with pytest.raises(SettingError, match=told):
        DefaultStrategy(**wrong)


def test_a_strategy_says_what_adds_splats_and_takes_a_limit():
    usual, relocating = DefaultStrategy(most=500), McmcStrategy(most=500)
    masked = MaskStrategy(densify=usual)
    assert (usual.densify, relocating.densify, masked.densify) == (usual, relocating, usual)
    for strategy in (usual, relocating, masked):
        assert strategy.at_most(200).densify.most == 200
        assert strategy.at_most(900) == strategy
