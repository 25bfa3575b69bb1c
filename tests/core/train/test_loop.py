"""The loop: stopped anywhere and started again, it ends with the same bits."""

import time

import numpy as np
import pytest
import torch
from numba.core import event

from insideout.core.errors import Cancelled
from insideout.core.gaussians import GaussianSet
from insideout.core.progress import Reporter, unstopped
from insideout.core.train.loop import Task, optimise
from insideout.core.train.parameters import Parameters
from insideout.core.train.schedule import Decay, Growth, active_degree
from insideout.core.train.strategy import DefaultStrategy, Densifier

STEPS = 40


class Toy:
    """Pulls means to the origin, with noise that depends on the iteration, and densifies on the way."""

    def __init__(self, bad_at=()):
        rng = np.random.default_rng(1)
        gaussians = GaussianSet.create(rng.normal(size=(5, 3)), 0.3, opacities=0.5)
        self.parameters = Parameters(gaussians, ("means", "scales"))
        strategy = DefaultStrategy(start=0.0, stop=1.0, every=10, gradient=0.1, most=20)
        self.densifier = Densifier(strategy, self.parameters, 1.0, STEPS, 0)
        self.bad_at = bad_at

    def __len__(self):
        return len(self.parameters)

    def step(self, iteration):
        noise = np.random.default_rng(iteration).normal()
        loss = (self.parameters.activate().means ** 2).sum() * (1 + 0.1 * noise)
        loss.backward()
        if iteration in self.bad_at:
            self.parameters.gradient("means")[0, 0] = np.nan
        lengths = np.linalg.norm(self.parameters.gradient("means"), axis=1)
        if not self.parameters.step({"means": 0.01, "scales": 0.01}):
            return float("nan")
        self.densifier.observe(lengths, np.ones(len(self.parameters), bool))
        self.densifier.after_step(iteration)
        return float(loss.detach())

    def measure(self, tick=unstopped):
        tick()
        return {"sections": -float(self.parameters.activate().means.detach().norm())}

    def state(self):
        return {"parameters": self.parameters.state(), "densifier": self.densifier.state()}

    def restore(self, state):
        self.parameters.restore(state["parameters"])
        self.densifier.restore(state["densifier"])


def without_seconds(history):
    """What is the same however often a run was broken off."""
    points = [{name: value for name, value in point.items() if name != "seconds"} for point in history["heldout"]]
    return {**history, "heldout": points}


def cancel_after(steps):
    count = iter(range(10**6))
    return Reporter(is_cancelled=lambda: next(count) >= steps)


@pytest.mark.parametrize("stops", [(17,), (10,), (3, 20), (39,)], ids=str)
def test_broken_off_and_resumed_is_bit_for_bit_the_unbroken_run(stops, tmp_path):
    whole = Toy()
    expected = optimise(whole, Task("surface", "toy", STEPS), Reporter())
    task = Task("surface", "toy", STEPS, checkpoint=tmp_path / "toy.checkpoint.pt")
    for stop in stops:
        with pytest.raises(Cancelled):
            optimise(Toy(), task, cancel_after(stop))
    resumed = Toy()
    history = optimise(resumed, task, Reporter())
    assert len(whole) == len(resumed) > 5
    np.testing.assert_array_equal(whole.parameters.to_set().means, resumed.parameters.to_set().means)
    np.testing.assert_array_equal(whole.parameters.to_set().scales, resumed.parameters.to_set().scales)
    assert history.pop("seconds") > 0
    assert expected.pop("seconds") > 0
    assert without_seconds(history) == without_seconds(expected)


class Slow(Toy):
    """Is asked to stop while it is measured for the `at`-th time."""

    def __init__(self, at):
        super().__init__()
        self.at, self.measured, self.stopped = at, 0, False

    def measure(self, tick=unstopped):
        self.measured += 1
        self.stopped = self.measured == self.at
        return super().measure(tick)


@pytest.mark.parametrize("at", [1, 2, 4])
def test_cancelled_while_it_is_measured_it_stops_at_once_and_measures_that_later(at, tmp_path):
    expected = optimise(Toy(), Task("surface", "toy", STEPS), Reporter())
    task = Task("surface", "toy", STEPS, checkpoint=tmp_path / "toy.checkpoint.pt")
    slow = Slow(at)
    with pytest.raises(Cancelled):
        optimise(slow, task, Reporter(is_cancelled=lambda: slow.stopped))
    resumed = optimise(Toy(), task, Reporter())
    assert without_seconds(resumed)["heldout"] == without_seconds(expected)["heldout"]
    assert resumed["losses"] == expected["losses"]


def test_a_step_that_is_not_finite_is_left_out_and_counted():
    toy = Toy(bad_at={3, 4})
    history = optimise(toy, Task("surface", "toy", STEPS), Reporter())
    assert history["skipped_steps"] == 2
    assert np.isfinite(toy.parameters.to_set().means).all()


def good_checkpoint(path):
    with pytest.raises(Cancelled):
        optimise(Toy(), Task("surface", "toy", STEPS, checkpoint=path), cancel_after(15))
    return path.read_bytes()


def of_another_trainer(path):
    """Whole, but its trainer's state breaks off half way through `restore`."""
    good_checkpoint(path)
    content = torch.load(path, weights_only=True)
    del content["trainer"]["densifier"]["sum"]
    torch.save(content, path)
    return path.read_bytes()


