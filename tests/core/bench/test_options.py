"""`insideout bench options`: which settings each row stands for, and rows for both halves of a capture."""

import shutil
from dataclasses import replace

import pytest

from insideout.core.bench import options
from insideout.core.bench.options import measure_options, option_cases
from insideout.core.bench.tables import options_table
from insideout.core.errors import CaptureError, SettingError
from insideout.core.settings import Settings
from insideout.core.stages.initialize import InitializeSettings
from insideout.core.stages.surface import PRESETS
from insideout.core.train.schedule import Growth, Stop


@pytest.fixture
def short(monkeypatch):
    """The preset draft with few iterations and splats."""

    def of(preset, seed):
        whole = Settings.of(preset, seed)
        surface = whole.stages["surface"]
        few = replace(
            surface, rgb=replace(surface.rgb, iterations=20), xray=replace(surface.xray, iterations=12, smooth_weight=0)
        )
        start = InitializeSettings(hull_cells=20, most_rgb=700, xray_splats=600)
        return replace(whole, stages={**whole.stages, "initialize": start, "surface": few})

    monkeypatch.setattr(options, "Settings", type("Short", (), {"of": staticmethod(of)}))


@pytest.mark.parametrize(("half", "single"), [("rgb", ["growth", "budget", "stop"]), ("xray", ["budget", "stop"])])
def test_each_option_is_on_alone_then_all(half, single):
    chosen = getattr(PRESETS["draft"], half)
    cases = option_cases(half, replace(chosen, stop=Stop(), strategy=replace(chosen.strategy, budget=True)))
    assert list(cases) == ["none", *single, "all"]

    def on(settings):
        found = {"budget": settings.strategy.budget, "stop": settings.stop is not None}
        growing = {"growth": settings.growth != Growth()} if half == "rgb" else {}
        return {name for name, value in {**found, **growing}.items() if value}

    assert on(cases["none"]) == set()
    assert on(cases["all"]) == set(single)
    for name in single:
        assert on(cases[name]) == {name}


def test_the_rest_of_a_preset_stays_as_it_is():
    for half in ("rgb", "xray"):
        chosen = getattr(PRESETS["draft"], half)
        off = {"stop": None, "strategy": replace(chosen.strategy, budget=False)}
        growth = {"growth": Growth()} if half == "rgb" else {}
        assert option_cases(half, chosen)["none"] == replace(chosen, **off, **growth)


def test_both_halves_have_their_rows(tiny_capture, short):
    told = []
    rows = measure_options(tiny_capture, tell=told.append)
    assert [(row["half"], row["options"]) for row in rows] == [
        *[("rgb", name) for name in ("none", "growth", "budget", "stop", "all")],
        *[("xray", name) for name in ("none", "budget", "stop", "all")],
    ]
    for row in rows:
        most = 20 if row["half"] == "rgb" else 12
        assert row["iterations"] == most or row["options"] in ("stop", "all")
        assert min(row["seconds"], row["cpu_seconds"], row["splats"], row["heldout_psnr"]) > 0
        assert row["cpu"]
    assert "xray: fitting, options: budget" in told
    assert options_table(rows).markdown().splitlines()[2].startswith("| half | options | iterations | seconds |")


@pytest.mark.parametrize(("half", "kind", "most"), [("rgb", "photos", 20), ("xray", "projections", 12)])
def test_the_quality_is_that_of_the_set_that_was_left(tiny_capture, short, monkeypatch, half, kind, most):
    """What the curve in the report ends with, drawn as it was trained, unless it was stopped early: the curve has no
    value for then."""
    from insideout.core.stages import surface

    reports = []
    fit = surface.run
    monkeypatch.setattr(surface, "run", lambda *given: reports.append(fit(*given)) or reports[-1])
    compiled = []
    monkeypatch.setattr(options, "compile_kernels", lambda *_: compiled.append(len(reports)))
    rows = measure_options(tiny_capture, halves=(half,))
    whole = [(row, report[half]["heldout"][-1]) for row, report in zip(rows, reports, strict=True)]
    whole = [(row, last) for row, last in whole if row["options"] in ("none", "budget")]
    assert len(whole) == 2
    for row, last in whole:
        assert last["iteration"] == row["iterations"] == most
        assert row["heldout_psnr"] == pytest.approx(last[kind], abs=1e-4)
    assert compiled == [0], "the first row waits for kernels"


def test_a_half_that_is_not_there_is_named(tiny_capture, tmp_path):
    shutil.copytree(tiny_capture / "photos", tmp_path / "photos")
    with pytest.raises(CaptureError, match="--half xray"):
        measure_options(tmp_path, halves=("xray",))
    with pytest.raises(SettingError, match="--half photos"):
        measure_options(tmp_path, halves=("photos",))
