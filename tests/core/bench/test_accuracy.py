"""What accuracy costs: the knobs, the rows of a tiny capture, the front, the plot and the table."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from insideout.core.bench.accuracy import measure
from insideout.core.bench.accuracy.knobs import KNOBS, Position, pareto_front, positions
from insideout.core.bench.accuracy.measure import AccuracySettings, measure_accuracy
from insideout.core.bench.accuracy.plot import draw_front
from insideout.core.bench.accuracy.table import accuracy_table, presets_table
from insideout.core.capture.model import Capture, Lens, Photo, Photos, Projections
from insideout.core.capture.read import read_capture
from insideout.core.capture.registered import save_photos
from insideout.core.compare.methods import with_stage
from insideout.core.errors import CaptureError, RunFolderError, SettingError
from insideout.core.files import plain
from insideout.core.forecast.forecast import forecast
from insideout.core.forecast.pace import least_seconds
from insideout.core.forecast.speed import Speed, StepTime
from insideout.core.plotting import INK
from insideout.core.run_folder import RunFolder
from insideout.core.settings import PRESETS, Settings
from insideout.core.train.mask import MaskStrategy
from insideout.core.train.smoothness import EDGE
from insideout.core.views import Camera, Detector
from insideout.core.volume import Volume


@pytest.fixture(scope="module")
def capture(tiny_capture):
    return read_capture(tiny_capture)


@pytest.mark.parametrize("preset", ["draft", "standard", "paper"])
def test_every_position_changes_something(capture, preset):
    settings = Settings.of(preset)
    for position in positions(settings, capture, (), ())[1:]:
        changed = position.change(settings)
        thinned = position.thin is not None and position.thin(capture).digest != capture.digest
        assert plain(changed) != plain(settings) or thinned, position


@pytest.mark.parametrize("own", [False, True])
def test_fewer_or_more_iterations_are_those_of_all_that_a_time_budget_changes(capture, own):
    """Whichever route the capture takes: a volume of one's own is followed apart, whatever the settings say."""
    settings, step = Settings.of("draft"), StepTime(0.01, 0.0, 0.0)
    taken = replace(capture, volume=Volume(np.ones((2, 2, 2), np.float32), np.ones(3), np.zeros(3)) if own else None)

    def parts(settings):
        found = forecast(taken, settings, Speed(step, step, step)).parts
        return {part: seconds for part, seconds in found.items() if least_seconds({part: 1.0}) < 1}

    whole = parts(settings)
    assert ("fuse finish" in whole) is own
    for factor in (0.25, 0.5, 2.0):
        (row,) = (one for one in positions(settings, capture, ("iterations",), ()) if one.value == f"×{factor:g}")
        assert parts(row.change(settings)) == pytest.approx({part: factor * whole[part] for part in whole}, rel=0.02)


def test_what_a_preset_leaves_out_stays_out_whatever_the_iterations(capture):
    unfinished = with_stage(Settings.of("draft"), "fuse", iterations=0)
    row = positions(unfinished, capture, ("iterations",), ())[1]
    assert row.knob == "iterations"
    assert row.change(unfinished).stages["fuse"].iterations == 0


def test_rows_have_folders_of_their_own(capture):
    rows = positions(Settings.of("draft"), capture, (), PRESETS)
    assert len({row.folder for row in rows}) == len(rows)
    assert not any(set(row.folder) & set("/ :×½σ") for row in rows)


@pytest.mark.parametrize("preset", ["draft", "standard"])
def test_smoothness_is_turned_where_projections_are_fitted_and_where_all_is_refined(capture, preset):
    given = Settings.of(preset)
    usual = given.stages["surface"].xray.smooth_weight
    found = {row.value: row.change(given) for row in positions(given, capture, ("smoothness",), ())[1:]}
    for value, weight, edge in (
        ("none", 0.0, EDGE),
        ("twice the weight", 2 * usual, EDGE),
        ("edges as all else", usual / 10, None),
    ):
        for settings in (found[value].stages["surface"].xray, found[value].stages["internal"].joint):
            assert (settings.smooth_weight, settings.smooth_edge) == (pytest.approx(weight), edge)
        assert found[value].stages["surface"].xray.smooth_trial is None, "what is measured is this weight"
    assert ("less not tried" in found) == (preset == "standard")


