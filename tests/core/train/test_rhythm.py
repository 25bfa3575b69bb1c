"""An optimisation whose steps take longer than they were given still ends with its schedule, in its time."""

from unittest.mock import patch

import numpy as np
import pytest

from insideout.core.errors import Cancelled
from insideout.core.progress import Reporter, unstopped
from insideout.core.train.loop import Task, optimise

STEPS = 1000


class Clocked:
    """Steps that take given seconds each, by the iteration, after compiling; remembers which were made."""

    def __init__(self, seconds, compiling=0.0, measuring=0.0):
        self._seconds = seconds if callable(seconds) else lambda iteration: seconds
        self._measuring = measuring
        self.now, self.compiled, self._compiling = 0.0, 0.0, compiling
        self.made, self.measured = [], []

    def __len__(self):
        return 1

    def step(self, iteration):
        if not self.made:
            self.compiled = self._compiling
            self.now += self._compiling
        self.made.append(iteration)
        self.now += self._seconds(iteration)
        return 1.0

    def measure(self, tick=unstopped):
        self.measured.append(self.made[-1])
        self.now += self._measuring
        return {"photos": 20.0}

    def state(self):
        return {"now": self.now}

    def restore(self, state):
        self.now = state["now"]


def fitted(trainer, aim, reporter=None, **options):
    task = Task("surface", "xray", STEPS, aim=aim, deadline=2 * aim, **{"measures": 8, **options})
    with patch("insideout.core.train.loop.work_clock", lambda: trainer.now - trainer.compiled):
        return optimise(trainer, task, reporter or Reporter(seconds=lambda: trainer.now))


@pytest.mark.parametrize("slowness", [1.2, 1.5, 2.0])
def test_a_slow_machine_makes_fewer_steps_and_the_last_of_the_schedule(slowness):
    trainer = Clocked(slowness)
    history = fitted(trainer, 1000.0, settled_splats=0.25)
    assert trainer.now == pytest.approx(1000, rel=0.03)
    assert history["iterations"] == len(trainer.made) == STEPS - history["left_out"]
    assert trainer.made[-1] > 0.98 * STEPS
    assert "ended" not in history
    assert len(trainer.measured) == 8, "the curve has all its points"


def test_steps_that_take_what_they_were_given_or_less_are_all_made():
    for seconds in (1.0, 0.5):
        history = fitted(Clocked(seconds), 1001.0)
        assert (history["iterations"], history["left_out"]) == (STEPS, 0)


def test_compiling_in_the_first_step_makes_the_others_no_slower():
    history = fitted(Clocked(1.0, compiling=500.0), 1501.0)
    assert (history["iterations"], history["left_out"]) == (STEPS, 0)


def test_two_fits_side_by_side_for_a_while_make_the_rest_no_slower():
    """With the time that both take none is left out."""

    class Pair(Clocked):
        @property
        def usual(self):
            return not 600 <= self.made[-1] < 700

    trainer = Pair(lambda iteration: 2.0 if 600 <= iteration < 700 else 1.0)
    history = fitted(trainer, 1101.0)
    assert (history["iterations"], history["left_out"]) == (STEPS, 0)


@pytest.mark.parametrize("expected", [0.0, 100.0, 300.0])
@pytest.mark.parametrize("slowness", [1.0, 1.3])
def test_what_is_still_to_be_measured_has_its_time(slowness, expected):
    """Two times, the second after the last step; after the first it is known how long that takes."""
    trainer = Clocked(slowness, measuring=100.0 * slowness)
    history = fitted(trainer, 1000.0, settled_splats=0.25, measures=2, measure_s=expected)
    assert trainer.now == pytest.approx(1000, rel=0.03)
    assert [point["iteration"] for point in history["heldout"]] == [STEPS // 2, STEPS]


def test_what_is_measured_once_in_the_end_has_the_time_that_it_was_given():
    trainer = Clocked(1.0, measuring=200.0)
    history = fitted(trainer, 1000.0, measures=1, measure_s=200.0)
    assert trainer.now == pytest.approx(1000, rel=0.03)
    assert [point["iteration"] for point in history["heldout"]] == [STEPS]


def test_what_takes_long_to_measure_makes_no_step_be_left_out_where_there_is_time():
    history = fitted(Clocked(1.0, measuring=100.0), 1201.0, measures=2, measure_s=100.0)
    assert (history["iterations"], history["left_out"]) == (STEPS, 0)


def test_none_is_left_out_while_splats_grow():
    """Nobody knows then what the last steps will take."""
    trainer = Clocked(lambda iteration: 1.0 if iteration < 450 else 3.0)
    fitted(trainer, 1000.0, settled_splats=0.5)
    assert trainer.made[:500] == list(range(500))
    later = np.array(trainer.made[500:])
    assert len(later) == pytest.approx((1000 - 600) / 3, rel=0.1)
    halves = (later < 750).sum(), (later >= 750).sum()
    assert halves[0] == pytest.approx(halves[1], rel=0.25), "all over the rest"


@pytest.mark.parametrize("slowness", [2.2, 3.4])
def test_a_fourth_of_the_rest_is_made_where_nothing_is_left_of_its_time(slowness):
    """The low rates at the end are worth more than what they cost the parts after it; the deadline holds."""
    trainer = Clocked(slowness)
    fitted(trainer, 1000.0, settled_splats=0.5)
    later = np.array(trainer.made[500:])
    assert len(later) == pytest.approx(125 if slowness < 3 else 300 / slowness, rel=0.1)
    assert later[-1] > 0.98 * STEPS
    assert trainer.now <= 2000 + slowness


def test_the_least_of_no_steps_is_none():
    told = []

    def tell(*shares):
        told.append(shares)

    assert optimise(Clocked(1.0), Task("internal", "joint", 0, tell=tell), Reporter())["iterations"] == 0
    assert told == []


def test_every_fourth_step_is_still_a_fourth_of_those_that_are_made():
    """A block's smoothness is looked at in every so many."""
    trainer = Clocked(2.0)
    fitted(trainer, 1000.0)
    assert np.mean(np.array(trainer.made) % 4 == 0) == pytest.approx(0.25, abs=0.04)


def test_the_least_steps_are_made_however_late_it_is():
    trainer = Clocked(1.0)
    trainer.now = 5000.0
    assert fitted(trainer, 1000.0, least=70)["iterations"] == 70


def test_what_was_made_is_told_to_whom_it_concerns():
    told = []

    def tell(*shares):
        told.append(shares)

    fitted(Clocked(2.0), 1000.0, tell=tell)
    assert told == [(pytest.approx(0.5, abs=0.03), 1.0)]
    fitted(Clocked(1.0), 300.0, settled_splats=1.0, tell=tell)
    assert told[1:] == [(pytest.approx(0.6, abs=0.01), 0.5)], "broken off at its deadline, half of what was measured"


def test_broken_off_it_counts_what_was_left_out_before(tmp_path):
    path, trainer = tmp_path / "xray.checkpoint.pt", Clocked(2.0)
    reporter = Reporter(seconds=lambda: trainer.now, is_cancelled=lambda: len(trainer.made) >= 300)
    with pytest.raises(Cancelled):
        fitted(trainer, 1000.0, reporter, checkpoint=path)
    again = Clocked(2.0)
    history = fitted(again, 1000.0, Reporter(seconds=lambda: again.now), checkpoint=path)
    assert history["iterations"] == 300 + len(again.made)
    assert history["iterations"] + history["left_out"] == STEPS
    assert again.now == pytest.approx(1000, rel=0.05)
