"""What a run will take: steps times what a step takes, only the parts that the capture calls for."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from insideout.core.capture.model import Photos
from insideout.core.capture.read import read_capture
from insideout.core.compare.methods import with_rgb
from insideout.core.densities import Densities
from insideout.core.effect_names import PHOTO_EFFECTS, XRAY_EFFECTS
from insideout.core.effects import RollingShutter
from insideout.core.errors import SettingError
from insideout.core.forecast.budget import choose_forecast, forecasts, preset_forecasts
from insideout.core.forecast.detail import PhotoLook
from insideout.core.forecast.forecast import Forecast, forecast
from insideout.core.forecast.points import PointsTime
from insideout.core.forecast.speed import (
    Speed,
    StepTime,
    drawn_with,
    measure_speed,
    photo_size,
    trained_size,
)
from insideout.core.progress import Reporter
from insideout.core.settings import PRESETS, Settings
from insideout.core.stages.internal.joint_settings import without_photos
from insideout.core.train.mask import MaskStrategy
from insideout.core.train.mcmc import McmcStrategy
from insideout.core.train.strategy import DefaultStrategy
from insideout.core.volume import Volume

# Every step takes the same, whatever it is made of.
EVEN = StepTime(0.01, 0.0, 0.0)


@pytest.fixture(scope="module")
def capture(tiny_capture):
    return read_capture(tiny_capture)


def photo_steps(capture, settings):
    """Of `surface`, for so many photos."""
    photos = sum(not photo.held_out for photo in capture.photos.photos)
    return settings.stages["surface"].rgb.for_photos(photos).iterations


def test_a_step_is_its_splats_and_its_pixels():
    assert StepTime(1.0, 0.1, 0.01).seconds(20, 300) == pytest.approx(1 + 2 + 3)


def test_trainings_take_their_steps(capture):
    settings = Settings.of("standard")
    parts = forecast(capture, settings, Speed(EVEN, EVEN, EVEN)).parts
    surface, joint = settings.stages["surface"], settings.stages["internal"].joint
    assert parts["surface rgb"] == pytest.approx(0.01 * photo_steps(capture, settings))
    assert parts["surface xray"] == pytest.approx(0.01 * surface.xray.iterations)
    assert parts["internal display"] == pytest.approx(0.01 * settings.stages["internal"].display_iterations)
    each = 0.01 * (1 + 1 / joint.xray_every + joint.section_until / joint.section_every)
    # What is done for all splats together comes on top.
    assert each * joint.iterations < parts["internal joint"] < 2.5 * each * joint.iterations


def test_small_images_and_few_splats_at_first_take_less(capture):
    settings = Settings.of("standard")
    by_splat = Speed(StepTime(0, 1e-6, 0), EVEN, EVEN, look=PhotoLook(3000.0))
    mean = forecast(capture, settings, by_splat).parts["surface rgb"] / (1e-6 * photo_steps(capture, settings))
    # 10,000 at first, 50,000 from the middle on.
    assert 30_000 < mean < 42_000
    camera = capture.photos.photos[0].camera
    pixels = forecast(capture, settings, Speed(StepTime(0, 0, 1e-6), EVEN, EVEN)).parts["surface rgb"]
    # A tenth at a quarter of the side, two tenths at half of it.
    share = 0.1 / 16 + 0.2 / 4 + 0.7
    steps = photo_steps(capture, settings)
    assert pixels == pytest.approx(share * steps * 1e-6 * camera.width * camera.height, rel=0.02)


def test_effects_that_make_steps_slow_make_no_machine_slow(capture):
    """A photo of a moving camera is drawn seven times; the alignment and the report draw none."""
    settings, blurred = Settings.of("standard"), StepTime(0.07, 0.0, 0.0)
    plain = forecast(capture, settings, Speed(EVEN, EVEN, EVEN)).parts
    found = forecast(capture, settings, Speed(blurred, EVEN, EVEN)).parts
    assert found["surface rgb"] == pytest.approx(7 * plain["surface rgb"])
    for part in ("initialize photos", "initialize xray", "align"):
        assert found[part] == plain[part]


def test_images_that_show_much_of_an_object_make_no_machine_slow(capture):
    """What is no training takes as long as a step tells that is the same for all captures."""
    settings, slow, usual = Settings.of("standard"), StepTime(0.05, 0.0, 0.0), Speed(EVEN, EVEN, EVEN)
    plain = forecast(capture, settings, usual).parts
    for kind in ("photo", "projection", "section"):
        found = forecast(capture, settings, replace(usual, **{kind: slow})).parts
        for part in ("initialize photos", "initialize xray", "align"):
            assert found[part] == plain[part]
    slower = forecast(capture, settings, replace(usual, slowness=5.0, alone=5.0)).parts
    assert slower["align"] == pytest.approx(5 * plain["align"])


def test_what_threads_do_not_share_takes_as_long_with_many_of_them(capture):
    """The alignment, and of the report the mesh, sections and the surfaces' distance."""
    settings, one = Settings.of("draft"), Speed(EVEN, EVEN, EVEN)
    many = forecast(capture, settings, replace(one, slowness=0.25)).parts
    fewer = forecast(capture, settings, replace(one, slowness=0.25, alone=0.25)).parts
    plain = forecast(capture, settings, one).parts
    # Densities in all voxels are made by all threads.
    assert fewer["align"] < 0.3 * plain["align"] < 0.31 * many["align"]
    assert many["report"] == plain["report"] > fewer["report"]
    assert many["initialize xray"] == fewer["initialize xray"] < plain["initialize xray"]


