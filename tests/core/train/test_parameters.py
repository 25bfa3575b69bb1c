"""Raw parameters: there and back, one step as torch's Adam makes it, surgery that keeps the moments."""

from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest
import torch

from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.train.parameters import GROUPS, Parameters, ScaleLimits, Separate, inverse_softplus

ALL = GROUPS


@pytest.fixture
def gaussians():
    rng = np.random.default_rng(5)
    return GaussianSet.create(
        rng.normal(size=(9, 3)),
        rng.uniform(0.01, 3.0, (9, 3)),
        quats=rng.normal(size=(9, 4)),
        opacities=rng.uniform(0.01, 0.99, 9),
        sh=rng.normal(size=(9, 4, 3)),
        density=rng.uniform(1e-4, 0.3, 9),
        modality=Modality.XRAY,
    )


def random_gradients(parameters, seed):
    rng = np.random.default_rng(seed)
    for name in parameters.trained:
        parameters.gradient(name)[...] = rng.normal(size=parameters.gradient(name).shape)


def test_raw_and_back_is_the_same_set(gaussians):
    back = Parameters(gaussians, ALL, density_unit=0.05).to_set()
    for name in ("means", "scales", "opacities", "sh", "density", "modality"):
        np.testing.assert_allclose(getattr(back, name), getattr(gaussians, name), rtol=2e-4, atol=1e-7)
    np.testing.assert_allclose(back.quats, gaussians.quats, atol=1e-6)


def test_inverse_softplus_holds_at_both_ends():
    values = np.array([1e-9, 6e-8, 1e-3, 1.0, 89.0, 1e4])
    raw = inverse_softplus(values)
    assert np.all(np.isfinite(raw))
    np.testing.assert_allclose(np.logaddexp(0, raw), values, rtol=1e-6)


def test_gradients_reach_the_flat_buffer(gaussians):
    parameters = Parameters(gaussians, ALL)
    active = parameters.activate()
    (active.means.sum() + 2 * active.density.sum() + active.sh.sum()).backward()
    np.testing.assert_allclose(parameters.gradient("means"), 1.0)
    np.testing.assert_allclose(parameters.gradient("sh_rest"), 1.0)
    assert (parameters.gradient("density") > 0).all()
    parameters.zero_grad()
    assert not parameters.gradient("means").any()


def test_gradients_are_those_of_torch_s_own_functions(gaussians):
    parameters = Parameters(gaussians, ALL, density_unit=0.05)
    rng = np.random.default_rng(3)
    names = ("means", "quats", "scales", "opacities", "sh", "density")
    weights = {name: torch.from_numpy(rng.normal(size=getattr(gaussians, name).shape)) for name in names}
    for _ in range(2):
        active = parameters.activate()
        sum((weights[name] * getattr(active, name)).sum() for name in names).backward()
    raw = {name: parameters.raw[name].detach().double().requires_grad_(True) for name in ALL}
    twin = {
        "means": raw["means"],
        "quats": raw["quats"],
        "scales": raw["scales"].exp(),
        "opacities": torch.sigmoid(raw["opacities"]),
        "sh": torch.cat([raw["sh_dc"], raw["sh_rest"]], dim=1),
        "density": 0.05 * torch.nn.functional.softplus(raw["density"]),
    }
    (2 * sum((weights[name] * twin[name]).sum() for name in names)).backward()
    for name in ALL:
        np.testing.assert_allclose(parameters.gradient(name), raw[name].grad, rtol=1e-4, atol=1e-6)


def test_without_harmonics_all_else_is_the_same(gaussians):
    whole, bare = Parameters(gaussians, ALL), Parameters(gaussians, ALL)
    for parameters, active in ((whole, whole.activate()), (bare, bare.activate(harmonics=False))):
        sum(
            (getattr(active, name) ** 2).sum() for name in ("means", "quats", "scales", "opacities", "density")
        ).backward()
        assert not parameters.gradient("sh_rest").any()
    assert active.sh.shape[1] == 1
    for name in ALL:
        np.testing.assert_array_equal(whole.gradient(name), bare.gradient(name))
    active.sh.sum().backward()
    np.testing.assert_array_equal(bare.gradient("sh_dc"), 1.0)
    assert not bare.gradient("sh_rest").any()