def test_strategies_made_for_more_iterations_go_as_far_in_fewer(capture):
    given = Settings.of("draft")
    rgb = given.stages["surface"].rgb
    rows = {row.value: row.change(given) for row in positions(given, capture, ("strategy",), ())[1:]}
    mcmc, mask = (rows[name].stages["surface"].rgb.strategy for name in ("mcmc", "mask"))
    relocations = int((mcmc.stop - mcmc.start) * rgb.iterations / mcmc.every)
    assert (1 + mcmc.growth) ** relocations > 4
    assert mask.rate * rgb.iterations == pytest.approx(MaskStrategy.rate * 30_000)
    assert mask.densify == rgb.strategy


def test_the_preset_comes_first_and_knobs_can_be_chosen(capture):
    rows = positions(Settings.of("draft"), capture, ("rays", "harmonics"), ("draft", "standard"))
    assert [(row.knob, row.value) for row in rows[:3]] == [
        ("preset", "draft"),
        ("preset", "standard"),
        ("rays", "affine"),
    ]
    assert {row.knob for row in rows} == {"preset", "rays", "harmonics"}


def test_every_preset_is_measured_with_fewer_and_more_iterations_of_its_own(capture):
    """Else nothing would show whether `standard` and `paper` are knees."""
    rows = positions(Settings.of("draft"), capture, ("iterations",), PRESETS)
    factors = ("×0.25", "×0.5", "×2")
    assert [row.value for row in rows if row.knob == "iterations"] == [
        *factors,
        *(f"standard {factor}" for factor in factors),
        *(f"paper {factor}" for factor in factors),
    ]
    given = Settings.of("draft")
    for preset in ("standard", "paper"):
        own = Settings.of(preset)
        expected = {row.value: row.change(own) for row in positions(own, capture, ("iterations",), ())}
        for factor in factors:
            (row,) = (row for row in rows if row.value == f"{preset} {factor}")
            assert plain(row.change(given)) == plain(expected[factor])


@pytest.mark.parametrize(("knobs", "presets", "named"), [(("rays", "speed"), (), "speed"), ((), ("best",), "best")])
def test_what_does_not_exist_is_named(capture, knobs, presets, named):
    with pytest.raises(SettingError, match=named):
        positions(Settings.of("draft"), capture, knobs, presets)


def test_knobs_of_what_a_capture_lacks_are_left_out(capture):
    photos = {row.knob for row in positions(Settings.of("draft"), capture.photos_only(), (), ())}
    xrays = {row.knob for row in positions(Settings.of("draft"), capture.xrays_only(), (), ())}
    assert not photos & {"rays", "precision", "smoothness", "projections", "start", "sections", "route"}
    assert not xrays & {"photos", "harmonics", "pixels", "strategy"}
    assert {"iterations", "splats", "schedule", "resolution"} <= photos & xrays


CAMERA = Camera(8, 6, 10.0, 10.0, 4.0, 3.0, np.eye(4))
LENS = Lens(8, 6, 10.0, 10.0, 4.0, 3.0, (0.1,))
VOLUME = Volume(np.zeros((2, 2, 2), np.float32), np.ones(3), np.zeros(3))


def photos_of(folder, camera, lens=None):
    """Sixteen, of which two are kept back where their cameras are known."""
    held_out = [camera is not None and index % 8 == 0 for index in range(16)]
    return Photos([Photo(folder / f"{index}.png", camera, held, lens) for index, held in enumerate(held_out)])


def scan_of(count=16):
    detector = Detector(4, 4, np.zeros(3), np.ones(3), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]))
    box = np.array([[-1.0] * 3, [1.0] * 3])
    held_out = np.arange(count) % 8 == 0
    return Projections(
        np.ones((count, 4, 4), np.float32), [detector] * count, held_out, np.arange(count) / 9, box, (2, 2, 2)
    )


