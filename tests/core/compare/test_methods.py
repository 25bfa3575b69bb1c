"""Which rows there are of a capture, with which settings and notes, and the options that choose them."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from insideout.core.capture.read import read_capture
from insideout.core.cli import app
from insideout.core.compare.ablation import ABLATION, ablation_of
from insideout.core.compare.methods import METHODS, RATES, VolumeJob, _naf, with_xray, without_repeats
from insideout.core.compare.notes import note_of
from insideout.core.compare.options import CompareSettings, compare_settings
from insideout.core.compare.planned import plan_of
from insideout.core.compare.study import Made
from insideout.core.errors import SettingError
from insideout.core.files import plain
from insideout.core.naf.train import NafSettings
from insideout.core.progress import Reporter
from insideout.core.settings import Settings
from insideout.core.volume import Volume


@pytest.mark.parametrize("name", [name for name, method in METHODS.items() if method.volume or method.mesh])
def test_rows_of_voxels_and_meshes_know_their_own_settings(name):
    assert json.dumps(plain(METHODS[name].own())) not in ("null", "{}")


def test_naf_s_scale_reaches_the_densest_voxel(tiny_capture, tiny_settings, monkeypatch, tmp_path):
    given = []
    monkeypatch.setattr("insideout.core.naf.timed.naf_within", lambda *told: (given.append(told), None))
    values = np.full((20, 20, 20), 0.02, np.float32)
    values[10, 10, 10] = 1.0
    start = Volume.centered(values, np.ones(3))
    _naf(VolumeJob(read_capture(tiny_capture), tmp_path, tiny_settings, 5.0, start, Reporter()))
    seconds, _, attenuation, *_ = given[0]
    assert seconds == 5.0
    assert NafSettings.headroom * attenuation == pytest.approx(1.0)


def test_a_plan_tells_the_rows_to_come_in_the_order_in_which_they_are_made(tiny_capture):
    settings, capture = Settings.of("draft"), read_capture(tiny_capture)
    methods = [METHODS[name] for name in ("3dgs", "fdk", "insideout")]
    options = CompareSettings(projections=(12, 8), ablation_rows=("none",))
    plan = plan_of(capture, methods, options, settings)
    assert plan.labels == [
        "InsideOut",
        "3DGS",
        "FDK",
        "the alignment",
        "ablation, none",
        "12 projections, InsideOut",
        "12 projections, FDK",
        "8 projections, InsideOut",
        "8 projections, FDK",
    ]
    assert plan.possible == list(METHODS)
    alone = plan_of(capture.xrays_only(), methods, replace(options, ablation=False, projections=()), settings)
    assert alone.labels == ["InsideOut", "FDK"]
    assert "3dgs" not in alone.possible
    # Without photos a row with all projections would only repeat the method's own.
    every = int((~capture.projections.held_out).sum())
    thinned = replace(options, ablation=False, projections=(every, 8))
    assert list(plan_of(capture, methods, thinned, settings).thinned) == [every, 8]
    assert list(plan_of(capture.xrays_only(), methods, thinned, settings).thinned) == [8]


def test_photos_that_nothing_is_known_of_inside_have_no_alignment_and_no_ablation_to_come(tiny_capture, tmp_path):
    capture = replace(read_capture(tiny_capture).photos_only(), path=tmp_path)
    methods = [METHODS[name] for name in ("3dgs", "insideout")]
    assert plan_of(capture, methods, CompareSettings(), Settings.of("draft")).labels == ["InsideOut", "3DGS"]


def test_without_projections_halves_apart_would_only_repeat_the_insideout_row(tiny_capture):
    capture = replace(read_capture(tiny_capture), projections=None)
    assert "halves stay apart in the row insideout" in METHODS["apart"].reason_not_for(capture)
    assert METHODS["insideout"].reason_not_for(capture) is None
    assert METHODS["apart"].reason_not_for(read_capture(tiny_capture)) is None


def test_notes_speak_of_what_the_capture_has(tiny_capture):
    whole = read_capture(tiny_capture)
    volume = Volume.centered(np.ones((4, 4, 4), np.float32), np.ones(3))
    scanned = replace(whole, projections=None, volume=volume)
    notes = {
        name: note_of(METHODS["insideout"], capture)
        for name, capture in {
            "both": whole,
            "xrays": whole.xrays_only(),
            "photos": whole.photos_only(),
            "scanned": scanned,
            "volume": replace(scanned, photos=None),
        }.items()
    }
    assert notes["both"] == METHODS["insideout"].note
    assert len(set(notes.values())) == 5
    assert "no photos, no alignment, and no sections" in notes["xrays"]
    assert [name for name, note in notes.items() if "photo" in note.lower()] == ["both", "xrays", "photos", "scanned"]
    assert "photos" not in note_of(METHODS["apart"], whole.xrays_only())
    assert note_of(METHODS["fdk"], whole) == METHODS["fdk"].note


def test_the_ablation_s_rows_have_what_their_labels_say():
    settings = Settings.of("draft")
    assert all("internal" in row.leave_out for row in ABLATION if row.modality == "xray")
    ways = {row.label: row.change(settings).stages["internal"].joint for row in ABLATION}
    assert ways["alignment + internal rendering"] is None
    assert ways["alignment + internal rendering, without the finish on photos"] is None
    assert ways["alignment + joint refinement"] is not None


@pytest.mark.parametrize(
    ("preset", "without"),
    [
        # It has no time to try less smoothness.
        ("draft", {"ablation/without_trial"}),
        ("standard", set()),
        ("paper", set()),
    ],
)
def test_an_ablation_row_that_changes_nothing_in_a_preset_is_left_out(preset, without, tiny_capture):
    settings = Settings.of(preset)
    rows = ablation_of(settings, read_capture(tiny_capture))
    assert {row.name for row in ABLATION} - {row.name for row in rows} == without
    made = [(row.modality, row.leave_out, plain(row.change(settings))) for row in rows if row.for_iterations is None]
    assert all(made.count(one) == 1 for one in made)


def test_some_rows_of_the_ablation_can_be_chosen_and_x_rays_alone_have_those_of_their_half(tiny_capture):
    settings, capture = Settings.of("standard"), read_capture(tiny_capture)
    rows = ablation_of(settings, capture, ("r2_at_our_rates", "none", "apart"))
    assert [row.name for row in rows] == ["ablation/none", "apart", "r2_at_our_rates"]
    alone = ablation_of(settings, capture.xrays_only())
    assert {row.modality for row in alone} == {"xray"}
    assert "ablation/fine_start" in {row.name for row in alone}
    with pytest.raises(SettingError, match="--ablation-rows without_trial: at preset draft it changes nothing"):
        ablation_of(Settings.of("draft"), capture, ("none", "without_trial"))
    with pytest.raises(SettingError, match="--ablation-rows all: there is no such row; choose of none, align, apart"):
        ablation_of(settings, capture, ("all",))


def test_r2_gaussian_at_our_rates_differs_in_its_rates_alone():
    settings = Settings.of("standard")
    row = METHODS["r2_at_our_rates"]
    ours = settings.stages["surface"].xray
    tuned, published = (method.for_iterations(settings, 1700).stages for method in (row, METHODS["r2_gaussian"]))
    assert tuned["initialize"] == published["initialize"]
    fit, plain_fit = tuned["surface"].xray, published["surface"].xray
    rates = {name: getattr(ours, name) for name in ("means_rate", "density_rate", "scale_rate", "rotation_rate")}
    assert fit == replace(plain_fit, **rates) != plain_fit


def test_the_time_spent_on_x_rays_has_all_parts():
    def seconds(**internal):
        stages = {"surface": {"xray": {"seconds": 10.0}}, "internal": internal}
        return Made(METHODS["insideout"], Path(), {"stages": stages}).xray_seconds

    assert seconds(xray={"seconds": 4.0}) == 14.0
    assert seconds(joint={"seconds": 45.0, "xray_seconds": 20.0}) == 30.0
    assert seconds(skipped="left out") == 10.0


def test_options_of_the_command_line():
    options = compare_settings(
        ("insideout", "fdk"), "draft", 3, "cpu", 5, "75,50", "none", True, ablation_rows=("none", "apart")
    )
    assert options.methods == ("insideout", "fdk")
    assert (options.settings.preset, options.settings.seed, options.same_time) == ("draft", 3, False)
    assert (options.starts, options.projections, options.ablation) == (5, (75, 50), True)
    assert options.ablation_rows == ("none", "apart")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seconds_like": "naf"}, "--seconds-like naf"),
        ({"starts": -1}, "--starts -1"),
        ({"projections": "75,half"}, "--projections 75,half"),
        ({"projections": "2"}, "--projections 2"),
        ({"ablation_rows": ("none",), "ablation": False}, "--ablation-rows: --no-ablation leaves them all out"),
        ({"ablation_rows": ("none",), "methods": ("fdk",)}, "--ablation-rows: .* add it to --methods"),
    ],
)
def test_options_out_of_range_are_refused(changes, message):
    given = {"methods": (), "preset": "draft", "seed": 0, "kernel": "cpu", "starts": 1, "projections": ""}
    with pytest.raises(SettingError, match=message):
        compare_settings(**{**given, "seconds_like": "insideout", "ablation": True, **changes})


def test_a_method_that_would_only_repeat_another_is_no_row_of_its_own(tiny_capture):
    methods = [METHODS[name] for name in ("naf", "r2_gaussian", "r2_at_our_rates", "sart", "fdk", "3dgs", "mcmc")]
    assert without_repeats(methods, Settings.of("standard")) == methods
    published = METHODS["r2_gaussian"].for_iterations(Settings.of("standard"), 1700).stages["surface"].xray
    rates = {name: getattr(published, name) for name in RATES}
    kept = without_repeats(methods, with_xray(Settings.of("standard"), **rates))
    assert [method.name for method in kept] == ["naf", "r2_gaussian", "sart", "fdk", "3dgs", "mcmc"]


def test_the_command_s_help_names_every_method():
    shown = CliRunner().invoke(app, ["compare", "--help"], env={"COLUMNS": "300", "TERM": "dumb"}).output
    assert f"Any of {', '.join(METHODS)}." in " ".join(shown.replace("│", " ").split())


def test_a_run_loads_none_of_the_other_methods():
    """What is not chosen costs nothing; in a process of its own, where no other test has loaded them."""
    code = (
        "import sys, insideout.core.pipeline, insideout.core.stages.surface, insideout.core.stages.internal\n"
        "others = ('naf', 'stereo', 'rivals', 'x_gaussian', 'mcmc', 'mask', 'compare', 'sart')\n"
        "print([name for name in sys.modules if name.startswith('insideout') and set(name.split('.')) & set(others)])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.strip() == "[]"


@pytest.mark.parametrize("preset", ["draft", "standard", "paper"])
def test_photo_rows_are_as_published_where_our_presets_are_not(preset):
    settings = Settings.of(preset)
    rows = [method for method in METHODS.values() if method.modality == "photos" and method.mesh is None]
    assert len(rows) >= 6
    drawn = [method.change(settings).stages["surface"].rgb for method in rows]
    assert {(rgb.low_pass, rgb.mip_filter, rgb.decay.at(1.0), rgb.degree) for rgb in drawn} == {(0.3, False, 1.0, 3)}
    ours = METHODS["insideout"].change(settings).stages["surface"].rgb
    assert (ours.low_pass < 0.3, ours.mip_filter) == (True, True)
    assert (ours.decay.at(1.0), ours.degree) == (1.0 if preset == "draft" else 0.2, 1)


@pytest.mark.parametrize("preset", ["standard", "paper"])
def test_photo_rows_of_long_presets_have_published_rates_and_densify_as_often(preset):
    published = {"means_rate": 1.6e-4, "sh_rate": 2.5e-3, "opacity_rate": 0.05, "scale_rate": 5e-3}
    rgb = METHODS["3dgs"].change(Settings.of(preset)).stages["surface"].rgb
    assert rgb.means_rate.start == published.pop("means_rate")
    assert {name: getattr(rgb, name) for name in published} == published
    assert rgb.strategy.every == 100