DAMAGE = {
    "a few bytes": lambda path: b"half a checkpo",
    "empty": lambda path: b"",
    "zeros": lambda path: bytes(4096),
    "noise": lambda path: np.random.default_rng(0).bytes(4096),
    "cut in half": lambda path: good_checkpoint(path)[: len(good_checkpoint(path)) // 2],
    "of another trainer": of_another_trainer,
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_checkpoint_costs_time_not_the_run(damage, tmp_path):
    path = tmp_path / "toy.checkpoint.pt"
    path.write_bytes(DAMAGE[damage](path))
    toy = Toy()
    optimise(toy, Task("surface", "toy", STEPS, checkpoint=path), Reporter())
    whole = Toy()
    optimise(whole, Task("surface", "toy", STEPS), Reporter())
    np.testing.assert_array_equal(whole.parameters.to_set().means, toy.parameters.to_set().means)


class Failing(Toy):
    """Breaks off in the middle of a step, after the parameters moved."""

    def step(self, iteration):
        loss = super().step(iteration)
        if iteration == 20:
            raise KeyboardInterrupt
        return loss


def test_half_a_step_is_never_saved(tmp_path):
    path = tmp_path / "toy.checkpoint.pt"
    kept = good_checkpoint(path)
    with pytest.raises(KeyboardInterrupt):
        optimise(Failing(), Task("surface", "toy", STEPS, checkpoint=path), Reporter())
    assert path.read_bytes() == kept


def test_a_checkpoint_of_other_settings_is_not_used(tmp_path):
    path = tmp_path / "toy.checkpoint.pt"
    optimise(Toy(), Task("surface", "toy", 10, checkpoint=path), Reporter())
    history = optimise(Toy(), Task("surface", "toy", STEPS, checkpoint=path), Reporter())
    assert history["losses"][0][0] == 0


@pytest.mark.parametrize("steps", [1, 40, 100, 101, 150, 199, 200, 1099])
def test_losses_are_kept_of_up_to_a_hundred_steps(steps):
    class Idle(Toy):
        def step(self, iteration):
            return 1.0

    losses = optimise(Idle(), Task("surface", "toy", steps), Reporter())["losses"]
    assert min(steps, 50) <= len(losses) <= 100
    assert losses[0] == [0, 1.0]


def test_progress_tells_iteration_loss_splats_and_held_out_psnr():
    heard = []
    optimise(Toy(), Task("surface", "toy", STEPS, first=0.5, last=1.0, measures=2), Reporter(heard.append))
    assert heard[0].iterations == STEPS
    assert 0.5 <= heard[0].fraction < 0.6
    assert [p.iteration for p in heard if p.heldout_psnr is not None] == [20, 40]
    assert heard[-1].splats > 5


def test_progress_tells_each_point_of_the_curve_when_it_is_measured():
    heard = []
    history = optimise(Toy(), Task("surface", "toy", STEPS, measures=2), Reporter(heard.append))
    told = [p.heldout for p in heard if p.heldout is not None]
    assert told == [[point] for point in history["heldout"]]
    assert len(told) == 2


def test_an_optimisation_that_goes_on_tells_the_earlier_points_first(tmp_path):
    task = Task("surface", "toy", STEPS, checkpoint=tmp_path / "toy.checkpoint.pt")
    with pytest.raises(Cancelled):
        optimise(Toy(), task, cancel_after(15))
    heard = []
    history = optimise(Toy(), task, Reporter(heard.append))
    first, *rest = [p.heldout for p in heard if p.heldout is not None]
    assert first
    assert first == history["heldout"][: len(first)]
    assert rest == [[point] for point in history["heldout"][len(first) :]]


def test_rates_fall_exponentially():
    rate = Decay(1e-2, 1e-4)
    assert rate.at(0.0) == pytest.approx(1e-2)
    assert rate.at(0.5) == pytest.approx(1e-3)
    assert rate.at(2.0) == pytest.approx(1e-4)
    assert Decay(0.3).at(0.7) == 0.3


def test_images_and_harmonics_grow():
    growth = Growth(((0.2, 0.25), (0.5, 0.5)))
    assert [growth.share(f) for f in (0.0, 0.19, 0.2, 0.5, 1.0)] == [0.25, 0.25, 0.5, 1.0, 1.0]
    assert [active_degree(i, 1000, 3) for i in (0, 999, 1000, 9999)] == [0, 0, 1, 3]


def test_before_the_first_step_the_user_is_told_that_kernels_compile(monkeypatch):
    monkeypatch.setattr("insideout.core.render.kernels.cpu._on_disk", lambda kernel: False)
    told = []
    for renderers in ((), ("splat",)):
        optimise(Toy(), Task("surface", "toy", STEPS, 0.5, renderers=renderers), Reporter(told.append))
    assert [(now.iteration, now.fraction) for now in told if now.message == "compiling kernels, once"] == [(0, 0.5)]


def test_seconds_of_compiling_kernels_are_none_of_the_training():
    class Compiles(Toy):
        def step(self, iteration):
            if iteration == 0:
                with event.trigger_event("numba:compiler_lock"):
                    time.sleep(0.5)
            return super().step(iteration)

    begun = time.perf_counter()
    seconds = optimise(Compiles(), Task("surface", "toy", STEPS), Reporter())["seconds"]
    assert 0 < seconds <= time.perf_counter() - begun - 0.5