def test_splats_that_a_run_has_already_are_not_guessed(capture):
    speed, settings = Speed(StepTime(0, 1e-6, 0), StepTime(0, 1e-6, 0), EVEN), Settings.of("standard")

    def parts(**splats):
        known = {name.replace("_", " "): count for name, count in splats.items()}
        return forecast(capture, settings, speed, known).parts

    guessed = parts()
    begun = parts(initialize_rgb=20_000, initialize_xray=2000)
    assert begun["surface rgb"] == pytest.approx(2 * guessed["surface rgb"])
    trained = parts(initialize_rgb=20_000, surface_rgb=20_000, initialize_xray=500, surface_xray=500)
    steps = {"rgb": photo_steps(capture, settings), "xray": settings.stages["surface"].xray.iterations}
    assert trained["surface rgb"] == pytest.approx(0.02 * steps["rgb"])
    assert trained["surface xray"] == pytest.approx(0.0005 * steps["xray"])
    assert trained["internal joint"] < guessed["internal joint"]


def test_the_presets_are_in_their_order(capture):
    step = StepTime(1e-3, 1e-7, 1e-7)
    speed = Speed(step, step, step, look=PhotoLook(3000.0))
    draft, standard, paper = (forecast(capture, Settings.of(preset), speed).seconds for preset in PRESETS)
    assert draft < 0.5 * standard
    assert standard < 0.5 * paper


def test_a_half_that_is_not_there_takes_no_time(capture):
    settings = Settings.of("draft")
    photos = forecast(capture.photos_only(), settings, Speed(EVEN, None, None)).parts
    assert set(photos) == {"initialize photos", "surface rgb", "report"}
    # No sections, no mesh, no chamfer: the photos that were kept back, and nothing else.
    assert photos["report"] < 1
    xrays = forecast(capture.xrays_only(), settings, Speed(None, EVEN, EVEN)).parts
    assert set(xrays) == {"initialize xray", "surface xray", "internal display", "internal joint", "report"}
    alone = without_photos(settings.stages["internal"].joint)
    assert xrays["internal joint"] == pytest.approx(0.01 * alone.iterations)


