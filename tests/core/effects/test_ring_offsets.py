"""Pixels' offsets out of what a fit leaves of its views: the object's share counts less, and breaks change nothing."""

from dataclasses import replace

import numpy as np
import pytest

from insideout.core.capture.model import Capture
from insideout.core.effects import geometry
from insideout.core.effects.finding import EffectFinding
from insideout.core.effects.request import parse_effects
from insideout.core.effects.ring_offsets import RingOffsets, alike, told_apart
from insideout.core.errors import Cancelled
from insideout.core.evaluate.metrics import psnr
from insideout.core.forecast.pace import Pace
from insideout.core.progress import Reporter
from insideout.core.render import radiograph
from insideout.core.run_folder import RunFolder
from insideout.core.stages import effect_gains, short_fit
from insideout.core.stages.context import StageContext
from insideout.core.stages.effects import NUMBERS
from insideout.core.stages.initialize import InitializeSettings, rings, run
from insideout.core.stages.surface import PRESETS
from insideout.core.stages.surface.stage import density_unit
from insideout.core.stages.surface.xray import XrayTrainer
from insideout.core.told import Told

SHAPE, DEVIATION = (48, 64), 0.01


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.fixture
def offsets():
    return np.random.default_rng(0).normal(0, DEVIATION, SHAPE)


class TestToldApart:
    def test_offsets_alone_come_out(self, offsets):
        assert rms(told_apart(offsets, DEVIATION) - offsets) < 0.1 * DEVIATION

    def test_what_is_smooth_is_not_theirs(self, offsets):
        smooth = 0.05 * np.sin(np.linspace(0, 3, SHAPE[1])) + np.zeros(SHAPE)
        assert rms((told_apart(offsets + smooth, DEVIATION) - offsets)[8:-8, 8:-8]) < 0.2 * DEVIATION

    def test_an_outline_that_all_views_share_is_left_to_the_object(self, offsets):
        outline = np.zeros(SHAPE)
        outline[:, 40:42] = 0.2, -0.2
        found = told_apart(offsets + outline, DEVIATION)
        assert rms(found[:, 40:42]) < 0.005 * rms(outline[:, 40:42])
        assert rms((found - offsets)[:, :24]) < 0.15 * DEVIATION

    def test_pixels_are_told_beside_shading_that_is_stronger_than_theirs(self, offsets):
        """Where the shading is, little is known of them; nearly all at other wavelengths."""
        shading = 0.01 * np.sin(2 * np.pi * np.arange(SHAPE[1]) / 18) + np.zeros(SHAPE)
        found = told_apart(offsets + shading, DEVIATION)
        assert rms(found - told_apart(offsets, DEVIATION)) < 0.35 * rms(shading)
        assert rms(found - offsets) < 0.35 * DEVIATION

    def test_without_a_deviation_there_are_none(self, offsets):
        assert not told_apart(offsets, 0.0).any()


def test_views_of_a_body_of_revolution_are_alike(scans):
    def share(bodies, gains):
        views = scans.ellipsoid_scan(48, 12, 2, bodies=bodies, supersampled=1)
        return alike(replace(views, images=views.images - np.log(gains)), DEVIATION)

    ball = [scans.Ellipsoid((0, 0, 0), (12, 12, 13), 0.0, 0.1)]
    for gains in (1.0, 1 + DEVIATION * np.random.default_rng(0).standard_normal((48, 48))):
        assert share(ball, gains) > 0.95
        assert share(scans.BODIES, gains) < 0.7


def test_of_very_many_views_some_tell_how_alike_all_are_and_looking_can_be_cancelled(scans):
    """A thousand views of four million pixels would take minutes."""
    few = scans.ellipsoid_scan(24, 12, 0, supersampled=1)
    held_out = np.arange(300) % 3 == 1
    many = replace(few, images=np.repeat(few.images, 25, axis=0), held_out=held_out)
    seen: list[int] = []
    share = alike(many, 0.0, lambda: seen.append(1))
    assert len(seen) == 60
    assert share == pytest.approx(alike(few, 0.0), abs=0.01)

    def stop():
        raise Cancelled

    with pytest.raises(Cancelled):
        alike(many, 0.0, stop)


