"""Held-out photos are compared with the model on the way, and with effects their own numbers are fitted to each."""

from dataclasses import replace

import numpy as np
import pytest

from insideout.core.capture.read import read_capture
from insideout.core.compare.methods import with_rgb, with_stage
from insideout.core.effects import EFFECTS, Defocus, Exposure, MotionBlur, PhotoEffects, RollingShutter
from insideout.core.errors import SettingError
from insideout.core.forecast.budget import fit_into_time
from insideout.core.forecast.detail import PhotoLook
from insideout.core.forecast.fitting import FORWARD, learnt_effects, steps_to_measure
from insideout.core.forecast.forecast import forecast
from insideout.core.forecast.pace import Pace, least_seconds, measuring_of
from insideout.core.forecast.speed import Speed, StepTime
from insideout.core.pipeline import reconstruct
from insideout.core.progress import Reporter
from insideout.core.run_folder import RunFolder
from insideout.core.settings import Settings
from insideout.core.stages import effect_gains
from insideout.core.stages.context import StageContext
from insideout.core.train.loop import Task

EVEN = StepTime(0.01, 0.0, 0.0)
ALL = Speed(EVEN, EVEN, EVEN)
ONE = 0.01 * steps_to_measure((Exposure(),))
"""Seconds of comparing one photo."""


@pytest.fixture(scope="module")
def capture(tiny_capture):
    return read_capture(tiny_capture)


@pytest.fixture(scope="module")
def held_out(capture):
    return sum(photo.held_out for photo in capture.photos.photos)


def asked(effects="exposure", preset="draft", **options):
    settings = Settings.of(preset, refine=options.pop("refine", "joint"))
    return replace(settings, effects=effects, **options)


def more_photos(capture, times):
    return replace(capture, photos=replace(capture.photos, photos=times * list(capture.photos.photos)))


def test_fitting_a_photo_takes_tens_of_steps_and_each_try_a_drawing():
    """Measured on matryoshkas of 96 x 128 pixels, in training steps: 16 to 20, 39 to 52, 27 to 30 and 39 to 41."""
    assert steps_to_measure(()) == FORWARD
    assert 16 < steps_to_measure((Exposure(),)) < 20
    assert 39 < steps_to_measure((RollingShutter(),)) < 52
    assert 27 < steps_to_measure((Defocus(),)) < 30
    assert 38 < steps_to_measure((MotionBlur(),)) < 41
    assert steps_to_measure((Exposure(), Defocus())) == pytest.approx(steps_to_measure((Defocus(),)) + FORWARD)


@pytest.mark.parametrize(
    ("effects", "given", "learnt"),
    [
        ("none", (), ()),
        ("auto", (), ()),
        ("auto,exposure", (), (Exposure(),)),
        ("motion_blur,exposure,lens,pixel_integration,geometry", (), (Exposure(), MotionBlur())),
        ("none", (Defocus(),), (Defocus(),)),
        ("exposure", (Defocus(),), (Defocus(),)),
    ],
)
def test_effects_are_learnt_that_a_script_gives_or_else_that_are_asked_for_by_name(effects, given, learnt):
    assert learnt_effects(with_rgb(asked(effects), effects=given)) == learnt


def test_of_a_joint_refinement_photos_are_compared_where_the_run_does_it(capture, held_out):
    plain, found = (forecast(capture, asked(effects), ALL).parts for effects in ("none", "exposure"))
    more = {part: seconds for part, seconds in found.items() if part not in plain and part != "initialize effects"}
    assert more == {
        "surface rgb measuring": pytest.approx(2 * held_out * ONE),
        "internal joint measuring": pytest.approx(held_out * ONE),
        "fuse measuring": pytest.approx(held_out * ONE),
    }
    assert found["report"] - plain["report"] == pytest.approx(3 * held_out * (ONE - 0.01 * FORWARD))
    parts = list(found)
    assert parts[parts.index("surface rgb") + 1] == measuring_of("surface rgb")
    assert parts[-4:] == ["internal joint", measuring_of("internal joint"), "fuse measuring", "report"]


