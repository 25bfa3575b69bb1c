"""The settings and the pace of a run that is to end in a given time."""

from dataclasses import replace

import numpy as np
import pytest

from insideout.core.capture.read import read_capture
from insideout.core.effects import MotionBlur
from insideout.core.errors import SettingError
from insideout.core.files import write_json
from insideout.core.forecast import budget
from insideout.core.forecast.budget import fit_into_time
from insideout.core.forecast.forecast import forecast
from insideout.core.forecast.speed import Speed, StepTime
from insideout.core.gaussians import GaussianSet
from insideout.core.progress import Reporter
from insideout.core.run_folder import RunFolder
from insideout.core.settings import Settings

# Every step takes the same, whatever it is made of.
EVEN = StepTime(0.01, 0.0, 0.0)


@pytest.fixture(scope="module")
def capture(tiny_capture):
    return read_capture(tiny_capture)


def test_a_long_time_is_given_to_the_longest_preset(capture, tmp_path):
    settings, told = replace(Settings.of("draft"), time_budget_s=1e6), []
    reporter = Reporter(lambda progress: told.append(progress.message))
    chosen, pace = fit_into_time(capture, RunFolder(tmp_path), settings, True, lambda: 0.0, reporter)
    assert chosen.preset == "paper"
    assert pace.parts["surface rgb"] > 0
    assert "of which it needs less" in told[-1]


def test_presets_that_would_take_too_long_are_not_measured_out_of_a_short_time(capture, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(budget, "forecast", lambda *given: asked.append(given[1].preset) or forecast(*given))
    settings = replace(Settings.of("standard"), time_budget_s=30.0)
    seconds = forecast(capture, Settings.of("draft"), Speed(EVEN, EVEN, EVEN)).seconds
    monkeypatch.setattr("insideout.core.forecast.speed.measure_speed", lambda *given: Speed(EVEN, EVEN, EVEN))
    assert seconds > 30.0
    fit_into_time(capture, RunFolder(tmp_path), settings, True, lambda: 0.0, Reporter())
    assert asked == ["draft"]


def test_effects_that_auto_finds_are_counted_in_the_time_once_they_are_known(capture, tmp_path, monkeypatch):
    timed = []

    def measured(capture, long_side, tick, known, rgb):
        timed.append(rgb.effects)
        return Speed(StepTime(0.07, 0.0, 0.0) if rgb.effects else EVEN, EVEN, EVEN)

    monkeypatch.setattr("insideout.core.forecast.speed.measure_speed", measured)
    settings = replace(Settings.of("draft"), effects="auto", time_budget_s=1e4)
    _, pace = fit_into_time(capture, RunFolder(tmp_path), settings, False, lambda: 0.0, Reporter())
    plain = dict(pace.parts)
    assert pace.anew(frozenset(), {}) == plain
    blurred = pace.anew(frozenset({"motion_blur"}), {})
    assert blurred["surface rgb"] == pytest.approx(7 * plain["surface rgb"])
    assert list(blurred)[-1] == "report"
    assert pace.anew(frozenset({"motion_blur"}), {}) == blurred
    assert timed == [(), (MotionBlur(),)], "each measured once"


def test_features_are_timed_once_in_a_run_whatever_effects_are_found(capture, tmp_path, monkeypatch):
    timed = []
    monkeypatch.setattr("insideout.core.forecast.speed.time_points", lambda photos, tick: timed.append(photos))
    settings = replace(Settings.of("draft"), effects="auto", time_budget_s=1e4)
    _, pace = fit_into_time(capture, RunFolder(tmp_path), settings, False, lambda: 0.0, Reporter())
    pace.anew(frozenset({"motion_blur"}), {})
    assert len(timed) == 1


def test_splats_that_have_grown_since_are_counted_in_the_time(capture, tmp_path, monkeypatch):
    by_splat = StepTime(0.001, 1e-6, 0.0)
    monkeypatch.setattr("insideout.core.forecast.speed.measure_speed", lambda *given: Speed(by_splat, by_splat, EVEN))
    settings, run = replace(Settings.of("draft"), time_budget_s=1e4), RunFolder(tmp_path)
    _, pace = fit_into_time(capture, run, settings, False, lambda: 0.0, Reporter())
    foreseen = dict(pace.parts)
    pace.splats["surface rgb"] = 300_000
    pace.iterations("surface xray", 1000)
    assert pace.parts["surface rgb"] > 1.5 * foreseen["surface rgb"]
    assert pace.parts["surface xray"] == foreseen["surface xray"]
    run.write_set("surface", "xray", GaussianSet.create(np.zeros((300_000, 3), np.float32), 1.0))
    write_json(run.stage("surface") / "report.json", {})
    assert pace.anew(frozenset(), {})["internal joint"] > 1.5 * foreseen["internal joint"], "of a stage that is done"


def test_a_run_that_was_begun_with_a_preset_goes_on_with_it(capture, tmp_path):
    settings = replace(Settings.of("draft"), time_budget_s=1e6)
    write_json(tmp_path / "settings.json", settings)
    for fresh, preset in ((False, "draft"), (True, "paper")):
        chosen, _ = fit_into_time(capture, RunFolder(tmp_path), settings, True, lambda: 0.0, Reporter(), (), fresh)
        assert chosen.preset == preset


@pytest.mark.parametrize(("compiled", "told"), [(True, "machine whatever"), (False, "machine this time, in which")])
def test_what_was_compiled_once_is_said_of_a_time_that_is_too_short(capture, tmp_path, monkeypatch, compiled, told):
    monkeypatch.setattr("insideout.core.render.kernels.cpu.is_compiled", lambda renderers: compiled)
    settings = replace(Settings.of("draft"), time_budget_s=1.0)
    with pytest.raises(SettingError, match=told):
        fit_into_time(capture, RunFolder(tmp_path), settings, True, lambda: 0.0, Reporter())


def test_the_reference_kernel_has_no_time(capture, tmp_path):
    settings = replace(Settings.of("draft", kernel="reference"), time_budget_s=300.0)
    with pytest.raises(SettingError, match="--kernel reference are not timed"):
        fit_into_time(capture, RunFolder(tmp_path), settings, False, lambda: 0.0, Reporter())