class TestRounds:
    def shown(self, offsets, steps, known=None):
        """What 40 views leave, in turn, with noise that their mean has little of."""
        learnt = known or RingOffsets(SHAPE, 40, 400, DEVIATION)
        for step in steps:
            noise = np.random.default_rng([1, step]).normal(0, 0.02, SHAPE)
            learnt.observe(step, (offsets + noise).astype(np.float32))
        return learnt

    def test_there_are_none_before_the_object_is_there(self, offsets):
        assert not self.shown(offsets, range(159)).values.any()
        found = self.shown(offsets, range(160)).values
        assert rms(found - offsets) < 0.45 * DEVIATION

    def test_taken_up_again_they_are_the_same_bits(self, offsets):
        whole = self.shown(offsets, range(250))
        again = RingOffsets(SHAPE, 40, 400, DEVIATION)
        again.restore(self.shown(offsets, range(187)).state())
        assert np.array_equal(self.shown(offsets, range(187, 250), again).values, whole.values)

    def test_another_detector_is_refused(self):
        with pytest.raises(ValueError, match="pixels"):
            RingOffsets((48, 60), 40, 400, DEVIATION).restore(RingOffsets(SHAPE, 40, 400, DEVIATION).state())

    def test_pixels_that_are_not_finite_count_for_nothing(self, offsets):
        learnt = RingOffsets(SHAPE, 4, 40, DEVIATION)
        for step in range(16, 20):
            left = offsets.copy()
            left[step, 7] = np.nan
            learnt.observe(step, left)
        assert np.isfinite(learnt.values).all()
        assert np.allclose(learnt.values, told_apart(offsets, DEVIATION), atol=1e-7)

    def test_of_very_many_views_some_make_a_round(self, offsets):
        learnt = RingOffsets(SHAPE, 10_000, 400, DEVIATION)
        assert self.shown(offsets, range(160), learnt).values.any()


@pytest.fixture(scope="module")
def scan(scans):
    """Ellipsoids by pixels whose gains deviate by 3 %, and their offsets."""
    clean = scans.noisy(scans.ellipsoid_scan(48, 24, 4, supersampled=1))
    gains = 1 + 0.03 * np.random.default_rng(0).standard_normal(clean.images.shape[1:])
    return replace(clean, images=(clean.images - np.log(gains)).astype(np.float32)), -np.log(gains)


def initialized(scan, folder, effects, coarse_splats=300, **options):
    capture = Capture(folder / "capture", projections=scan, digest="rings")
    context = StageContext(capture, RunFolder(folder / "run"), request=parse_effects(effects), **options)
    run(context, InitializeSettings(start="coarse", coarse_splats=coarse_splats))
    return context


@pytest.fixture
def short(monkeypatch):
    monkeypatch.setattr(rings, "STEPS", 240)


def test_in_a_run_all_stages_get_projections_without_them(scan, tmp_path, scans, short):
    given, offsets = scan
    context = initialized(given, tmp_path, scans.auto_for("ring"))
    (row,) = context.effects.rows("xray")
    assert row["used"] is True
    assert "taken out" in row["reason"]
    left = context.projections.images - given.images
    assert np.allclose(left, left[0], atol=1e-5)
    assert rms(left[0] + offsets) < 0.6 * rms(offsets)


def test_who_waits_for_kernels_before_the_fit_is_told(scan, tmp_path, scans, monkeypatch):
    told = []
    monkeypatch.setattr(rings, "STEPS", 1)
    monkeypatch.setattr("insideout.core.render.kernels.cpu.is_compiled", lambda _: False)
    initialized(scan[0], tmp_path, scans.auto_for("ring"), reporter=Reporter(told.append))
    (begun, *_) = (progress for progress in told if progress.part == "rings")
    assert (begun.message, begun.splats) == ("compiling kernels, once", None), "before splats are placed"


def test_of_a_body_of_revolution_nothing_is_taken_out(tmp_path, scans, short):
    shells = [
        scans.Ellipsoid((0, 0, 0), (radius, radius, 1.1 * radius), 0.0, value)
        for radius, value in ((12, 0.2), (11, -0.2), (9, 0.2), (8, -0.2))
    ]
    doll = scans.noisy(scans.ellipsoid_scan(48, 24, 4, bodies=shells, supersampled=1))
    gains = 1 + 0.02 * np.random.default_rng(0).standard_normal(doll.images.shape[1:])
    doll = replace(doll, images=(doll.images - np.log(gains)).astype(np.float32))
    context = initialized(doll, tmp_path, "ring")
    (row,) = context.effects.rows("xray")
    assert (row["found"], row["used"]) == (True, False)
    assert "body of revolution" in row["reason"]
    assert context.projections is doll


def test_a_time_that_is_too_short_for_the_fit_is_left_to_the_model(scan, tmp_path, scans, short):
    pace = Pace(0.0, {}, lambda: 0.0)
    context = initialized(scan[0], tmp_path, scans.auto_for("ring"), pace=pace)
    (row,) = (row for row in context.effects.rows("xray") if row["name"] == "ring")
    assert (row["found"], row["used"]) == (True, False)
    assert row["reason"].endswith("the time budget is too short for a fit that tells pixels from the object.")
    assert context.projections is scan[0]


def test_killed_in_the_fit_it_ends_with_the_same_bits(scan, tmp_path, scans, short):
    def killed():
        return bool(progress) and progress[-1].part == "rings" and progress[-1].iteration > 150

    whole, progress = initialized(scan[0], tmp_path / "whole", scans.auto_for("ring")), []
    with pytest.raises(Cancelled):
        initialized(scan[0], tmp_path / "broken", scans.auto_for("ring"), reporter=Reporter(progress.append, killed))
    assert not (tmp_path / "broken" / "run" / "initialize" / NUMBERS).exists()
    assert (tmp_path / "broken" / "run" / "initialize" / "rings.checkpoint.pt").exists()
    again = initialized(scan[0], tmp_path / "broken", scans.auto_for("ring"))
    assert np.array_equal(again.projections.images, whole.projections.images)