def test_the_report_of_a_large_capture_takes_longer(capture):
    speed, settings = Speed(EVEN, EVEN, EVEN), Settings.of("standard")

    def seconds(**changes):
        large = replace(capture, projections=replace(capture.projections, **changes))
        return forecast(large, settings, speed).parts["report"]

    assert seconds(voxels=(400, 400, 400)) > seconds() + 10
    few, many = 10, 400
    shown = {count: np.zeros((count, 4, 4), np.float32) for count in (few, many)}
    held_out = {count: np.arange(count) < 2 for count in (few, many)}
    # What takes as long as 3.6 steps on each of up to 64 projections.
    longer = seconds(images=shown[many], held_out=held_out[many]) - seconds(images=shown[few], held_out=held_out[few])
    assert longer == pytest.approx(0.01 * 3.6 * (64 - few))


def test_the_paper_s_route_has_parts_of_its_own(capture):
    parts = forecast(capture, Settings.of("standard", refine="apart"), Speed(EVEN, EVEN, EVEN)).parts
    assert {"internal xray", "internal rgb", "internal display", "fuse finish"} <= set(parts)
    assert "internal joint" not in parts


def test_parts_are_in_the_order_of_the_run(capture):
    def internal(capture, speed, refine="joint"):
        parts = forecast(capture, Settings.of("draft", refine=refine), speed).parts
        return [part for part in parts if part.startswith("internal")]

    both = Speed(EVEN, EVEN, EVEN)
    assert internal(capture, both) == ["internal display", "internal joint"]
    assert internal(capture.xrays_only(), Speed(None, EVEN, EVEN)) == ["internal joint", "internal display"]
    assert internal(capture, both, "apart") == [
        "internal voxels",
        "internal xray",
        "internal xray measuring",
        "internal voxels after",
        "internal display",
        "internal rgb",
    ]


def test_a_volume_of_the_user_s_own_is_followed_apart_whatever_the_settings_say(capture):
    volume = Volume.centered(np.full((12, 12, 12), 0.02, np.float32), np.full(3, 8.0))
    settings = Settings.of("standard")
    alone = replace(capture, projections=None, volume=volume)
    rest = {"align", "internal xray", "internal display", "internal rgb", "fuse finish"}
    assert rest <= set(forecast(alone, settings, Speed(EVEN, None, EVEN)).parts)
    both = forecast(replace(capture, volume=volume), settings, Speed(EVEN, EVEN, EVEN)).parts
    assert rest <= set(both)
    assert not {"internal joint", "initialize xray"} & set(both)
    nothing_else = forecast(alone.xrays_only(), settings, Speed(None, None, EVEN)).parts
    densities = {"internal voxels", "internal xray", "internal xray measuring", "internal voxels after"}
    assert set(nothing_else) == {"initialize xray", *densities, "internal display", "report"}


def test_densities_of_a_large_volume_that_are_followed_take_long_to_measure(capture):
    """Of all voxels, four times: before, twice on the way and after; where none are followed, not at all."""
    volume = Volume.centered(np.full((12, 12, 12), 0.02, np.float32), np.full(3, 8.0))
    large = Volume.centered(np.full((120, 120, 120), 0.02, np.float32), np.full(3, 0.8))

    def voxels(volume, **changes):
        one = replace(capture.xrays_only(), projections=None, volume=volume, **changes)
        parts = forecast(one, Settings.of("draft"), Speed(None, None, EVEN, slowness=2.0)).parts
        return [parts[f"internal {name}"] for name in ("voxels", "xray measuring", "voxels after")]

    assert voxels(large) == pytest.approx([1000 * one for one in voxels(volume)])
    assert sum(voxels(large)) == pytest.approx(4 * 2.0 * 120**3 * 1e-6)
    grey = replace(capture, volume=large, volume_densities=Densities(relative=True))
    assert not grey.can_follow_volume
    parts = forecast(grey.xrays_only(), Settings.of("draft"), Speed(None, EVEN, EVEN)).parts
    assert parts["internal voxels"] == parts["internal xray measuring"] == 0