@pytest.mark.parametrize(("camera", "lens", "measured"), [(None, None, 0), (CAMERA, LENS, 0), (CAMERA, None, 1)])
def test_an_effect_that_a_run_would_refuse_is_no_row(tmp_path, camera, lens, measured):
    capture = Capture(tmp_path, photos_of(tmp_path, camera, lens), scan_of())
    rows = [row.value for row in positions(Settings.of("draft"), capture, ("effects",), ())]
    assert rows.count("lens") == measured
    assert {"exposure", "moving_background", "geometry", "noise"} < set(rows)


def test_a_volume_alone_has_presets_and_what_follows_its_sections(tmp_path):
    rows = positions(Settings.of("draft"), Capture(tmp_path, volume=VOLUME), (), ("standard",))
    assert [(row.knob, row.value) for row in rows[:2]] == [("preset", "draft"), ("preset", "standard")]
    assert {row.knob for row in rows} == {"preset", "iterations", "sections"}
    assert "none" not in {row.value for row in rows}


@pytest.fixture
def without_cameras(tmp_path, monkeypatch):
    """Measures knobs of a capture, or of its photos alone, whose cameras the first run finds, which takes `least`
    photos; what each run saw, by its folder."""
    seen, enough = {}, []
    capture = Capture(tmp_path / "statue", photos_of(tmp_path, None), scan_of(), VOLUME, digest="abc")

    def reconstruct(capture, folder, settings, **_):
        seen[folder.name] = capture
        RunFolder(folder).claim(capture.digest, capture.path)
        if len(capture.photos.photos) < enough[0]:
            raise CaptureError("too few photos register.")
        found = capture.photos if capture.photos.posed else photos_of(tmp_path, CAMERA)
        save_photos(folder / "initialize" / "photos.json", found)
        return {"seconds": 1.0, "stages": {}, "heldout": {"sections": {}}}

    def measure_rows(*knobs, least=1, photos_alone=False):
        enough[:] = [least]
        if photos_alone:
            monkeypatch.setattr(measure, "read_capture", lambda *_: capture.photos_only())
        measure_accuracy(capture.path, tmp_path / "out", AccuracySettings(Settings.of("draft"), knobs, ()))
        return seen

    for photo in capture.photos.photos:
        photo.path.touch()
    figures = {"splats": 1, "sections": None, "photos": None, "projections": None}
    monkeypatch.setattr("insideout.core.compare.study.reconstruct", reconstruct)
    monkeypatch.setattr(measure, "read_capture", lambda *_: capture)
    monkeypatch.setattr(measure, "row_figures", lambda *_: figures)
    for name in ("compile_kernels", "draw_front"):
        monkeypatch.setattr(measure, name, lambda *_: None)
    monkeypatch.setattr(measure.SectionJudge, "of", lambda *_: None)
    return measure_rows


def test_fewer_photos_and_projections_have_the_cameras_of_all_photos(without_cameras):
    seen = without_cameras("projections", "photos")
    whole, fewer, half = (seen[name] for name in ("preset=draft", "projections=1_of_4", "photos=1_of_2"))
    assert whole.photos.posed
    assert fewer.photos.posed
    assert (len(fewer.photos.photos), len(fewer.projections.images)) == (16, 2 + 4)
    assert half.photos.posed
    assert (sum(photo.held_out for photo in half.photos.photos), len(half.photos.photos)) == (2, 2 + 7)
    assert len({whole.digest, fewer.digest, half.digest}) == 3


def test_so_they_have_without_x_rays(without_cameras):
    half = without_cameras("photos", photos_alone=True)["photos=1_of_2"]
    assert half.photos.posed
    assert (sum(photo.held_out for photo in half.photos.photos), len(half.photos.photos)) == (2, 2 + 7)


def test_a_row_that_the_capture_is_not_enough_for_is_named(without_cameras):
    with pytest.raises(CaptureError, match=r"row 'photos: 1 of 4': too few .* \(--knobs without photos goes on\.\)"):
        without_cameras("photos", least=7)


