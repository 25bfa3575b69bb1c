"""Fewer steps for the same picture: a budget of splats that grows, and stopping when the curve is flat."""

import numpy as np
import pytest

from insideout.core.gaussians import GaussianSet
from insideout.core.progress import Reporter, unstopped
from insideout.core.train.loop import Task, optimise
from insideout.core.train.parameters import GROUPS, Parameters
from insideout.core.train.schedule import Stop
from insideout.core.train.strategy import DefaultStrategy, Densifier

SOON = Stop(every=0.1, gain_db=0.1, patience=2, least=0.2)


class Curve:
    """A trainer whose quality follows a list, one value for each look."""

    def __init__(self, values):
        self.values, self.steps, self.looks = values, 0, 0

    def __len__(self):
        return 1

    def step(self, iteration):
        self.steps += 1
        return 1.0

    def measure(self, tick=unstopped):
        return {}

    def validate(self, tick=unstopped):
        self.looks += 1
        return self.values[self.looks - 1]

    def state(self):
        return {"looks": self.looks}

    def restore(self, state):
        self.looks = state["looks"]


def run(values, checkpoint=None, stop=SOON):
    trainer = Curve(values)
    return trainer, optimise(trainer, Task("surface", "rgb", 100, stop=stop, checkpoint=checkpoint), Reporter())


def test_a_flat_curve_ends_the_optimisation():
    """Looks at 20, 30, 40, ...; 21 dB at 30 is the best, 40 and 50 add less than 0.1 dB."""
    trainer, report = run([20.0, 21.0, 21.05, 21.09, 99.0])
    assert report["iterations"] == trainer.steps == 50
    assert report["validation"] == [[20, 20.0], [30, 21.0], [40, 21.05], [50, 21.09]]


def test_a_rising_curve_does_not():
    trainer, report = run([20.0 + look for look in range(9)])
    assert report["iterations"] == trainer.steps == 100


def test_without_the_option_nobody_looks():
    trainer, report = run([20.0] * 9, stop=None)
    assert (trainer.steps, trainer.looks) == (100, 0)
    assert "validation" not in report


def test_what_has_ended_does_not_go_on_when_it_is_resumed(tmp_path):
    first = run([20.0] * 9, tmp_path / "checkpoint.pt")[1]
    again, report = run([20.0] * 9, tmp_path / "checkpoint.pt")
    assert again.steps == 0
    assert report == first


@pytest.mark.parametrize(("count", "expected"), [(40, [5, 15, 25, 35]), (5, [1, 2, 4]), (3, [2]), (2, []), (0, [])])
def test_views_set_aside_are_spread_and_leave_two(count, expected):
    assert Stop(views=4).set_aside(count) == expected


def grown(budget, done, gradients=10.0):
    rule = DefaultStrategy(start=0.0, stop=1.0, every=1, gradient=1.0, most=60, budget=budget)
    start = GaussianSet.create(np.arange(60).reshape(20, 3), 0.001, opacities=0.5)
    parameters = Parameters(start, GROUPS)
    densifier = Densifier(rule, parameters, extent=1.0, iterations=100, seed=0)
    densifier.observe(np.full(20, gradients, np.float32), np.ones(20, bool))
    densifier.after_step(done - 1)
    return len(parameters)


def test_a_budget_grows_evenly_to_the_largest_number():
    assert [grown(True, done) for done in (1, 10, 25, 100)] == [20, 24, 30, 40]


def test_without_a_budget_the_largest_number_counts_at_once():
    assert grown(False, 1) == 40