def test_a_volume_that_cannot_be_followed_takes_no_steps(capture):
    """Of grey values that fit no projections: `internal` makes none on the X-ray half then."""
    volume = Volume.centered(np.full((12, 12, 12), 0.02, np.float32), np.full(3, 8.0))
    grey = replace(capture, volume=volume, volume_densities=Densities(relative=True))
    assert not grey.can_follow_volume
    parts = forecast(grey, Settings.of("standard"), Speed(EVEN, EVEN, EVEN)).parts
    assert parts["internal xray"] == 0
    assert parts["internal rgb"] > 0


def test_a_step_of_the_paper_s_route_is_a_photo_and_a_section(capture):
    parts = forecast(capture, Settings.of("standard", refine="apart"), Speed(EVEN, EVEN, EVEN)).parts
    assert parts["internal rgb"] == pytest.approx(0.02 * Settings.of("standard").stages["internal"].rgb_iterations)


def test_sections_of_a_volume_alone_are_measured(capture):
    volume = Volume.centered(np.full((12, 12, 12), 0.02, np.float32), np.full(3, 8.0))
    found = measure_speed(replace(capture.xrays_only(), projections=None, volume=volume), 64)
    assert (found.photo, found.projection) == (None, None)
    assert found.section.seconds(30_000, 10_000) > 1e-5


def with_effects(effects, preset="draft"):
    return replace(Settings.of(preset), effects=effects)


def test_looking_for_effects_takes_seconds_where_any_is_looked_for(capture):
    def parts(effects):
        return list(forecast(capture, with_effects(effects), Speed(EVEN, EVEN, EVEN)).parts)

    assert parts("auto")[:3] == ["initialize photos", "initialize xray", "initialize effects"]
    for effects in ("geometry", "exposure", "auto,-geometry,-scatter,-beam_hardening"):
        assert "initialize effects" in parts(effects)
    left_out = ",".join(["auto", *(f"-{name}" for name in PHOTO_EFFECTS + XRAY_EFFECTS)])
    for effects in ("none", left_out):
        assert "initialize effects" not in parts(effects)
    photos = forecast(capture.photos_only(), with_effects("auto"), Speed(EVEN, None, None)).parts
    assert "initialize effects" in photos


def test_the_first_part_waits_for_programs_to_be_loaded(capture):
    """With cameras and X-rays photos come first, beside which ITK-RTK is loaded, and FDK has its own start alone."""
    speed, settings = Speed(EVEN, EVEN, EVEN), Settings.of("draft")
    both = forecast(capture, settings, speed).parts
    alone = forecast(capture.xrays_only(), settings, speed).parts
    assert next(iter(both)) == "initialize photos"
    assert alone["initialize xray"] == pytest.approx(both["initialize xray"] + 4.5 + 3)
    assert both["initialize photos"] == pytest.approx(4.5 + 0.03 * len(capture.photos.photos))
    volume = Volume.centered(np.full((12, 12, 12), 0.02, np.float32), np.full(3, 8.0))
    with_volume = replace(capture.xrays_only(), volume=volume)
    followed = forecast(with_volume, settings, speed).parts
    assert next(iter(followed)) == "initialize xray"
    assert followed["initialize xray"] == pytest.approx(4.5)
    unknown = forecast(replace(with_volume, volume_densities=Densities(relative=True)), settings, speed).parts
    assert unknown["initialize xray"] == pytest.approx(alone["initialize xray"]), "of sections' figures"


