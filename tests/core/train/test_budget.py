"""How many iterations fit into a time, and that a run taken up again hears the same number."""

import json

import numpy as np
import pytest

from insideout.core.compare.study import next_guess
from insideout.core.errors import Cancelled, SettingError
from insideout.core.progress import Reporter
from insideout.core.train.budget import iterations_for


class Clock:
    """Seconds that pass only while a `Stepper` works."""

    def __init__(self):
        self.now = 50.0

    def __call__(self):
        return self.now


class Stepper:
    """A trainer whose steps take a known time; the first ones compile."""

    def __init__(self, clock, seconds, first=20.0):
        self.clock, self.seconds, self.first, self.seen = clock, seconds, first, []

    def step(self, iteration):
        self.seen.append(iteration)
        self.clock.now += self.first if iteration == 0 else self.seconds
        # Every fourth step costs twice as much.
        self.clock.now += self.seconds if iteration % 4 == 3 else 0.0
        return 0.0


@pytest.fixture
def clock():
    return Clock()


def test_the_number_fits_the_time_and_compiling_does_not_count(clock):
    trainer = Stepper(clock, 0.01)
    found = iterations_for(60.0, lambda: trainer, clock=clock)
    assert found == pytest.approx(60.0 / 0.0125, rel=0.02)
    assert trainer.seen == list(range(len(trainer.seen)))
    assert clock.now - 50.0 - 20.0 == pytest.approx(0.03 * 60, rel=0.05)


def test_slow_trainers_are_timed_for_ten_steps_and_limits_hold(clock):
    slow = Stepper(clock, 30.0)
    assert iterations_for(60.0, lambda: slow, least=7, clock=clock) == 7
    assert len(slow.seen) == 13
    assert iterations_for(60.0, lambda: Stepper(clock, 1e-5), most=900, clock=clock) == 900


def test_a_run_taken_up_again_hears_the_same_number(clock, tmp_path):
    kept = tmp_path / "rows" / "budget.json"
    first = iterations_for(60.0, lambda: Stepper(clock, 0.01), kept, clock=clock)

    def unused():
        raise AssertionError("timed again")

    assert iterations_for(60.0, unused, kept, clock=clock) == first
    assert json.loads(kept.read_text())["iterations"] == first
    # Another time is another question.
    assert iterations_for(30.0, lambda: Stepper(clock, 0.01), kept, clock=clock) < 0.6 * first


@pytest.mark.parametrize("content", ["", "{", "[]", '{"seconds": 60.0}', "3"])
def test_a_damaged_file_is_made_anew(clock, tmp_path, content):
    kept = tmp_path / "budget.json"
    kept.write_text(content)
    found = iterations_for(60.0, lambda: Stepper(clock, 0.01), kept, clock=clock)
    assert json.loads(kept.read_text())["iterations"] == found


def test_it_can_be_cancelled(clock):
    trainer = Stepper(clock, 0.01)
    with pytest.raises(Cancelled):
        iterations_for(
            60.0, lambda: trainer, reporter=Reporter(is_cancelled=lambda: len(trainer.seen) > 4), clock=clock
        )
    assert len(trainer.seen) == 5


@pytest.mark.parametrize("wrong", [{"seconds": 0.0}, {"seconds": 1.0, "least": 5, "most": 4}])
def test_mistakes_are_named(wrong):
    with pytest.raises(SettingError, match="leaves nothing to do"):
        iterations_for(make_trainer=lambda: None, **wrong)


@pytest.mark.parametrize("power", [1.0, 1.7, 2.5])
@pytest.mark.parametrize("seconds", [0.5, 50.0, 4000.0])
def test_a_guess_finds_the_iterations_of_a_trainer_that_gets_slower(power, seconds):
    def taken(count):
        return 6.4 * (count / 800) ** power

    guesses = [(800, taken(800))]
    while abs(np.log(guesses[-1][1] / seconds)) > 0.15:
        count = next_guess(guesses, seconds)
        assert guesses[-1][0] / 4.1 < count < 4.1 * guesses[-1][0]
        guesses.append((count, taken(count)))
        assert len(guesses) <= 8