@pytest.mark.parametrize("trained", [("sh_dc",), ("sh_rest",), ("means", "scales", "sh_dc"), ("quats",)])
def test_only_trained_groups_get_gradients(gaussians, trained):
    parameters = Parameters(gaussians, trained)
    active = parameters.activate()
    fields = ("means", "quats", "scales", "opacities", "sh")
    assert {name for name in fields if getattr(active, name).requires_grad} == {
        name[:2] if name[:2] == "sh" else name for name in trained
    }
    sum(getattr(active, name).sum() for name in fields).backward()
    for name in ALL:
        assert (parameters.raw[name].grad is not None) == (name in trained)
    np.testing.assert_allclose(parameters.gradient(trained[-1]), 1.0)


def test_a_gradient_for_one_group_alone_leaves_the_others(gaussians):
    parameters = Parameters(gaussians, ALL)
    for _ in range(2):
        parameters.activate().quats[:, 1].sum().backward()
    np.testing.assert_array_equal(parameters.gradient("quats"), np.tile(np.float32([0, 2, 0, 0]), (9, 1)))
    assert not any(parameters.gradient(name).any() for name in ALL if name != "quats")


def test_the_exponential_is_that_of_float64_and_nan_stays():
    from numba import njit

    from insideout.core.train.activation import exponential

    @njit
    def every(values, results):
        for i in range(values.size):
            results[i] = exponential(values[i])

    values = np.linspace(-87, 87, 100_001, dtype=np.float32)
    results = np.empty_like(values)
    every(values, results)
    np.testing.assert_allclose(results, np.exp(values.astype(np.float64)), rtol=1e-7)
    ends = np.array([0.0, np.nan, -np.inf, np.inf], np.float32)
    every(ends, results)
    np.testing.assert_allclose(results[:4], [1.0, np.nan, np.exp(-87.0), np.exp(87.0)], rtol=1e-6)


@pytest.mark.parametrize("finite", [True, False])
def test_a_step_leaves_no_gradient_behind(gaussians, finite):
    parameters = Parameters(gaussians, ALL)
    random_gradients(parameters, 0)
    if not finite:
        parameters.gradient("opacities")[0] = np.nan
    assert parameters.step({"means": 0.1}) == finite
    assert not any(parameters.gradient(name).any() for name in ALL)


@pytest.mark.parametrize("memory", [0.999, 0.9])
def test_steps_are_those_of_torch_s_adam(gaussians, memory):
    parameters = Parameters(gaussians, ALL, memory=memory)
    twins = {name: parameters.raw[name].detach().clone().requires_grad_(True) for name in ALL}
    rates = {name: 10.0 ** -(1 + i % 3) for i, name in enumerate(ALL)}
    adam = torch.optim.Adam(
        [{"params": [twins[name]], "lr": rates[name]} for name in ALL], betas=(0.9, memory), eps=1e-15
    )
    for step in range(5):
        random_gradients(parameters, step)
        for name in ALL:
            twins[name].grad = torch.from_numpy(parameters.gradient(name).copy())
        adam.step()
        assert parameters.step(rates)
    for name in ALL:
        np.testing.assert_allclose(parameters.raw[name].detach(), twins[name].detach(), rtol=2e-4, atol=2e-5)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_gradient_that_is_not_finite_changes_nothing(gaussians, bad):
    parameters = Parameters(gaussians, ALL)
    before = parameters.to_set()
    random_gradients(parameters, 0)
    parameters.gradient("scales")[3, 1] = bad
    assert not parameters.step(dict.fromkeys(ALL, 0.1))
    np.testing.assert_array_equal(parameters.to_set().means, before.means)
    assert parameters.steps == 0


def test_groups_that_are_not_trained_stay(gaussians):
    parameters = Parameters(gaussians, ("means",))
    before = parameters.to_set()
    random_gradients(parameters, 1)
    parameters.step(dict.fromkeys(ALL, 0.1))
    after = parameters.to_set()
    assert not np.array_equal(after.means, before.means)
    np.testing.assert_array_equal(after.density, before.density)
    np.testing.assert_array_equal(after.sh, before.sh)