def test_looking_takes_as_long_as_it_was_measured_to(capture):
    """On the reference machine: 5 s for 60 views of 148 x 120 pixels, more for more of them."""

    def seconds(count, height, width, effects="auto,-focal_spot,-motion", **changes):
        projections = replace(
            capture.projections, images=np.zeros((count, height, width), np.float32), held_out=np.zeros(count, bool)
        )
        even = StepTime(0.02, 0.0, 0.0)
        one = replace(capture.xrays_only(), projections=projections, **changes)
        return forecast(one, with_effects(effects), Speed(even, even, even)).parts["initialize effects"]

    assert seconds(60, 148, 120) == pytest.approx(5, abs=0.1)
    assert seconds(120, 148, 120) == pytest.approx(9, abs=0.2)
    # Coarse views have at most 160 pixels a side.
    assert seconds(60, 1600, 1600) == pytest.approx(seconds(60, 160, 160))
    assert seconds(60, 100, 1000) == pytest.approx(1 + 4 * (seconds(60, 50, 125) - 1)), "all of wide, low detectors"
    edges = "auto,-motion"
    assert seconds(50, 72, 60, edges) == pytest.approx(seconds(50, 72, 60) + 1, abs=0.2), "edges for a focal spot"
    assert seconds(60, 1600, 1600, edges) == pytest.approx(seconds(60, 1600, 1600) + 8)
    moves = "auto,-focal_spot"
    assert seconds(66, 64, 64, moves) == pytest.approx(seconds(66, 64, 64) + 1.5, abs=0.1), "an object that moves"
    assert seconds(200, 64, 64, moves) - seconds(200, 64, 64) == pytest.approx(1.6, abs=0.1), "72 views of all"
    volume = Volume.centered(np.full((12, 12, 12), 0.02, np.float32), np.full(3, 8.0))
    assert seconds(60, 148, 120, volume=volume) == pytest.approx(8, abs=0.1), "ITK-RTK is loaded for this alone"


def test_taking_effects_out_of_large_projections_takes_long(capture):
    """0.8 µs a pixel for a focal spot, on one core of the reference machine; a trial has coarse views."""

    def seconds(effects, side=600, **changes):
        projections = replace(
            capture.projections, images=np.zeros((100, side, side), np.float32), held_out=np.zeros(100, bool)
        )
        one = replace(capture.xrays_only(), projections=projections)
        settings = replace(with_effects(effects), **{"time_budget_s": 1e5, **changes})
        return forecast(one, settings, Speed(EVEN, EVEN, EVEN, slowness=2.0)).parts["initialize effects"]

    others = "auto,-geometry,-motion,-scatter,-beam_hardening"
    assert seconds(f"{others},focal_spot") == pytest.approx(seconds(others) + 2 * 8e-7 * 100 * 600**2)
    assert seconds("scatter") == pytest.approx(seconds("noise") + 2 * 1.2e-7 * 100 * 600**2)
    trying = seconds("focal_spot", time_budget_s=None) - seconds("focal_spot")
    assert trying == pytest.approx(2 * 300 * 0.01 + 2 * 8e-7 * 100 * 150**2)


def test_rings_that_are_asked_for_by_name_cost_a_fit_of_their_own(capture):
    """2000 steps with up to 15,000 splats; against a time half of both, and no more than 15 % of it."""

    def fit(splats_s, **changes):
        step = StepTime(0.01, splats_s, 0.0)
        looking, with_rings = (
            forecast(capture.xrays_only(), replace(with_effects(effects), **changes), Speed(EVEN, step, EVEN)).parts
            for effects in ("noise", "noise,ring")
        )
        return with_rings["initialize effects"] - looking["initialize effects"]

    assert fit(0.0) == pytest.approx(2000 * 0.01)
    # Splats grow from 5 to 50 % of the steps.
    assert fit(1e-6) == pytest.approx(2000 * (0.01 + (0.275 * 2500 + 0.725 * 15_000) * 1e-6), rel=0.01)
    in_time = fit(1e-6, time_budget_s=1000.0)
    assert in_time == pytest.approx(1000 * (0.01 + (0.275 * 2500 + 0.725 * 7500) * 1e-6), rel=0.01)
    assert fit(0.0, time_budget_s=20.0) == pytest.approx(0.15 * 20)


