"""Fitting what is left of a run into what is left of its time."""

from functools import partial
from unittest.mock import patch

import pytest

from insideout.core.errors import SettingError
from insideout.core.forecast.pace import (
    Pace,
    least_seconds,
    least_steps,
    measuring_of,
    parse_decibels,
    parse_duration,
)
from insideout.core.progress import Reporter, unstopped
from insideout.core.train.loop import Task, optimise

PARTS = {
    "initialize xray": 10.0,
    "surface rgb": 60.0,
    "surface xray": 100.0,
    "align": 20.0,
    "internal display": 10.0,
    "internal joint": 90.0,
    "report": 10.0,
}
STEPS = {"surface rgb": 1000, "surface xray": 2000, "internal display": 100, "internal joint": 500}
MEASURES = 2


FITTED = {
    "initialize xray": 10.0,
    "surface rgb": 60.0,
    measuring_of("surface rgb"): 40.0,
    "surface xray": 100.0,
    "align": 20.0,
    "internal display": 10.0,
    "internal joint": 90.0,
    measuring_of("internal joint"): 25.0,
    "fuse measuring": 10.0,
    "report": 40.0,
}
"""With effects that are fitted to each held-out photo."""


class Machine:
    """Makes the parts in their order, those with steps by the loop of a run; each takes its forecast times `slowness`
    for the steps of its preset, and so does what it measures.

    Attributes:
        chosen, made, last: steps of each part as they were planned, the share of these that there was time for, and
            where in its schedule the last one was.
    """

    def __init__(self, budget, slowness, calibration=0.0, parts=PARTS):
        self.now, self.slowness, self._parts = calibration, slowness, parts
        self.pace = Pace(budget, parts, lambda: self.now)
        self.chosen, self.deadlines, self.made, self.last = {}, {}, {}, {}
        self._step_s, self._measure_s, self._reached = 0.0, 0.0, 0

    def __len__(self):
        return 1

    def step(self, iteration):
        self.now += self._step_s
        self._reached = iteration + 1
        return 1.0

    def measure(self, tick=unstopped):
        self.now += self._measure_s
        return {"photos": 20.0}

    def state(self):
        return {}

    def restore(self, state):
        raise AssertionError("nothing is taken up here")

    def run(self):
        inside = [measuring_of(part) for part in STEPS]
        for part, seconds in self._parts.items():
            slowness = self.slowness(part) if callable(self.slowness) else self.slowness
            if part in inside:
                continue
            if part not in STEPS:
                self.now += slowness * seconds
                continue
            self.chosen[part] = self.pace.iterations(part, STEPS[part])
            self.deadlines[part] = self.pace.deadline(part)
            self._step_s = slowness * seconds / STEPS[part]
            self._measure_s = slowness * self._parts.get(measuring_of(part), 0.0) / MEASURES
            stage, _, name = part.partition(" ")
            task = Task(
                stage,
                name,
                self.chosen[part],
                measures=MEASURES,
                measure_s=self.pace.measuring(part) / MEASURES,
                deadline=self.deadlines[part],
                aim=self.pace.aim(part),
                least=least_steps(STEPS[part]),
                settled_splats=0.5 if stage == "surface" else 0.0,
                tell=partial(self.pace.made, part),
            )
            with patch("insideout.core.train.loop.work_clock", lambda: self.now):
                history = optimise(self, task, Reporter(seconds=lambda: self.now))
            self.made[part] = history["iterations"] / self.chosen[part]
            self.last[part] = self._reached / self.chosen[part]
        return self.now


@pytest.mark.parametrize("budget", [60, 120, 300, 600])
def test_a_forecast_that_is_right_ends_a_little_before_the_time(budget):
    assert 0.9 * budget < Machine(budget, 1.0).run() <= budget


@pytest.mark.parametrize("slowness", [0.6, 0.8, 1.3, 2.0])
@pytest.mark.parametrize("budget", [120, 300])
def test_a_machine_that_is_slower_or_faster_all_along_ends_in_its_time_all_the_same(budget, slowness):
    assert 0.85 * budget < Machine(budget, slowness).run() <= 1.1 * budget


@pytest.mark.parametrize("budget", [120, 300, 600])
def test_no_part_is_cut_in_the_middle_of_its_schedule(budget):
    """A machine that is half as slow again makes fewer steps, those with low rates among them."""
    machine = Machine(budget, 1.5)
    assert machine.run() <= budget
    assert min(machine.last.values()) > 0.95
    assert machine.made["surface rgb"] == pytest.approx(2 / 3, abs=0.05)
    assert min(machine.made[part] for part in STEPS if part != "surface rgb") > 0.9


def test_a_part_that_takes_twice_as_long_takes_from_those_after_it():
    slow = Machine(300, lambda part: 2.0 if part == "surface rgb" else 1.0)
    even = Machine(300, 1.0)
    assert slow.run() <= 1.1 * 300
    even.run()
    assert slow.chosen["surface rgb"] == even.chosen["surface rgb"]
    assert slow.chosen["surface xray"] < 0.8 * even.chosen["surface xray"]