def test_thinned_captures_keep_all_that_is_held_out(capture):
    for position in positions(Settings.of("draft"), capture, ("photos", "projections"), ())[1:]:
        thinned, share = position.thin(capture), int(position.value.split()[-1])
        before = [photo.held_out for photo in capture.photos.photos]
        after = [photo.held_out for photo in thinned.photos.photos]
        held_out, shown = capture.projections.held_out, thinned.projections.held_out
        assert (sum(after), shown.sum()) == (sum(before), held_out.sum())
        if position.knob == "photos":
            assert after.count(False) == -(-before.count(False) // share)
        else:
            assert (~shown).sum() == -(-(~held_out).sum() // share)


def test_the_front_is_what_nothing_beats_in_less_time():
    points = [(10, 20.0), (20, 25.0), (15, 19.0), (30, 25.0), (40, 30.0), (20, 24.0), (50, 29.0)]
    assert [points[place] for place in pareto_front(points)] == [(10, 20.0), (20, 25.0), (40, 30.0)]
    assert pareto_front([]).tolist() == []
    assert pareto_front([(1, 1.0), (1, 1.0)]).tolist() == [0, 1]


@pytest.fixture(scope="module")
def measured(tiny_capture, tiny_settings, tmp_path_factory):
    out = tmp_path_factory.mktemp("accuracy")
    how = AccuracySettings(tiny_settings, ("harmonics",), ())
    return out, how, measure_accuracy(tiny_capture, out, how)


def test_each_row_is_a_whole_run_with_its_seconds_and_figures(measured):
    out, _, content = measured
    assert [(row["knob"], row["value"]) for row in content["rows"]] == [
        ("preset", "draft"),
        ("harmonics", "degree 0"),
        ("harmonics", "degree 2"),
        ("harmonics", "degree 3"),
    ]
    for row in content["rows"]:
        assert row["seconds"] == pytest.approx(sum(row["stages"].values()))
        assert all(np.isfinite(row[name]) for name in ("sections", "photos", "projections"))
        assert row["machine"]["cpu"] == content["machine"]["cpu"]
    assert json.loads((out / "accuracy.json").read_text()) == content
    assert content["truth"] == "the true attenuation"
    assert content["exact"]


def test_rows_differ_in_what_the_knob_has_to_do_with_alone(measured):
    rows = {(row["knob"], row["value"]): row for row in measured[2]["rows"]}
    usual, flat = rows["preset", "draft"], rows["harmonics", "degree 0"]
    assert flat["photos"] != usual["photos"]
    # The X-ray half of `surface` is the same; photos pull at the frame in `internal` alone.
    assert flat["projections"] == pytest.approx(usual["projections"], abs=0.5)


def test_no_row_waits_for_kernels(tiny_capture, tiny_settings, tmp_path, monkeypatch):
    done = []
    monkeypatch.setattr("insideout.core.render.kernels.cpu.warm_up", lambda names: done.append(sorted(names)))
    monkeypatch.setattr(measure, "_row", lambda *_: done.append("row") or {})
    monkeypatch.setattr(measure, "draw_front", lambda *_: None)
    for kernel in ("cpu", "reference"):
        how = AccuracySettings(replace(tiny_settings, kernel=kernel), ("rays",), ())
        measure_accuracy(tiny_capture, tmp_path / kernel, how)
    assert done == [["radiograph", "section", "splat", "splat_effects"], *["row"] * 4]


def test_measured_again_it_only_reads(measured, tiny_capture):
    out, how, content = measured
    before = {path: path.stat().st_mtime_ns for path in out.rglob("report.json")}
    again = measure_accuracy(tiny_capture, out, how)
    assert again["rows"] == content["rows"]
    assert {path: path.stat().st_mtime_ns for path in out.rglob("report.json")} == before


@pytest.mark.parametrize(("other", "named"), [({"seed": 7}, "seed 0, not 7"), ({"kernel": "reference"}, "kernel cpu")])
def test_a_measurement_that_was_made_otherwise_is_not_given_up(measured, tiny_capture, tmp_path, other, named):
    out, how, _ = measured
    shutil.copytree(out, tmp_path / "out")
    before = (tmp_path / "out" / "accuracy.json").read_bytes()
    with pytest.raises(RunFolderError, match=f"{named}.*choose another --out"):
        measure_accuracy(tiny_capture, tmp_path / "out", replace(how, settings=replace(how.settings, **other)))
    assert (tmp_path / "out" / "accuracy.json").read_bytes() == before


def test_an_out_that_the_capture_lies_in_is_refused_before_anything_is_written(tiny_capture, tiny_settings):
    before = sorted(tiny_capture.rglob("*"))
    with pytest.raises(RunFolderError, match="lies inside the capture"):
        measure_accuracy(tiny_capture, tiny_capture.parent, AccuracySettings(tiny_settings, ("rays",), ()))
    assert sorted(tiny_capture.rglob("*")) == before


def test_the_plot_names_the_presets_and_knobs(measured, tmp_path):
    out, _, content = measured
    draw_front({**content, "rows": []}, tmp_path / "empty.png")
    drawn, empty = (
        np.asarray(Image.open(path).convert("L")) for path in (out / "accuracy.png", tmp_path / "empty.png")
    )
    assert (drawn < 128).sum() > 2 * (empty < 128).sum()


def test_the_table_has_what_each_position_costs_and_brings(measured):
    content = measured[2]
    table = accuracy_table(content)
    cells = table.cells()
    assert cells[0][:4] == ["preset", "draft", f"{content['rows'][0]['seconds']:.0f}", "–"]
    more = content["rows"][1]["photos"] - content["rows"][0]["photos"]
    assert cells[1][7] == f"{more:+.2f}"
    assert "sections dB (true)" in table.markdown()
    assert "made on" not in table.markdown()


@pytest.mark.parametrize(
    ("truth", "heading"),
    [
        ("the FDK of all projections", "against the FDK of all projections"),
        ("the capture's volume", "against the capt"),
    ],
)
def test_only_sections_of_the_true_attenuation_are_called_true(truth, heading):
    """Streaks and noise of an FDK count as right where it is all there is to compare with."""
    content = {"truth": truth, "exact": False, "rows": [], "capture": "fly", "preset": "draft"}
    assert f"sections dB ({heading}" in accuracy_table(content).markdown()


def test_rows_of_another_machine_say_so(measured):
    """Seconds of two do not compare."""
    content = measured[2]
    other = {**content["rows"][1], "machine": {**content["machine"], "cpu": "another processor"}}
    text = accuracy_table({**content, "rows": [content["rows"][0], other]}).markdown()
    assert "made on" in text
    assert "another processor" in text
    assert content["machine"]["cpu"] in text


def test_presets_stand_beside_the_best_in_half_in_all_and_in_twice_of_their_time():
    rows = [
        {"knob": knob, "value": value, "seconds": seconds, "sections": sections, "photos": None}
        for knob, value, seconds, sections in (
            ("preset", "draft", 100.0, 34.0),
            ("preset", "standard", 600.0, 36.0),
            ("iterations", "×0.5", 50.0, 30.0),
            ("iterations", "×2", 200.0, 35.5),
            ("rays", "affine", 90.0, 34.5),
        )
    ]
    assert presets_table({"rows": rows}).cells() == [
        ["draft", "100", "sections", "34.00", "30.00, iterations ×0.5", "34.50, rays affine", "35.50, iterations ×2"],
        ["standard", "600", "sections", "36.00", "35.50, iterations ×2", *["36.00, preset standard"] * 2],
    ]
    assert presets_table({"rows": rows[2:] + rows[:1]}).cells()[0][4].startswith("30.00")
    assert presets_table({"rows": rows[:1]}).cells()[0][4] == "–"
    assert presets_table({"rows": []}).cells() == []


def row_of(knob, value, seconds, **figures):
    return {"knob": knob, "value": value, "seconds": seconds, "sections": None, "projections": None} | figures


def wide(content, path):
    draw_front(content, path)
    return Image.open(path).width


def test_sections_and_photos_have_a_panel_each(measured, tmp_path):
    content = measured[2]
    both = wide(content, tmp_path / "both.png")
    rows = [row_of("preset", "draft", 10.0, photos=30.0), row_of("preset", "standard", 30.0, photos=31.0)]
    assert wide({**content, "rows": rows}, tmp_path / "photos.png") < both
    # Of X-rays without sections to compare with, projections take their place.
    for row in rows:
        row["projections"] = row["photos"]
    assert wide({**content, "rows": rows}, tmp_path / "both.png") == both


def test_the_first_and_the_last_preset_stay_inside_the_frame(measured, tmp_path):
    rows = [row_of("preset", "draft", 10**1.01, photos=30.0), row_of("preset", "paper", 10**1.49, photos=31.0)]
    draw_front({**measured[2], "rows": rows}, tmp_path / "presets.png")
    ink = (np.asarray(Image.open(tmp_path / "presets.png").convert("RGB"))[:670, :680] == INK).all(axis=2)
    left, right = np.flatnonzero(ink.sum(axis=0) > 400)[[0, -1]]
    # Beside the frame's sides there is nothing but its top and bottom.
    assert ink[120:640, right + 1 : right + 8].sum() == ink[120:640, right - 8 : right - 2].sum() == 0
    assert ink[120:640, left + 3 : left + 8].sum() == 0


def test_the_name_of_a_setting_at_the_right_end_stays_inside_the_frame(measured, tmp_path):
    rows = [row_of("preset", "draft", 10.0, photos=30.0), row_of("iterations", "paper ×2", 10**2.53, photos=31.0)]
    draw_front({**measured[2], "rows": rows}, tmp_path / "presets.png")
    # Up to the legend.
    drawn = np.asarray(Image.open(tmp_path / "presets.png").convert("L"))[:670, :676]
    right = np.flatnonzero((drawn < 100).sum(axis=0) > 400)[-1]
    assert (drawn[120:640, right + 2 :] > 200).all()


def test_the_name_of_a_setting_is_beside_that_of_a_preset_not_on_it(measured, tmp_path):
    """A setting a little better than a preset and a little faster has its name on the other side."""
    rows = [row_of("preset", "draft", 10.0, photos=30.0), row_of("preset", "standard", 30.0, photos=33.0)]
    pictures = []
    for name in ("edges let be", "edges"):
        better = row_of("smoothness", name, 9.0, photos=30.4)
        draw_front({**measured[2], "rows": [*rows, better]}, tmp_path / "front.png")
        pictures.append(np.asarray(Image.open(tmp_path / "front.png").convert("RGB"))[110:650, 95:640].astype(int))
    colored = np.ptp(pictures[0], axis=2).max(axis=0) > 50
    named = (pictures[0] != pictures[1]).any(axis=(0, 2))
    assert named.any()
    assert np.flatnonzero(named).max() < np.flatnonzero(colored).min()


def test_the_name_of_a_preset_is_not_on_a_mark_above_it(measured, tmp_path):
    rows = [row_of("preset", "draft", 10.0, photos=30.0), row_of("preset", "standard", 30.0, photos=33.0)]
    colored = []
    for seconds in (10.2, 14.0):
        better = row_of("smoothness", "twice the weight", seconds, photos=30.25)
        draw_front({**measured[2], "rows": [*rows, better]}, tmp_path / "front.png")
        panel = np.asarray(Image.open(tmp_path / "front.png").convert("RGB"))[110:650, 95:640].astype(int)
        colored.append((np.ptp(panel, axis=2) > 50).sum())
    assert colored[0] == pytest.approx(colored[1], abs=12), "as much of it is seen as of one that is alone"
    assert colored[1] > 100


def test_what_changes_nothing_is_not_in_the_panel(measured, tmp_path):
    rows = [row_of("preset", "draft", 10.0, photos=30.0), row_of("preset", "standard", 30.0, photos=31.0)]
    draw_front({**measured[2], "rows": rows}, tmp_path / "presets.png")
    for photos, alike in ((30.001, True), (30.4, False)):
        # The legend names it all the same.
        more = [*rows, row_of("rays", "affine", 20.0, photos=photos)]
        draw_front({**measured[2], "rows": more}, tmp_path / "more.png")
        panels = [np.asarray(Image.open(tmp_path / name))[:680, :660] for name in ("presets.png", "more.png")]
        assert np.array_equal(*panels) is alike


def test_a_position_is_a_setting_or_a_smaller_capture():
    settings = Settings.of("draft")
    for name, knob in KNOBS.items():
        for position in knob(settings):
            assert isinstance(position, Position), name
            assert (position.thin is None) != (position.change(settings) == settings), position
            assert replace(position, value="x").folder.startswith(name)