def test_apart_they_are_compared_before_and_after_too(capture, held_out):
    parts = forecast(capture, asked(refine="apart"), ALL).parts
    assert list(parts)[-9:] == [
        "internal measuring",
        "internal rgb",
        "internal rgb measuring",
        "internal measuring after",
        "fuse measuring",
        "fuse finish",
        "fuse finish measuring",
        "fuse measuring after",
        "report",
    ]
    times = {part: seconds / held_out / ONE for part, seconds in parts.items() if "measuring" in part}
    # It is of sections and projections.
    del times["internal xray measuring"]
    assert times == {
        "surface rgb measuring": pytest.approx(2),
        "internal measuring": pytest.approx(1),
        "internal rgb measuring": pytest.approx(2),
        "internal measuring after": pytest.approx(1),
        "fuse measuring": pytest.approx(2),
        "fuse finish measuring": pytest.approx(2),
        "fuse measuring after": pytest.approx(2),
    }


def test_of_photos_alone_there_is_one_model(capture, held_out):
    plain, found = (
        forecast(capture.photos_only(), asked(effects), Speed(EVEN, None, None)).parts
        for effects in ("none", "exposure")
    )
    assert [part for part in found if part not in plain] == ["initialize effects", measuring_of("surface rgb")]
    assert plain["report"] == pytest.approx(held_out * 0.01 * FORWARD)
    assert found["report"] == pytest.approx(held_out * ONE)


@pytest.mark.parametrize("changes", [{}, {"held_out": False}])
def test_where_nothing_is_fitted_or_kept_back_it_is_no_part(capture, changes):
    photos = [replace(photo, **changes) for photo in capture.photos.photos]
    one = replace(capture, photos=replace(capture.photos, photos=photos))
    parts = forecast(one, asked("exposure" if changes else "auto"), ALL).parts
    assert not [part for part in parts if "measuring" in part]


def test_on_the_way_some_of_many_are_compared_and_all_in_the_end(capture, held_out):
    parts = forecast(more_photos(capture, 20), asked(), ALL).parts
    assert 20 * held_out > 16
    assert parts["surface rgb measuring"] == pytest.approx(2 * 16 * ONE)
    assert parts["internal joint measuring"] == pytest.approx(16 * ONE)
    assert parts["fuse measuring"] == pytest.approx(20 * held_out * ONE)


def test_where_a_figure_ends_a_training_they_are_compared_more_often(capture, held_out):
    parts = forecast(capture, asked(until_db=30.0), ALL).parts
    for part in ("surface rgb", "internal joint"):
        assert parts[measuring_of(part)] == pytest.approx(6 * held_out * ONE)
    assert parts["fuse measuring"] == pytest.approx(held_out * ONE)


