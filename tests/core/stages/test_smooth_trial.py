"""Whether less smoothness is tried beside all of it, what is decided, and who goes by it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from insideout.core.capture.model import Capture
from insideout.core.compare.methods import with_xray
from insideout.core.errors import SettingError
from insideout.core.files import write_json
from insideout.core.forecast.forecast import forecast
from insideout.core.forecast.speed import Speed, StepTime
from insideout.core.settings import Settings
from insideout.core.stages.context import StageContext
from insideout.core.stages.internal.joint import refine_jointly
from insideout.core.stages.internal.joint_settings import PRESETS as JOINT
from insideout.core.stages.internal.joint_settings import joint_in_iterations
from insideout.core.stages.internal.targets import SectionSeries
from insideout.core.stages.surface import PRESETS, SurfaceSettings
from insideout.core.stages.surface import run as run_surface
from insideout.core.stages.surface.smooth_trial import SmoothTrial, TrialRun
from insideout.core.stages.surface.stage import smooth_share
from insideout.core.stages.surface.xray import XraySettings, XrayTrainer
from insideout.core.train.schedule import Decay

from .conftest import projections_of

TRIAL = SmoothTrial(begin=0.25, steps=20, settle=4, every=2, fewest=20)
SETTINGS = XraySettings(iterations=200, smooth_weight=1.0, smooth_voxels=16, smooth_trial=TRIAL)
BEGIN, END = 50, 70


@pytest.fixture(scope="module")
def projections():
    from .conftest import shells_volume

    return projections_of(shells_volume(), count=30)


@pytest.fixture
def trainer(shells_context, projections):
    start = shells_context.run.read_set("surface", "xray")

    def of(**changes):
        return XrayTrainer(start, projections, 4 / 3, 0.08, replace(SETTINGS, **changes), seed=0, kernel="cpu")

    return of


def run(trainer, first, last):
    for iteration in range(first, last):
        trainer.step(iteration)
    return trainer


def same(one, two):
    sets = one.parameters.to_set(), two.parameters.to_set()
    return all(np.array_equal(a, b) for a, b in zip(*(vars(s).values() for s in sets), strict=True))


class TestVerdict:
    def verdict(self, *gains_db):
        """Of looks at four views in turn."""
        trial = TrialRun(TRIAL)
        trial.gains_db = [(look % 4, gain) for look, gain in enumerate(gains_db)]
        return trial.verdict()

    def test_the_part_wins_where_it_is_clearly_better(self):
        verdict = self.verdict(0.5, 0.3, 0.6, 0.4)
        assert verdict["share"] == TRIAL.share
        assert verdict["gain_db"] == pytest.approx(0.45)
        assert verdict["looks"] == 4

    def test_looks_are_averaged_before_views_are_compared(self):
        """Moments differ by more than weights do; views that agree over all of them are sure."""
        verdict = self.verdict(1.4, -0.6, 0.5, 0.2, -0.4, 1.6, 0.5, 0.8)
        assert verdict["gain_db"] == pytest.approx(0.5)
        assert verdict["error_db"] == pytest.approx(0.0, abs=1e-12)

    def test_a_little_better_is_no_reason(self):
        """What is smoothed less is ahead at first whether that lasts or not: 0.09 dB where true sections lose 0.5."""
        assert self.verdict(*[0.1] * 8)["share"] == 1.0

    def test_nor_is_what_only_one_view_says(self):
        verdict = self.verdict(3.0, -0.6, -0.6, -0.6)
        assert 0.2 < verdict["gain_db"] < verdict["error_db"]
        assert verdict["share"] == 1.0

    def test_nor_are_views_too_few_to_tell(self):
        assert self.verdict(2.0, 2.0, 2.0)["share"] == 1.0

    @pytest.mark.parametrize("gains", [(), (np.nan,) * 4])
    def test_without_a_view_that_can_be_measured_all_of_it_stays(self, gains):
        assert self.verdict(*gains) == {"share": 1.0}


class TestTrial:
    def test_fits_too_short_and_too_few_projections_have_none(self):
        assert TRIAL.suits(200, 20)
        assert not TRIAL.suits(199, 20)
        assert not TRIAL.suits(200, 19)

    def test_one_in_ten_is_set_aside_and_four_at_least(self):
        assert TRIAL.set_aside(np.arange(100, 150)).tolist() == [105, 115, 125, 135, 145]
        assert len(TRIAL.set_aside(np.arange(24))) == 4

    def test_sixteen_at_most(self):
        assert len(TRIAL.set_aside(np.arange(600))) == 16

    def test_looks_come_after_it_settles_at_one_view_after_the_other(self):
        trial, seen = TrialRun(TRIAL), []
        for trial.made in range(TRIAL.steps + 1):
            seen.append(trial.looks_at(np.array([7, 8, 9])))
        assert seen[:6] == [None] * 6
        assert [index for index in seen if index is not None] == [7, 8, 9, 7, 8, 9, 7, 8]
        assert TRIAL.looks == 8

    @pytest.mark.parametrize(
        "wrong",
        [{"share": 1.0}, {"share": -0.1}, {"every": 0}, {"settle": -1}, {"settle": 19}, {"every": 17}, {"fewest": 7}],
    )
    def test_settings_that_cannot_be_are_refused(self, wrong):
        with pytest.raises(SettingError, match=r"(share|steps|fewest) is"):
            replace(TRIAL, **wrong)

    def test_the_longer_presets_have_one_and_time_for_it(self):
        for preset in ("standard", "paper"):
            settings = PRESETS[preset].xray
            assert settings.smooth_trial.suits(settings.iterations, 50)
        assert PRESETS["draft"].xray.smooth_trial is None


class TestFit:
    def test_before_it_nothing_changes(self, trainer):
        assert same(run(trainer(), 0, BEGIN), run(trainer(smooth_trial=None), 0, BEGIN))

    def test_a_weight_that_hurts_is_lessened(self, trainer):
        """A hundred times what presets have: shells are smoothed away."""
        fit = run(trainer(smooth_weight=10.0), 0, END + 1)
        assert fit.smoothness["share"] == TRIAL.share
        assert fit.smoothness["gain_db"] > 0.2

    def test_from_then_on_it_is_the_fit_with_the_part(self, trainer, projections):
        """Alone, with the same projections set aside, a fit that goes on with the part comes to the same bits."""
        fit = run(trainer(smooth_weight=10.0), 0, END + 1)
        alone = run(trainer(smooth_weight=10.0, smooth_trial=None), 0, BEGIN)
        every, alone._fit.smooth_weight = alone.training, 10.0 * TRIAL.share
        alone.training = np.setdiff1d(every, TRIAL.set_aside(every))
        run(alone, BEGIN, END)
        alone.training = every
        assert same(fit, run(alone, END, END + 1))

    def test_a_weight_that_does_nothing_stays(self, trainer):
        fit = run(trainer(smooth_weight=1e-6), 0, END + 1)
        assert fit.smoothness["share"] == 1.0
        assert abs(fit.smoothness["gain_db"]) < 0.05

    def test_all_training_projections_are_shown_again_and_never_a_held_out_one(self, trainer, projections):
        fit = trainer()
        training = fit.training
        run(fit, 0, BEGIN + 1)
        aside = np.setdiff1d(training, fit.training)
        assert len(aside) == 4
        assert not projections.held_out[aside].any()
        run(fit, BEGIN + 1, END + 1)
        assert np.array_equal(fit.training, training)

    def test_steps_are_not_usual_meanwhile(self, trainer):
        fit = trainer()
        assert run(fit, 0, BEGIN).usual
        assert not run(fit, BEGIN, BEGIN + 1).usual
        assert not run(fit, BEGIN + 1, END).usual
        assert run(fit, END, END + 1).usual

    @pytest.mark.parametrize(("made", "share"), [(14, TRIAL.share), (10, 1.0), (2, 1.0)])
    def test_a_fit_that_ends_before_it_is_decided_by_what_was_seen(self, trainer, made, share):
        """At a deadline: five looks of eight are enough, three and none are not."""
        fit = run(trainer(smooth_weight=10.0), 0, BEGIN + made)
        training, less = fit.training, fit._rival.parameters
        fit.finish()
        assert fit.smoothness["share"] == share
        assert (fit.parameters is less) == (share < 1)
        assert len(fit.training) == len(training) + 4
        assert fit.usual

    def test_where_iterations_are_left_out_it_ends_all_the_same(self, trainer):
        fit = run(trainer(smooth_weight=10.0), 0, BEGIN)
        last = BEGIN + 2 * TRIAL.steps
        for iteration in range(BEGIN, last, 3):
            fit.step(iteration)
        assert not fit.smoothness
        fit.step(last)
        assert fit.smoothness["looks"] == 5

    def test_a_fit_without_a_trial_has_nothing_to_decide(self, trainer):
        fit = run(trainer(smooth_trial=None), 0, 1)
        fit.finish()
        assert not fit.smoothness

    def test_without_smoothness_there_is_nothing_to_try(self, trainer):
        assert not run(trainer(smooth_weight=0.0), 0, END + 1).smoothness

    @pytest.mark.parametrize("broken_off", [BEGIN - 1, BEGIN + 1, BEGIN + 10, END, END + 1])
    def test_it_goes_on_bit_for_bit_wherever_it_is_broken_off(self, trainer, broken_off, tmp_path):
        whole, first, second = trainer(smooth_weight=10.0), trainer(smooth_weight=10.0), trainer(smooth_weight=10.0)
        run(first, 0, broken_off)
        torch.save(first.state(), tmp_path / "checkpoint")
        second.restore(torch.load(tmp_path / "checkpoint", weights_only=True))
        run(second, broken_off, END + 10)
        run(whole, 0, END + 10)
        assert same(second, whole)
        assert second.smoothness == whole.smoothness
        assert np.array_equal(second.training, whole.training)

    def test_a_projection_set_aside_that_is_not_finite_does_not_count(self, shells_context, projections):
        images, training = projections.images.copy(), np.flatnonzero(~projections.held_out)
        images[TRIAL.set_aside(training)] = np.nan
        start = shells_context.run.read_set("surface", "xray")
        fit = XrayTrainer(start, replace(projections, images=images), 4 / 3, 0.08, SETTINGS, seed=0, kernel="cpu")
        assert run(fit, 0, END + 1).smoothness == {"share": 1.0}


def test_the_stage_reports_what_it_came_to_though_the_fit_ends_before_it(shells_context, projections):
    """Begun ten steps before the end; the next stage reads it from the report."""
    capture, run_folder = replace(shells_context.capture, photos=None, projections=projections), shells_context.run
    context = StageContext(capture, run_folder, seed=0)
    run_folder.write_set("initialize", "xray", run_folder.read_set("surface", "xray"))
    late = SmoothTrial(share=0.0, begin=0.95, steps=20, settle=0, every=1)
    # Rates that stay high: ten steps make a difference.
    rates = {"density_rate": Decay(0.1), "scale_rate": Decay(0.05)}
    settings = replace(SETTINGS, smooth_weight=10.0, smooth_trial=late, **rates)
    report = run_surface(context, SurfaceSettings(xray=settings))
    assert report["xray"]["smoothness"]["looks"] == 10
    assert report["xray"]["smoothness"]["share"] == late.share
    assert report["xray"]["projections"]["training"] == int((~projections.held_out).sum())
    write_json(run_folder.path / "surface" / "report.json", report)
    assert smooth_share(run_folder) == late.share


def test_the_joint_refinement_smooths_as_much_as_surface_found_good(shells_context):
    run_folder, series = shells_context.run, SectionSeries(shells_context.run.volume(), ("axial",))
    start = run_folder.read_set("surface", "xray")

    def weight():
        settings = joint_in_iterations(JOINT["standard"], 2)
        _, report = refine_jointly(shells_context, settings, series, None, None, start, 0.0, 1.0)
        return report["trained_with"]["smooth_weight"]

    assert smooth_share(run_folder) == 1.0
    full = weight()
    write_json(run_folder.path / "surface" / "report.json", {"xray": {"smoothness": {"share": 0.3}}})
    assert smooth_share(run_folder) == 0.3
    assert weight() == pytest.approx(0.3 * full)


def test_a_run_s_forecast_counts_both_fits(projections, tmp_path):
    capture, each = Capture(path=tmp_path, projections=projections), StepTime(0.01, 0.0, 0.0)

    def steps(**changes):
        settings = with_xray(Settings.of("standard"), **changes)
        return forecast(capture, settings, Speed(None, each, each)).parts["surface xray"] / 0.01

    trial = PRESETS["standard"].xray.smooth_trial
    assert steps(smooth_trial=trial) == pytest.approx(steps(smooth_trial=None) + trial.steps + 2 * 0.4 * trial.looks)
    assert steps(smooth_trial=replace(trial, fewest=25)) == pytest.approx(steps(smooth_trial=None))