@pytest.mark.parametrize("trained", [("means",), ALL])
def test_what_x_rays_do_not_see_has_no_density(gaussians, trained):
    """Not a little of it: surfaces and weights go by whether there is any."""
    mixed = replace(gaussians, density=np.where(np.arange(9) < 4, 0, gaussians.density).astype(np.float32))
    parameters = Parameters(mixed, trained)
    np.testing.assert_array_equal(parameters.to_set().density == 0, np.arange(9) < 4)
    if "density" in trained:
        parameters.gradient("density")[...] = -1.0
        parameters.step(dict.fromkeys(ALL, 5.0))
        assert (parameters.to_set().density > 0).all()


def test_scales_stay_within_their_limits(gaussians):
    parameters = Parameters(gaussians, ("scales",), limits=ScaleLimits(0.05, 2.0))
    for _ in range(20):
        parameters.gradient("scales")[...] = np.where(np.arange(9)[:, None] % 2, 1.0, -1.0)
        parameters.step({"scales": 1.0})
    scales = parameters.to_set().scales
    assert scales.min() == pytest.approx(0.05, rel=1e-5)
    assert scales.max() == pytest.approx(2.0, rel=1e-5)


def test_parameters_on_any_number_of_threads_have_the_same_bits():
    """More splats than a task has, and one of them left over."""
    import numba

    count = 2 * 2048 + 1
    rng = np.random.default_rng(0)
    many = GaussianSet.create(
        rng.normal(size=(count, 3)), 0.1, opacities=rng.uniform(0.1, 0.9, count), sh=rng.normal(size=(count, 9, 3))
    )
    weights = torch.from_numpy(rng.normal(size=(count, 9, 3)).astype(np.float32))
    threads, found = numba.get_num_threads(), []
    try:
        for some in (1, threads):
            numba.set_num_threads(some)
            parameters = Parameters(many, ALL)
            for _ in range(3):
                active = parameters.activate()
                (
                    (weights * active.sh).sum() + (active.scales**2).sum() + (active.means * active.quats[:, 1:]).sum()
                ).backward()
                parameters.step(dict.fromkeys(ALL, 0.1))
            assert numba.get_num_threads() == some
            found.append(parameters._values.tobytes())
    finally:
        numba.set_num_threads(threads)
    assert len(set(found)) == 1


def test_surgery_keeps_the_moments_of_those_that_stay(gaussians):
    parameters = Parameters(gaussians, ALL)
    random_gradients(parameters, 2)
    parameters.step(dict.fromkeys(ALL, 0.01))
    before = parameters.state()
    keep = np.arange(9) % 3 != 0
    parameters.replace_rows(keep, gaussians.select(slice(0, 2)), {})
    after = parameters.state()
    assert len(parameters) == 8
    np.testing.assert_array_equal(after["raw"]["means"][:6], before["raw"]["means"][keep])
    first = after["first"][:24].reshape(8, 3)
    np.testing.assert_array_equal(first[:6], before["first"][:27].reshape(9, 3)[keep])
    assert not first[6:].any()


def test_surgery_down_to_nothing_and_up_again(gaussians):
    parameters = Parameters(gaussians, ALL)
    parameters.replace_rows(np.zeros(9, bool), gaussians.select(slice(0, 0)), {})
    assert len(parameters) == 0
    assert parameters.step(dict.fromkeys(ALL, 0.1))
    parameters.replace_rows(np.zeros(0, bool), gaussians, {})
    np.testing.assert_allclose(parameters.to_set().means, gaussians.means)


def test_a_restored_state_goes_on_bit_for_bit(gaussians):
    one, two = Parameters(gaussians, ALL), Parameters(gaussians.select(slice(0, 3)), ALL)
    random_gradients(one, 0)
    one.step(dict.fromkeys(ALL, 0.1))
    two.restore(one.state())
    for parameters in (one, two):
        random_gradients(parameters, 1)
        parameters.step(dict.fromkeys(ALL, 0.1))
    np.testing.assert_array_equal(one.state()["first"], two.state()["first"])
    np.testing.assert_array_equal(one.to_set().scales, two.to_set().scales)


