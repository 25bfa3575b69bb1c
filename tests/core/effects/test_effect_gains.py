"""What effects in use are worth, told from short fits to views that are set aside."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from insideout.core.capture.model import Capture
from insideout.core.effects.choose import Choice
from insideout.core.effects.rays import RayEvidence
from insideout.core.effects.request import parse_effects
from insideout.core.progress import Reporter
from insideout.core.stages import effect_gains
from insideout.core.stages.context import StageContext
from insideout.core.stages.effect_gains import tell_gains_of_rays
from insideout.core.stages.effects import choose, tries_effects
from insideout.core.views import Camera

OFFSET_PX = 2.0


@pytest.fixture(autouse=True)
def few_steps(monkeypatch):
    """So that a trial takes a second; whole ones are in the tests of runs with effects."""
    monkeypatch.setattr(effect_gains, "STEPS", 60)


@pytest.fixture(scope="module")
def scan(scans):
    return scans.displaced_scan(OFFSET_PX)


@pytest.fixture
def context(scan, tmp_path):
    return StageContext(Capture(tmp_path, projections=scan, digest="a scan"), run=None, request=parse_effects("auto"))


def used(name, chosen_by="auto"):
    return {"name": name, "used": True, "chosen_by": chosen_by, "reason": "It is there."}


def offset(scan, pixels):
    count = len(scan.detectors)
    shift = np.tile([pixels * float(np.linalg.norm(scan.detectors[0].u)), 0.0], (count, 1))
    return {"shift_mm": shift, "tilt_rad": np.zeros(count)}


def tried(context, scan, pixels, chosen_by="auto"):
    choice = Choice([used("geometry", chosen_by)], {"geometry": offset(scan, pixels)})
    harmful = tell_gains_of_rays(context, RayEvidence(scan), choice)
    assert (harmful is None) is choice.rows[0]["used"]
    return choice.rows[0]


def told(rows, quality, request=None):
    return effect_gains._tell(lambda **_: None, rows, quality, request or parse_effects("auto"), ())


def test_what_is_right_is_worth_something(context, scan):
    row = tried(context, scan, OFFSET_PX)
    assert row["gain_db"] > 2
    assert row["reason"].startswith("It is there. In a short trial views set aside have ")
    assert "may do harm" not in row["reason"]


def test_others_are_tried_without_the_weights_of_noise(context, scan, monkeypatch):
    seen, trainer = [], effect_gains.short_trainer

    def noted(context, views, *rest):
        seen.append(views.noise)
        return trainer(context, views, *rest)

    monkeypatch.setattr(effect_gains, "short_trainer", noted)
    known = {"per_photon": 2e-5, "floor": 0.0, "most": 1.0, "known": 0.01}
    choice = Choice([used("geometry")], {"geometry": offset(scan, OFFSET_PX), "noise": known})
    tell_gains_of_rays(context, RayEvidence(scan), choice)
    assert seen == [None, None]


def test_what_is_wrong_is_not_used(context, scan):
    row = tried(context, scan, -OFFSET_PX)
    assert row["gain_db"] < -1
    assert not row["used"]
    assert row["reason"].startswith("It is there. In 2 short trials, on average, views set aside have ")
    assert row["reason"].endswith("So it is not used; --effects auto,geometry uses it all the same.")


def test_what_is_wrong_is_used_where_the_user_asks_for_it(context, scan):
    row = tried(context, scan, -OFFSET_PX, chosen_by="user")
    assert row["gain_db"] < -1
    assert row["used"]
    assert row["reason"].endswith("So it may do harm: compare a run with --effects auto,-geometry.")


@pytest.mark.parametrize("shaking", [False, True])
def test_numbers_that_were_fitted_to_the_views_set_aside_are_told_of(shaking, context, scan, monkeypatch):
    """A detector that is off in all views alike has none of those."""
    monkeypatch.setattr(effect_gains._RayTrial, "quality", lambda self, left_out, again: 30.0 if left_out else 31.0)
    numbers = {"geometry": offset(scan, OFFSET_PX), "motion": {}, "scatter": {}}
    numbers["geometry"]["shift_mm"][3, 0] += 0.1 * shaking
    choice = Choice([used(name) for name in numbers], numbers)
    assert tell_gains_of_rays(context, RayEvidence(scan), choice) is None
    flattered = [row["name"] for row in choice.rows if "numbers of their own fitted to them" in row["reason"]]
    assert flattered == (["geometry", "motion"] if shaking else ["motion"])


def test_who_waits_for_kernels_in_a_trial_is_told(context, scan, monkeypatch):
    """It may be the first that a new machine draws: a minute, in which nothing else is said."""
    told = []
    monkeypatch.setattr(effect_gains, "STEPS", 1)
    monkeypatch.setattr("insideout.core.render.kernels.cpu.is_compiled", lambda _: False)
    waiting = replace(context, reporter=Reporter(lambda progress: told.append((progress.part, progress.message))))
    tried(waiting, scan, OFFSET_PX)
    assert ("effects", "compiling kernels, once") in told


@pytest.mark.parametrize(
    ("asked", "instead"),
    [
        ("geometry", "none"),
        ("geometry,scatter", "scatter"),
        ("auto,-ring", "auto,-geometry,-ring"),
        ("auto,geometry", "auto,-geometry"),
    ],
)
def test_what_may_do_harm_is_left_out_of_what_was_asked_for(asked, instead):
    """Who asks for one effect is not told to look for all others."""
    row = used("geometry", chosen_by="user")
    assert told([row], lambda left_out, again: 30.0 if left_out else 29.0, parse_effects(asked)) is None
    assert row["gain_db"] == -1.0
    assert row["reason"].endswith(f"compare a run with --effects {instead}.")
    assert str(parse_effects(instead)) == instead


@pytest.mark.parametrize(
    ("losses", "gain", "left_out"),
    [
        ((0.1,), -0.1, False),
        ((0.9, 0.5, 0.3), -0.4, False),
        ((0.3, 0.8, 0.4), -0.6, True),
        ((9.0, -0.3, 0.5), -0.1, False),
    ],
)
def test_what_is_left_out_loses_half_a_decibel_in_two_more_trials(losses, gain, left_out):
    """The trial that looked bad has no say: of many, one does."""
    row, trials = used("scatter"), []

    def quality(name, again):
        trials.append((name, again))
        return 30.0 + (losses[again] if name else 0.0)

    assert told([row], quality) == ("scatter" if left_out else None)
    assert row["gain_db"] == pytest.approx(gain)
    assert row["used"] is not left_out
    assert sorted(trials, key=str) == sorted([(n, a) for n in (None, "scatter") for a in range(len(losses))], key=str)
    assert ("may do harm" in row["reason"]) is (gain == -0.4)


def test_how_much_longer_a_step_takes_is_told():
    row = used("defocus")
    paces = {None: 0.03, "defocus": 0.012}
    quality = lambda left_out, again: 28.0 if left_out else 30.0  # noqa: E731
    assert effect_gains._tell(lambda **_: None, [row], quality, parse_effects("auto"), ("defocus",), paces) is None
    assert row["times_as_long"] == pytest.approx(2.5)
    assert "30.0 dB with it, 28.0 dB without. With it, they had numbers of their own" in row["reason"]
    assert row["reason"].endswith(" A step takes 2.5 times as long with it.")


@pytest.mark.parametrize("order", [1, -1])
def test_a_trial_that_fails_says_nothing(order):
    """A fit whose images are no numbers has a PSNR of minus infinity, with and without an effect."""
    rows = [used("scatter"), used("geometry")][::order]
    qualities = {None: -np.inf, "scatter": -np.inf, "geometry": -np.inf}
    assert told(rows, lambda left_out, again: qualities[left_out]) is None
    assert all(row["used"] for row in rows)


def test_of_two_that_do_harm_the_worse_is_left_out_and_the_other_tried_again():
    rows = [used("scatter"), used("geometry")]
    assert told(rows, lambda left_out, again: {None: 30.0, "scatter": 30.7, "geometry": 32.0}[left_out]) == "geometry"
    assert [row["used"] for row in rows] == [True, False]


def test_others_are_looked_for_again_without_what_does_harm():
    """What comes later is measured in projections from which what came before was taken out."""
    asked = []

    def look(request):
        asked.append(str(request))
        found = [name for name in ("geometry", "scatter", "focal_spot") if request.wants(name)]
        return Choice([used(name) for name in found], {name: {"after": len(found)} for name in found})

    def tell_gains(choice):
        row = choice.rows[0]
        if row["name"] == "focal_spot":
            return None
        row["used"] = False
        return row["name"]

    names = ("scatter", "geometry", "focal_spot")
    choice = choose(SimpleNamespace(request=parse_effects("auto"), pace=None), names, look, tell_gains)
    assert asked == ["auto", "auto,-geometry", "auto,-geometry,-scatter"]
    assert [(row["name"], row["used"]) for row in choice.rows] == [
        ("scatter", False),
        ("geometry", False),
        ("focal_spot", True),
    ]
    assert choice.numbers == {"focal_spot": {"after": 1}}


def test_the_views_set_aside_are_no_held_out_ones(context, scan, monkeypatch):
    """Figures of held-out views must not be chosen by themselves."""
    seen, measured = [], effect_gains.psnr

    def compared(image, given, peak):
        seen.append([bool(np.array_equal(given, one.ravel())) for one in scan.images].index(True))
        return measured(image, given, peak)

    monkeypatch.setattr(effect_gains, "STEPS", 2)
    monkeypatch.setattr(effect_gains, "psnr", compared)
    tried(context, scan, OFFSET_PX)
    # Every fifth of 24 training views, with the effect and without.
    assert seen == 2 * [2, 7, 12, 17, 22]
    assert not scan.held_out[seen].any()


def test_what_only_the_fdk_sees_is_not_tried(context, scan):
    choice = Choice([used("truncation")], {"truncation": {}})
    tell_gains_of_rays(context, RayEvidence(scan), choice)
    assert choice.rows == [used("truncation")]


@pytest.mark.parametrize(("rows", "pace", "expected"), [(True, None, True), (False, None, False), (True, 1, False)])
def test_only_what_is_in_use_is_tried_and_not_against_the_clock(rows, pace, expected, context):
    found = [used("geometry") if rows else {**used("geometry"), "used": False}]
    assert tries_effects(SimpleNamespace(pace=pace), found) is expected


def test_large_photos_are_cut_about_the_object():
    pose = np.eye(4)
    camera = Camera(800, 600, 700.0, 700.0, 400.0, 300.0, pose)
    middle = np.array([1.0, -0.2, 4.0])
    rows, columns = effect_gains._window(camera, middle)
    cut = effect_gains._cut(camera, rows, columns)
    assert (cut.width, cut.height) == (256, 256)
    # The point is seen where it was.
    column, row, inside = (value[0] for value in camera.pixels_of(middle[None]))
    there = cut.pixels_of(middle[None])
    assert inside
    assert (there[0][0] + columns.start, there[1][0] + rows.start) == (column, row)
    assert abs(there[0][0] - 128) <= 1
    assert cut.field_of_view() == camera.field_of_view()


def test_small_photos_stay_whole_and_a_point_nobody_sees_leaves_the_middle():
    camera = Camera(300, 80, 100.0, 100.0, 150.0, 40.0, np.eye(4))
    assert effect_gains._window(camera, np.array([0.0, 0.0, -5.0])) == (slice(0, 80), slice(22, 278))
