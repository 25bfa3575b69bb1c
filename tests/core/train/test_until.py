"""When an optimisation ends because held-out views are good enough, or will not be."""

import pytest

from insideout.core.capture.model import Capture
from insideout.core.effects import RollingShutter
from insideout.core.errors import Cancelled
from insideout.core.progress import Reporter, unstopped
from insideout.core.run_folder import RunFolder
from insideout.core.stages.context import StageContext
from insideout.core.train.loop import Task, optimise
from insideout.core.train.schedule import Until

STEPS = 100


class Given:
    """Measures a given curve of photos, one value each tenth of the steps."""

    def __init__(self, *values):
        self.values, self.steps = values, 0

    def __len__(self):
        return 1

    def step(self, iteration):
        self.steps = iteration + 1
        return 1.0

    def measure(self, tick=unstopped):
        return {"photos": self.values[self.steps // 10 - 1], "projections": 1.0}

    def state(self):
        return {"steps": self.steps}

    def restore(self, state):
        self.steps = state["steps"]


def fitted(trainer, psnr, kind="photos", **options):
    return optimise(trainer, Task("surface", "rgb", STEPS, measures=10, until=Until(kind, psnr), **options), Reporter())


RISING = (20, 23, 25, 26.5, 27.6, 28.4, 29, 29.4, 29.7, 29.9)


def test_it_ends_at_the_first_point_that_is_good_enough():
    history = fitted(Given(*RISING), 26)
    assert history["iterations"] == 40
    assert history["ended"] == "26 dB of photos: reached"


def test_it_ends_half_way_where_the_curve_leads_far_below():
    history = fitted(Given(*RISING), 40)
    assert history["iterations"] == 50
    assert history["ended"] == "40 dB of photos: out of reach"


@pytest.mark.parametrize("psnr", [30.5, 31])
def test_what_the_last_steps_may_still_bring_is_waited_for(psnr):
    history = fitted(Given(*RISING), psnr)
    assert history["iterations"] == STEPS
    assert "ended" not in history


def test_a_curve_that_falls_twice_leads_no_higher():
    assert fitted(Given(20, 22, 24, 25, 24.5, 24, 24, 24, 24, 24), 28)["iterations"] == 60


def test_one_point_that_fell_may_be_chance():
    history = fitted(Given(20, 23, 25, 26.5, 27.6, 27.5, 28.6, 29.2, 29.8, 30.1), 29.5)
    assert history["ended"] == "29.5 dB of photos: reached"


def test_a_curve_that_jumps_half_way_as_images_grow_is_not_given_up():
    assert fitted(Given(10, 15, 18, 19, 25, 28, 30, 31, 31.5, 32), 32)["iterations"] == STEPS


def test_a_reset_of_opacities_is_not_where_the_curve_leads():
    falls = (20, 25, 28, 30, 20, 10, 30, 31.5, 32.6, 33)
    assert fitted(Given(*falls), 32.5, settled=0.7)["ended"] == "32.5 dB of photos: reached"
    assert fitted(Given(*falls), 32.5)["iterations"] == 60


def test_what_is_out_of_reach_is_seen_after_the_last_reset():
    falls = (20, 25, 28, 10, 25, 27, 28, 28.5, 28.7, 28.8)
    assert fitted(Given(*falls), 40, settled=0.6)["iterations"] == 90


def test_only_the_kind_that_was_asked_for_counts():
    assert fitted(Given(*RISING), 26, "sections")["iterations"] == STEPS
    assert fitted(Given(*RISING), 0.5, "projections")["ended"] == "0.5 dB of projections: reached"


@pytest.mark.parametrize(
    ("part", "kind", "effects", "measures"),
    [
        ("rgb", "photos", (), 20),
        ("rgb", "photos", (RollingShutter(),), 6),
        ("xray", "photos", (), 8),
        ("xray", "projections", (), 20),
    ],
)
def test_a_curve_is_looked_at_often_where_it_can_tell_and_is_cheap(tmp_path, part, kind, effects, measures):
    context = StageContext(Capture(tmp_path), RunFolder(tmp_path), until=Until(kind, 30.0), photo_effects=effects)
    assert context.paced(Task("surface", part, STEPS, measures=8 if part == "xray" else 2)).measures == measures


def test_a_deadline_ends_it_between_two_steps():
    clock = iter(range(10**6))
    reporter = Reporter(seconds=lambda: next(clock))
    history = optimise(Given(*RISING), Task("surface", "rgb", STEPS, measures=1, deadline=30.0), reporter)
    assert 10 <= history["iterations"] <= 31
    assert history["ended"] == "its time was up"


def test_the_least_steps_are_made_after_a_deadline():
    """What comes between its plan and its first step may take until then."""
    task = Task("internal", "joint", STEPS, measures=1, deadline=30.0, least=7)
    history = optimise(Given(*RISING), task, Reporter(seconds=lambda: 40.0))
    assert (history["iterations"], history["ended"]) == (7, "its time was up")


def test_broken_off_it_ends_where_the_unbroken_one_did(tmp_path):
    path = tmp_path / "rgb.checkpoint.pt"
    count = iter(range(10**6))
    task = Task("surface", "rgb", STEPS, measures=10, until=Until("photos", 26), checkpoint=path)
    with pytest.raises(Cancelled):
        optimise(Given(*RISING), task, Reporter(is_cancelled=lambda: next(count) >= 33))
    history = optimise(Given(*RISING), task, Reporter())
    assert (history["iterations"], history["ended"]) == (40, "26 dB of photos: reached")