def test_photos_that_grow_beyond_the_forecast_do_not_make_projections_slow():
    """Once they are trained their splats are known: the machine is as fast as it was forecast to be."""
    now, known = [10.0], {}
    knowing = Pace(300.0, PARTS, lambda: now[0], anew=lambda effects, splats: {**PARTS, **known})
    not_knowing = Pace(300.0, PARTS, lambda: now[0])
    steps = knowing.iterations("surface rgb", 1000)
    assert not_knowing.iterations("surface rgb", 1000) == steps
    known["surface rgb"] = 2 * PARTS["surface rgb"]
    now[0] += steps / 1000 * known["surface rgb"]
    left = 0.95 * 300 - now[0] - PARTS["align"] - PARTS["report"]
    share = left / (PARTS["surface xray"] + PARTS["internal display"] + PARTS["internal joint"])
    assert knowing.iterations("surface xray", 2000) == pytest.approx(2000 * share, abs=1)
    assert not_knowing.iterations("surface xray", 2000) < 0.6 * 2000 * share


def test_effects_that_are_found_on_the_way_are_counted_and_the_time_still_holds():
    """Photos of a moving camera take seven times as long a step."""
    asked = []

    def anew(effects, splats):
        asked.append(effects)
        return {**PARTS, "surface rgb": 420.0, "internal joint": 300.0}

    now = [10.0]
    pace = Pace(250.0, PARTS, lambda: now[0], anew=anew)
    unforeseen = Pace(250.0, PARTS, lambda: now[0])
    pace.expect(iter(["motion_blur"]))
    steps = pace.iterations("surface rgb", 1000)
    assert asked == [frozenset({"motion_blur"})]
    assert steps < 0.5 * unforeseen.iterations("surface rgb", 1000)
    now[0] += 0.42 * steps
    now[0] += 0.05 * pace.iterations("surface xray", 2000) + 20.0
    now[0] += 0.1 * pace.iterations("internal display", 100)
    now[0] += 0.6 * pace.iterations("internal joint", 500) + 10.0
    assert 200 < now[0] < 250


def test_what_was_learnt_of_the_machine_outlives_a_break():
    """The process that goes on has not seen the part begin, which took twice its time."""
    now = [10.0]
    first = Pace(300.0, PARTS, lambda: now[0])
    share = first.iterations("surface rgb", 1000) / 1000
    second = Pace(300.0, PARTS, lambda: now[0], before=now[0])
    second.take_up("surface rgb", first.begun("surface rgb"))
    now[0] += 2 * share * PARTS["surface rgb"]
    assert second.iterations("surface xray", 2000) == first.iterations("surface xray", 2000)
    assert Pace(300.0, PARTS, lambda: now[0]).iterations("surface xray", 2000) > first.iterations("surface xray", 2000)
    assert first.begun("no part") == {}


def test_a_restart_makes_no_part_slower():
    """Reading, measuring speed and loading kernels once more take time, of which fewer steps are left, that is all."""
    now = [10.0]
    first = Pace(300.0, PARTS, lambda: now[0])
    share = first.iterations("surface rgb", 1000) / 1000
    now[0] += 0.5 * share * PARTS["surface rgb"]
    before = now[0]
    now[0] += 40.0
    second = Pace(300.0, PARTS, lambda: now[0], before=before)
    second.take_up("surface rgb", first.begun("surface rgb"))
    now[0] += 0.5 * share * PARTS["surface rgb"]
    left = 0.95 * 300 - now[0] - PARTS["align"] - PARTS["report"]
    ahead = PARTS["surface xray"] + PARTS["internal display"] + PARTS["internal joint"]
    assert second.iterations("surface xray", 2000) == pytest.approx(2000 * left / ahead, abs=1)


def test_what_takes_longer_than_forecast_has_time_where_there_is_plenty():
    pace = Pace(3000, PARTS, lambda: 0.0)
    assert pace.iterations("surface rgb", 1000) == 4000
    assert pace.aim("surface rgb") > 7 * 240


def test_a_part_that_leaves_out_steps_tells_those_after_it_how_slow_it_was():
    """It ends when it was to, as on a machine that is as fast as was thought."""
    clock = [0.0]
    pace = Pace(300, PARTS, lambda: clock[0])
    planned = pace.iterations("surface rgb", 1000)
    clock[0] = pace.aim("surface rgb")
    assert clock[0] == pytest.approx(60 * planned / 1000, rel=1e-3)
    right = Pace(300, PARTS, lambda: clock[0], before=clock[0])
    right.take_up("surface rgb", pace.begun("surface rgb"))
    pace.made("surface rgb", 0.8)
    slow, usual = (one.iterations("surface xray", 2000) for one in (pace, right))
    assert slow < 0.81 * usual
    assert pace.aim("align") is None, "it has no steps"