def test_looking_at_photos_takes_as_long_as_forty_are_read(capture):
    def seconds(count, width, height, name="one.JPG", effects="auto"):
        camera = replace(capture.photos.photos[0].camera, width=width, height=height)
        photos = Photos([replace(capture.photos.photos[0], camera=camera, path=Path(name))] * count)
        even = StepTime(0.02, 0.0, 0.0)
        one, against_a_time = (
            replace(capture.photos_only(), photos=photos),
            replace(with_effects(effects), time_budget_s=1e4),
        )
        return forecast(one, against_a_time, Speed(even, None, None)).parts["initialize effects"]

    assert seconds(20, 4000, 3000, effects="exposure") == pytest.approx(3.4, abs=0.1)
    assert seconds(20, 4000, 3000) == pytest.approx(3.4 + 2 + 1 + 1.5 + 0.6 + 2.4, abs=0.1), "twice"
    assert seconds(40, 4000, 3000) == seconds(200, 4000, 3000) == pytest.approx(5.8 + 2 + 1 + 3 + 1.2 + 4.8, abs=0.1)
    assert seconds(20, 4000, 3000, effects="moving_background") == pytest.approx(2.4 + 0.6, abs=0.1)
    assert seconds(20, 4000, 3000, "one.png", "exposure") == pytest.approx(1 + 20 * 2.4, abs=0.1)
    assert seconds(20, 4000, 3000, effects="motion_blur") == pytest.approx(2.4 + 1.5, abs=0.1)
    assert seconds(20, 4000, 3000, effects="motion_blur,exposure") == pytest.approx(3.4 + 1.5, abs=0.1)
    assert seconds(20, 4000, 3000, effects="rolling_shutter") == pytest.approx(1), "nor is one for this"
    assert seconds(20, 4000, 3000, effects="lens") == pytest.approx(2), "nor for this"
    assert seconds(20, 4000, 3000, "one.png", "pixel_integration") == pytest.approx(1), "for this no photo is read"