def test_a_fit_that_was_broken_off_gets_no_more_time_than_it_had(scan, tmp_path, scans, short):
    """A budget of 1000 s has 150 s for it, which are over when the run goes on."""

    def killed():
        return bool(progress) and progress[-1].part == "rings" and progress[-1].iteration > 70

    def resumed(seconds, *said):
        reporter = Reporter(*said, seconds=lambda: seconds)
        pace = Pace(1000.0, {}, reporter.seconds)
        return initialized(scan[0], tmp_path, scans.auto_for("ring"), reporter=reporter, pace=pace)

    progress = []
    with pytest.raises(Cancelled):
        resumed(10.0, progress.append, killed)
    assert progress[-1].iterations == 120, "half of what a run without a time makes"
    (row,) = (row for row in resumed(161.0).effects.rows("xray") if row["name"] == "ring")
    assert (row["found"], row["used"]) == (True, False)
    assert "time budget" in row["reason"]


def test_without_an_effect_that_did_harm_rings_are_told_anew(scan, tmp_path, scans, short, monkeypatch):
    """What a fit learnt beside a geometry that is wrong has no say."""
    wrong = 3 * float(np.linalg.norm(scan[0].detectors[0].u))
    shift = np.tile([wrong, 0.0], (len(scan[0].images), 1))
    numbers = {"shift_mm": shift, "tilt_rad": np.zeros(len(shift))}
    found = EffectFinding("geometry", True, 3.0, "px", 0.1, Told("It is there."), 0.01, numbers)

    def harmful(context, evidence, choice):
        for row in choice.rows:
            if row["name"] == "geometry":
                row.update(used=False, gain_db=-1.0)
                return "geometry"
        return None

    with monkeypatch.context() as during:
        during.setattr(geometry, "detect", lambda evidence: found)
        during.setattr(effect_gains, "tell_gains_of_rays", harmful)
        misled = initialized(scan[0], tmp_path / "misled", scans.auto_for("ring", "geometry"))
    plain = initialized(scan[0], tmp_path / "plain", scans.auto_for("ring"))
    assert [row["used"] for row in misled.effects.rows("xray")] == [False, True]
    np.testing.assert_array_equal(*(one.effects.numbers["ring"]["offsets"] for one in (misled, plain)))


def test_rings_are_told_by_a_fit_without_weights_that_later_stages_have(tmp_path, scans, monkeypatch, short):
    given, trainer = [], short_fit.short_trainer

    def noted(context, shown, *rest):
        given.append(shown)
        return trainer(context, shown, *rest)

    monkeypatch.setattr(short_fit, "short_trainer", noted)
    clean = scans.noisy(scans.ellipsoid_scan(48, 24, 4, supersampled=1), 1000)
    gains = 1 + 0.05 * np.random.default_rng(0).standard_normal(clean.images.shape[1:])
    uneven = replace(clean, images=(clean.images - np.log(gains)).astype(np.float32))
    context = initialized(uneven, tmp_path, "ring,noise")
    assert [shown.noise for shown in given] == [None]
    assert context.projections.noise is not None


def test_a_clean_scan_is_not_fitted(tmp_path, scans, monkeypatch):
    def fitted(*_):
        raise AssertionError("fitted")

    monkeypatch.setattr(rings, "learn_offsets", fitted)
    clean = scans.noisy(scans.ellipsoid_scan(48, 24, 4, supersampled=1))
    context = initialized(clean, tmp_path, "ring")
    assert context.projections is clean


@pytest.mark.slow
def test_a_fit_wins_back_four_fifths_of_what_gains_of_2_percent_cost(scans, tmp_path):
    """Clean held-out projections of 128 x 128 pixels, 120 views to train on: 46.53 dB clean, 42.87 with the gains."""
    true = scans.ellipsoid_scan(128, 120, 6)
    clean = scans.noisy(true)
    gains = 1 + 0.02 * np.random.default_rng(0).standard_normal(clean.images.shape[1:])
    uneven = replace(clean, images=(clean.images - np.log(gains)).astype(np.float32))
    settings, held = PRESETS["draft"].xray, np.flatnonzero(true.held_out)
    settings = replace(settings, strategy=replace(settings.strategy, most=20_000))

    def quality(given, effects):
        context = initialized(given, tmp_path / effects / str(given is clean), effects, 2500)
        projections, volume = context.projections, context.run.volume()
        start, unit = context.run.read_set("initialize", "xray"), density_unit(context.run)
        trainer = XrayTrainer(start, projections, float(np.mean(volume.spacing_mm)), unit, settings, 0, "cpu")
        for step in range(settings.iterations):
            trainer.step(step)
        shown = trainer.parameters.to_set().to_torch()
        peak = true.peak(held)
        return np.mean([psnr(radiograph(shown, true.detectors[i]).numpy(), true.images[i], peak) for i in held])

    best, worst, without = quality(clean, "none"), quality(uneven, "none"), quality(uneven, "ring")
    assert best - worst > 2
    assert without - worst > 0.8 * (best - worst)