def test_however_late_it_is_a_part_makes_the_least_steps():
    pace = Pace(100.0, PARTS, lambda: 400.0)
    assert pace.iterations("surface xray", 1000) == least_steps(1000) == 20
    assert pace.deadline("surface xray") == 400.0
    assert least_steps(3) == 1


def test_a_time_that_is_gone_before_the_first_training_is_told():
    """Finding cameras takes what nobody can foresee."""
    pace = Pace(100.0, PARTS, lambda: 98.0)
    with pytest.raises(
        SettingError,
        match=r"--time-budget 100s: 98 s are gone before the first training, and what .* takes 30 s more; .* more time",
    ):
        pace.iterations("surface rgb", 1000)


def test_steps_are_shared_out_as_in_the_preset():
    machine = Machine(1.2 * sum(PARTS.values()), 1.0)
    machine.run()
    shares = [machine.chosen[part] / STEPS[part] for part in STEPS]
    assert max(shares) < 1.05 * min(shares)
    assert min(shares) > 1.1


@pytest.mark.parametrize("slowness", [0.8, 1.0, 1.3])
@pytest.mark.parametrize("budget", [240, 300, 600])
def test_effects_that_are_fitted_to_held_out_photos_have_their_time(budget, slowness):
    """On the way, after the last step of a part, between the parts and in the report."""
    machine = Machine(budget, slowness, parts=FITTED)
    assert 0.85 * budget < machine.run() <= 1.05 * budget
    assert min(machine.last.values()) > 0.95


def test_what_is_measured_on_the_way_is_of_the_part_s_own_time():
    pace = Pace(400.0, FITTED, lambda: 10.0)
    share = pace.iterations("surface rgb", 1000) / 1000
    assert pace.measuring("surface rgb") == 40.0
    assert pace.measuring("surface xray") == 0.0, "it has not begun"
    assert pace.aim("surface rgb") == pytest.approx(10.0 + 60.0 * share + 40.0, abs=0.1)


def test_a_part_that_ended_before_all_was_measured_makes_no_machine_fast():
    """As at a figure that was to be reached."""
    now = [10.0]
    pace = Pace(400.0, FITTED, lambda: now[0])
    share = pace.iterations("surface rgb", 1000) / 1000
    now[0] += 0.5 * (60.0 * share + 40.0)
    pace.made("surface rgb", 0.5, 0.5)
    ahead = FITTED["surface xray"] + FITTED["internal display"] + FITTED["internal joint"]
    left = 0.95 * 400 - now[0] - 20.0 - 25.0 - 10.0 - 40.0
    assert pace.iterations("surface xray", 2000) == pytest.approx(2000 * left / ahead, abs=2)


def test_what_calibrating_took_is_part_of_the_time():
    assert Machine(120, 1.0, calibration=30.0).run() <= 120


def test_a_part_has_to_end_early_enough_for_those_after_it():
    machine = Machine(300, 1.0)
    machine.run()
    assert machine.deadlines["surface rgb"] < machine.deadlines["surface xray"] < machine.deadlines["internal joint"]
    assert machine.deadlines["internal joint"] == pytest.approx(300 - PARTS["report"], abs=0.1)


def test_parts_without_a_forecast_keep_their_steps_and_leave_time_for_the_report():
    pace = Pace(100.0, PARTS, lambda: 0.0)
    assert pace.iterations("fuse finish", 77) == 77
    assert pace.deadline("fuse finish") == 90.0
    assert pace.iterations("surface rgb", 0) == 0


def test_the_least_is_all_that_has_no_steps_and_next_to_none_of_those():
    assert 40 < least_seconds(PARTS) < 50


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("5min", 300),
        ("5m", 300),
        ("90s", 90),
        ("90", 90),
        ("1h30min", 5400),
        ("1h 5min 10s", 3910),
        ("0.5h", 1800),
        ("2.5MIN", 150),
    ],
)
def test_times_are_read_as_people_write_them(text, seconds):
    assert parse_duration(text) == seconds


@pytest.mark.parametrize("text", ["", "soon", "5 apples", "-3min", "min", "10s", "0", "1h30", "5min30", "5m30", "²"])
def test_what_is_no_time_or_too_short_is_named(text):
    with pytest.raises(SettingError, match="--time-budget"):
        parse_duration(text)


@pytest.mark.parametrize(("text", "value"), [("32dB", 32), ("32", 32), (" 28.5 db", 28.5)])
def test_decibels_are_read_with_or_without_their_unit(text, value):
    assert parse_decibels(text) == value


@pytest.mark.parametrize("text", ["", "good", "-3dB", "0", "nan", "1000"])
def test_what_is_no_psnr_is_named(text):
    with pytest.raises(SettingError, match="--until"):
        parse_decibels(text)