def test_photos_are_as_large_as_where_they_are_compared(capture, held_out):
    """Trained at half of their size, in the report they are as large as they are."""
    camera = capture.photos.photos[0].camera
    small = with_rgb(asked(), long_side=max(camera.width, camera.height) // 2)
    by_pixel = Speed(StepTime(0.0, 0.0, 1e-6), EVEN, EVEN)
    found, plain = (forecast(capture, one, by_pixel).parts for one in (small, replace(small, effects="none")))
    whole = held_out * 1e-6 * camera.width * camera.height
    steps = steps_to_measure((Exposure(),))
    assert found["surface rgb measuring"] == pytest.approx(2 * steps * whole / 4)
    assert found["report"] - plain["report"] == pytest.approx(3 * (steps - FORWARD) * whole)


def test_splats_are_as_many_as_there_are_then(capture, held_out):
    by_splat = Speed(StepTime(0.0, 1e-6, 0.0), EVEN, EVEN, look=PhotoLook(3000.0))
    known = {"initialize rgb": 1000, "surface rgb": 9000, "surface xray": 500}
    parts = forecast(capture, asked("exposure", "standard"), by_splat, known).parts
    one = held_out * 1e-6 * steps_to_measure((Exposure(),))
    # Half way nearly all have been added, in the end all are there.
    assert 1.5 * 9000 * one < parts["surface rgb measuring"] <= 2 * 9000 * one
    assert parts["internal joint measuring"] == pytest.approx(9500 * one)


def test_what_named_effects_are_worth_is_tried_with_all_of_them_and_without_each(capture):
    def seconds(effects, **changes):
        even = StepTime(0.02, 0.0, 0.0)
        settings = asked(effects, **changes)
        return forecast(capture, settings, Speed(even, even, even)).parts["initialize effects"]

    def trying(effects):
        return seconds(effects) - seconds(effects, time_budget_s=1e4)

    def fitted(*effects):
        """Steps of comparing the two photos that are set aside."""
        return 2 * steps_to_measure(effects)

    assert trying("exposure") == pytest.approx(0.02 * (2 * 300 + fitted(Exposure()) + fitted()))
    both = fitted(Exposure(), Defocus()) + fitted(Exposure()) + fitted(Defocus())
    assert trying("exposure,defocus,geometry") == pytest.approx(0.02 * ((3 + 2) * 300 + both))
    for effects in ("auto", "truncation", "moving_background"):
        assert trying(effects) == 0


def test_with_too_few_views_nothing_is_tried(capture):
    few = replace(capture, photos=replace(capture.photos, photos=capture.photos.photos[:7]))
    with_time, without = (
        forecast(few, asked("exposure", time_budget_s=time_s), ALL).parts["initialize effects"]
        for time_s in (1e4, None)
    )
    assert with_time == without


def test_a_time_budget_leaves_them_their_time(capture, tmp_path, monkeypatch):
    """Effects that are asked for by name at once, those that are found once they are known."""
    slow, clock = Speed(StepTime(0.05, 0.0, 0.0), EVEN, EVEN), [0.0]
    monkeypatch.setattr("insideout.core.forecast.speed.measure_speed", lambda *given: slow)

    def pace(effects, budget):
        settings = asked(effects, time_budget_s=budget)
        return fit_into_time(capture, RunFolder(tmp_path), settings, False, lambda: clock[0], Reporter())[1]

    named, plain = pace("exposure", 1e4).parts, pace("auto", 1e4).parts
    unmeasured = {part: seconds for part, seconds in named.items() if "measuring" not in part}
    assert least_seconds(unmeasured) < least_seconds(named) - 2
    with pytest.raises(SettingError, match="is too short"):
        pace("exposure", least_seconds(named) - 1)
    enough = (least_seconds(plain) + 1) / 0.95
    found, nothing = pace("auto", enough), pace("auto", enough)
    clock[0] = sum(seconds for part, seconds in plain.items() if part.startswith("initialize"))
    assert nothing.iterations("surface rgb", 1000) > 0
    found.expect(["exposure"])
    with pytest.raises(SettingError, match="and what is no training takes"):
        found.iterations("surface rgb", 1000)


def test_a_training_knows_how_long_measuring_will_take_it(capture, tmp_path):
    settings = asked(time_budget_s=500.0)
    parts = forecast(capture, settings, ALL).parts
    context = StageContext(
        capture, RunFolder(tmp_path), pace=Pace(500.0, parts, lambda: 0.0), photo_effects=(Exposure(),)
    )
    for _ in range(2):
        task = context.paced(Task("surface", "rgb", 1000, measures=2))
        assert task.measure_s == pytest.approx(parts["surface rgb measuring"] / 2), "taken up again, too"
    assert context.paced(Task("surface", "xray", 1000)).measure_s == 0.0


@pytest.mark.parametrize("refine", ["joint", "apart"])
def test_a_run_compares_as_many_photos_as_were_foretold(refine, tiny_capture, tiny_settings, tmp_path, monkeypatch):
    compared, usual = [], PhotoEffects.fitted

    def counted(*given, **options):
        compared.append(1)
        return usual(*given, **{**options, "steps": 1})

    monkeypatch.setattr(PhotoEffects, "fitted", counted)
    monkeypatch.setattr(effect_gains, "STEPS", 2)
    monkeypatch.setattr("insideout.core.forecast.forecast.steps_to_measure", lambda effects: 1.0 if effects else 0.0)
    settings = replace(tiny_settings, effects="exposure")
    if refine == "apart":
        settings = with_stage(settings, "internal", joint=None)
    capture, photo = read_capture(tiny_capture), StepTime(1.0, 0.0, 0.0)
    foretold = forecast(capture, settings, Speed(photo, EVEN, EVEN)).parts
    without = forecast(capture, replace(settings, effects="none"), Speed(photo, EVEN, EVEN)).parts
    untried = forecast(capture, replace(settings, time_budget_s=1e4), Speed(photo, EVEN, EVEN)).parts
    # All steps on photos take a second: those of the two trials are no comparisons.
    trials = foretold["initialize effects"] - untried["initialize effects"] - 2 * 2
    measuring = sum(seconds for part, seconds in foretold.items() if "measuring" in part and "xray" not in part)
    report = reconstruct(tiny_capture, tmp_path / "run", settings=settings)
    assert report["stages"]["internal"]["mode"] == refine
    assert len(compared) == pytest.approx(trials + measuring + foretold["report"] - without["report"])


@pytest.mark.parametrize("name", EFFECTS)
def test_all_effects_say_what_fitting_them_takes(name):
    assert EFFECTS[name].tries >= 1
    assert 0.3 < EFFECTS[name].fit_share < 1.5
    assert np.isfinite(steps_to_measure((EFFECTS[name](),)))
