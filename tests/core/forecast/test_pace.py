"""Fitting what is left of a run into what is left of its time."""

import pytest

from insideout.core.errors import SettingError
from insideout.core.forecast.pace import Pace, least_seconds, parse_decibels, parse_duration

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


class Machine:
    """Makes the parts in their order; each takes its forecast times `slowness`, with as many steps as it is given."""

    def __init__(self, budget, slowness, calibration=0.0):
        self.now, self.slowness = calibration, slowness
        self.pace = Pace(budget, PARTS, lambda: self.now)
        self.chosen, self.deadlines = {}, {}

    def run(self):
        for part, seconds in PARTS.items():
            share = 1.0
            if part in STEPS:
                self.chosen[part] = self.pace.iterations(part, STEPS[part])
                self.deadlines[part] = self.pace.deadline(part)
                share = self.chosen[part] / STEPS[part]
            slowness = self.slowness(part) if callable(self.slowness) else self.slowness
            self.now += slowness * share * seconds
        return self.now


@pytest.mark.parametrize("budget", [60, 120, 300, 600])
def test_a_forecast_that_is_right_ends_a_little_before_the_time(budget):
    assert 0.9 * budget < Machine(budget, 1.0).run() <= budget


@pytest.mark.parametrize("slowness", [0.6, 0.8, 1.3, 2.0])
@pytest.mark.parametrize("budget", [120, 300])
def test_a_machine_that_is_slower_or_faster_all_along_ends_in_its_time_all_the_same(budget, slowness):
    assert 0.85 * budget < Machine(budget, slowness).run() <= 1.1 * budget


def test_a_part_that_takes_twice_as_long_takes_from_those_after_it():
    slow = Machine(300, lambda part: 2.0 if part == "surface rgb" else 1.0)
    even = Machine(300, 1.0)
    assert slow.run() <= 1.1 * 300
    even.run()
    assert slow.chosen["surface rgb"] == even.chosen["surface rgb"]
    assert slow.chosen["surface xray"] < 0.8 * even.chosen["surface xray"]


def test_steps_are_shared_out_as_in_the_preset():
    machine = Machine(1.2 * sum(PARTS.values()), 1.0)
    machine.run()
    shares = [machine.chosen[part] / STEPS[part] for part in STEPS]
    assert max(shares) < 1.05 * min(shares)
    assert min(shares) > 1.1


def test_what_calibrating_took_is_part_of_the_time():
    assert Machine(120, 1.0, calibration=30.0).run() <= 120


def test_a_part_has_to_end_early_enough_for_those_after_it():
    machine = Machine(300, 1.0)
    machine.run()
    assert machine.deadlines["surface rgb"] < machine.deadlines["surface xray"] < machine.deadlines["internal joint"]
    assert machine.deadlines["internal joint"] == pytest.approx(300 - PARTS["report"], abs=0.1)


def test_parts_without_a_forecast_keep_their_steps():
    pace = Pace(100.0, PARTS, lambda: 0.0)
    assert pace.iterations("fuse finish", 77) == 77
    assert pace.deadline("fuse finish") is None
    assert pace.iterations("surface rgb", 0) == 0


def test_the_least_is_all_that_has_no_steps_and_next_to_none_of_those():
    assert 40 < least_seconds(PARTS) < 50


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("5min", 300), ("90s", 90), ("90", 90), ("1h30min", 5400), ("1h 5min 10s", 3910), ("0.5h", 1800), ("2.5MIN", 150)],
)
def test_times_are_read_as_people_write_them(text, seconds):
    assert parse_duration(text) == seconds


@pytest.mark.parametrize("text", ["", "soon", "5 apples", "-3min", "min", "10s", "0"])
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