def test_steps_are_timed_with_pixel_integration_where_photos_are_trained_much_smaller(capture, monkeypatch):
    timed = []

    def measured(capture, long_side, tick, known, rgb):
        timed.append(rgb.pixel_integration)
        return Speed(EVEN, EVEN, EVEN)

    monkeypatch.setattr("insideout.core.forecast.speed.measure_speed", measured)
    side = max(photo_size(capture.photos.photos[0]))

    def forecast_of(effects, long_side, mip_filter=False):
        forecasts(capture, [with_rgb(with_effects(effects), long_side=long_side, mip_filter=mip_filter)], Reporter())

    for effects in ("none", "auto", "auto,-pixel_integration"):
        forecast_of(effects, side // 2)
    forecast_of("auto", side)
    forecast_of("auto", side // 2, mip_filter=True)
    assert timed == [False, True, False, False, False]


def test_effects_that_the_capture_cannot_have_are_not_forecast(capture):
    with pytest.raises(SettingError, match="geometry is an effect of X-ray projections, and the capture has none"):
        preset_forecasts(capture.photos_only(), "joint", Reporter(), "geometry")


def test_that_cameras_have_to_be_found_is_said_and_takes_longer(capture):
    photos = [replace(photo, camera=None) for photo in capture.photos.photos]
    unknown = replace(capture, photos=replace(capture.photos, photos=photos))
    speed = Speed(EVEN, EVEN, EVEN)
    known, found = (forecast(one, Settings.of("draft"), speed) for one in (capture, unknown))
    assert (known.cameras, found.cameras) == (False, True)
    assert found.parts["initialize photos"] > known.parts["initialize photos"] + 1


def test_of_many_photos_without_cameras_not_every_pair_is_matched(capture):
    def seconds(count):
        photos = replace(capture.photos, photos=[replace(capture.photos.photos[0], camera=None)] * count)
        return forecast(replace(capture, photos=photos), Settings.of("draft"), speed).parts["initialize photos"]

    speed = Speed(EVEN, EVEN, EVEN)
    assert seconds(100) > 2.5 * seconds(50), "all pairs are"
    assert seconds(400) < 3 * seconds(200)


def test_photos_are_never_enlarged(capture):
    longest = max(capture.photos.photos[0].camera.width, capture.photos.photos[0].camera.height)
    assert trained_size(capture, 10_000) == longest
    assert trained_size(capture, 8) == 8
    assert trained_size(capture.xrays_only(), 400) == 400


def test_steps_are_timed_with_the_effects_that_are_asked_for_by_name(capture, monkeypatch):
    timed = []

    def measured(capture, long_side, tick, known, rgb):
        timed.append(rgb)
        return Speed(EVEN, EVEN, EVEN)

    monkeypatch.setattr("insideout.core.forecast.speed.measure_speed", measured)
    asked = "auto,rolling_shutter,pixel_integration"
    forecasts(capture, [with_effects(effects) for effects in ("none", "auto", asked)], Reporter())
    plain, with_both = timed
    assert not plain.effects
    assert not plain.pixel_integration
    assert with_both.effects == (RollingShutter(),)
    assert with_both.pixel_integration


def test_measuring_can_be_stopped(capture):
    class StoppedError(Exception):
        pass

    def tick():
        raise StoppedError

    with pytest.raises(StoppedError):
        measure_speed(capture, 400, tick)


def test_all_presets_are_forecast_at_once(capture, monkeypatch):
    measured = []

    def measure_once(capture, long_side, *rest):
        measured.append(long_side)
        return measure_speed(capture, long_side, *rest)

    monkeypatch.setattr("insideout.core.forecast.speed.measure_speed", measure_once)
    found = forecasts(capture, [Settings.of(preset) for preset in PRESETS], Reporter())
    assert [one.settings.preset for one in found] == list(PRESETS)
    assert all(0 < one.seconds < np.inf for one in found)
    assert 0 < len(measured) == len(set(measured)), "each size of photos is measured once"


@pytest.mark.parametrize(("budget", "preset"), [(30, "draft"), (150, "draft"), (269, "draft"), (271, "standard")])
def test_the_preset_is_the_most_thorough_of_which_nearly_all_can_be_had(budget, preset):
    found = [
        Forecast(Settings.of(name), {"all": s}, False) for name, s in zip(("draft", "standard"), (60, 300), strict=True)
    ]
    assert choose_forecast(found, budget).settings.preset == preset


def test_only_what_the_capture_is_drawn_with_is_compiled(capture):
    volume = Volume.centered(np.full((12, 12, 12), 0.02, np.float32), np.full(3, 8.0))
    assert drawn_with(capture.photos_only()) == ("splat",)
    assert drawn_with(capture.xrays_only()) == ("radiograph", "section")
    assert drawn_with(replace(capture, projections=None, volume=volume)) == ("splat", "section")


def test_projections_are_measured_once_for_photos_of_all_sizes(capture):
    known = Speed(EVEN, EVEN, EVEN, points=PointsTime(0.5, 0.1))
    found = measure_speed(capture, 32, known=known)
    assert found.photo is not EVEN
    assert (found.projection, found.section, found.points) == (EVEN, EVEN, known.points)
    assert 0 < found.look.detail < 0.8 * measure_speed(capture, 64, known=known).look.detail
    assert measure_speed(capture.xrays_only(), 64, known=known).look == PhotoLook()


def test_other_strategies_are_forecast_too(capture):
    def seconds(strategy):
        settings = with_rgb(Settings.of("standard"), strategy=strategy)
        return forecast(capture, settings, speed).parts["surface rgb"]

    speed = Speed(StepTime(0.0, 1e-6, 0.0), EVEN, EVEN, look=PhotoLook(3000.0))
    inner = replace(DefaultStrategy(), most=20_000)
    assert seconds(MaskStrategy(densify=inner)) == seconds(inner)
    assert seconds(McmcStrategy(most=20_000)) < 0.7 * seconds(McmcStrategy(most=60_000))