class TestSeparateSteps:
    """Some groups of the first splats with steps of their own."""

    GROUPS = ("means", "scales", "opacities")
    RATES: ClassVar = {"means": 0.01, "scales": 0.02, "opacities": 0.03}

    @pytest.fixture
    def parts(self, gaussians):
        separate = Parameters(gaussians, self.GROUPS, separate=Separate(2, ("means", "scales"), 0.9))
        alone = Parameters(gaussians.select(slice(0, 2)), ("means", "scales"), memory=0.9)
        return separate, alone

    @staticmethod
    def push(parameters, seed):
        rng = np.random.default_rng(seed)
        for name in parameters.trained:
            gradient = parameters.gradient(name)
            gradient[:2] += rng.normal(size=gradient[:2].shape)
            gradient[2:] += 1.0

    def test_they_step_as_they_would_alone(self, parts):
        separate, alone = parts
        for seed in range(3):
            self.push(separate, seed)
            self.push(alone, seed)
            assert separate.step_separate(self.RATES)
            alone.step(self.RATES)
            # Other gradients wait for `step`.
            assert (separate.gradient("means")[:2] == 0).all()
            assert (separate.gradient("means")[2:] != 0).all()
            assert (separate.gradient("opacities") != 0).all()
            separate.step(self.RATES)
        for name in ("means", "scales"):
            np.testing.assert_array_equal(separate.raw[name].detach()[:2], alone.raw[name].detach())
        assert separate.steps == separate.steps_separate == 3

    def test_a_step_of_the_rest_leaves_them_alone(self, parts):
        separate, _ = parts
        before = {name: separate.raw[name].detach().clone() for name in self.GROUPS}
        self.push(separate, 0)
        separate.step(self.RATES)
        for name in ("means", "scales"):
            assert torch.equal(separate.raw[name][:2], before[name][:2])
            assert (separate.raw[name][2:] != before[name][2:]).all()
            assert (separate.gradient(name) == 0).all()
        assert (separate.raw["opacities"] != before["opacities"]).all()

    def test_a_gradient_that_is_no_number_moves_nothing(self, parts):
        separate, _ = parts
        before = separate.raw["means"].detach().clone()
        self.push(separate, 0)
        separate.gradient("scales")[1, 0] = np.nan
        assert not separate.step_separate(self.RATES)
        assert torch.equal(separate.raw["means"].detach(), before)
        assert (separate.gradient("scales")[:2] == 0).all()
        assert separate.step(self.RATES)

    def test_broken_off_they_go_on_alike(self, parts, gaussians):
        separate, _ = parts
        self.push(separate, 0)
        separate.step_separate(self.RATES)
        again = Parameters(gaussians, self.GROUPS, separate=Separate(2, ("means", "scales"), 0.9))
        again.restore(separate.state())
        for parameters in (separate, again):
            parameters.zero_grad()
            self.push(parameters, 1)
            parameters.step_separate(self.RATES)
        assert torch.equal(again.raw["means"], separate.raw["means"])
        assert again.steps_separate == 2

    def test_their_scales_stay_within_the_limits(self, gaussians):
        limits = ScaleLimits(0.05, 2.0)
        separate = Parameters(gaussians, ("scales",), limits=limits, separate=Separate(2, ("scales",)))
        separate.gradient("scales")[:2] = [[1.0], [-1.0]]
        separate.step_separate({"scales": 100.0})
        scales = separate.to_set().scales
        np.testing.assert_allclose(scales[0], 0.05, rtol=1e-5)
        np.testing.assert_allclose(scales[1], 2.0, rtol=1e-5)

    @pytest.mark.parametrize("separate", [Separate(10**6, ("means",)), Separate(1, ("density",))])
    def test_what_is_not_there_or_not_trained_cannot_have_steps(self, gaussians, separate):
        with pytest.raises(ValueError, match="are trained"):
            Parameters(gaussians, ("means",), separate=separate)

    def test_their_rows_are_not_replaced(self, parts, gaussians):
        separate, _ = parts
        with pytest.raises(ValueError, match="steps of their own"):
            separate.replace_rows(np.ones(len(separate), bool), gaussians.select(slice(0, 0)), {})
