"""Runs with a time budget, or until a figure is reached, on a tiny capture."""

import json
import shutil
from dataclasses import replace

import pytest

from insideout.core.capture.read import read_capture
from insideout.core.compare.methods import with_stage
from insideout.core.errors import Cancelled, RunFolderError, SettingError
from insideout.core.files import plain
from insideout.core.forecast import budget, speed
from insideout.core.forecast.budget import forecasts
from insideout.core.forecast.pace import Pace
from insideout.core.pipeline import reconstruct
from insideout.core.progress import Reporter, unstopped
from insideout.core.run_folder import STAGES
from insideout.core.stages.internal import joint as joint_stage
from insideout.core.stages.internal.joint_settings import joint_in_iterations
from insideout.core.stages.surface import stage as surface_stage
from insideout.core.train.schedule import in_iterations

PARTS = (("surface", "rgb"), ("surface", "xray"), ("internal", "joint"))


@pytest.fixture(scope="session")
def tiny_settings(tiny_settings):
    """Fewer steps: budgets make them up to four times as many."""
    surface = tiny_settings.stages["surface"]
    halves = {"rgb": in_iterations(surface.rgb, 30), "xray": in_iterations(surface.xray, 20)}
    return with_stage(tiny_settings, "surface", **halves)


@pytest.fixture(autouse=True)
def measured_once(monkeypatch):
    """The machine is as fast in one test as in the next; what measuring it does has tests of its own."""
    usual = speed.measure_speed

    def measure(capture, long_side, tick=unstopped, known=None, rgb=None):
        halves = capture.photos is None, capture.projections is None
        key = (capture.digest, halves, long_side, repr(rgb), known)
        if key not in _MEASURED:
            _MEASURED[key] = usual(capture, long_side, tick, known, rgb)
        return _MEASURED[key]

    monkeypatch.setattr(speed, "measure_speed", measure)


_MEASURED = {}


@pytest.fixture(scope="module")
def plain_run(tiny_capture, tiny_settings, tmp_path_factory):
    """(folder, report) of a run that may take whatever it takes. Read only."""
    folder = tmp_path_factory.mktemp("plain") / "run"
    return folder, reconstruct(tiny_capture, folder, settings=tiny_settings)


def made(report):
    return {part: report["stages"][stage][part]["iterations"] for stage, part in PARTS}


def planned(settings):
    surface, internal = settings.stages["surface"], settings.stages["internal"]
    return {"rgb": surface.rgb.iterations, "xray": surface.xray.iterations, "joint": internal.joint.iterations}


def took(run, stage, seconds):
    """Makes a finished stage one that took so long."""
    path = run / stage / "report.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "seconds": seconds}))


def test_with_much_time_there_are_more_steps(tiny_capture, tiny_settings, tmp_path, monkeypatch):
    """And splats of photos are known when projections begin."""
    known, usual = {}, Pace.iterations

    def iterations(pace, part, planned):
        known[part] = dict(pace.splats)
        return usual(pace, part, planned)

    monkeypatch.setattr(Pace, "iterations", iterations)
    wide = reconstruct(tiny_capture, tmp_path / "wide", settings=replace(tiny_settings, time_budget_s=900.0))
    assert wide["time_budget_s"] == 900.0
    assert all(made(wide)[part] == 4 * steps for part, steps in planned(tiny_settings).items())
    assert wide["heldout"]["photos"]["psnr"] > 10
    assert known["surface rgb"] == {}
    assert known["surface xray"] == {"surface rgb": wide["stages"]["surface"]["splats"]["rgb"]}


def test_however_much_time_there_is_photos_are_not_shown_more_often_than_they_bear(
    tiny_capture, tiny_settings, tmp_path, monkeypatch
):
    told, usual = {}, Pace.made
    monkeypatch.setattr(
        Pace, "made", lambda pace, part, *shares: (told.setdefault(part, shares[0]), usual(pace, part, *shares))
    )
    rgb = replace(in_iterations(tiny_settings.stages["surface"].rgb, 60), passes=3)
    settings = replace(with_stage(tiny_settings, "surface", rgb=rgb), time_budget_s=900.0)
    report = reconstruct(tiny_capture, tmp_path / "run", stages=["initialize", "surface"], settings=settings)
    shown = report["stages"]["surface"]["rgb"]
    assert shown["iterations"] == 3 * shown["photos"]["training"] < rgb.iterations
    assert report["stages"]["surface"]["xray"]["iterations"] == 4 * planned(settings)["xray"]
    assert told["surface rgb"] == pytest.approx(1 / 4), "a fourth of what there was time for: no machine is the faster"


def test_half_of_the_steps_are_made_at_the_rates_of_so_few(tiny_capture, tiny_settings, tmp_path, monkeypatch):
    """Splats are added as often; so it is where a run is taken up again, and the report tells the settings."""
    surface, joint = tiny_settings.stages["surface"], tiny_settings.stages["internal"].joint
    rgb, xray = (replace(half, strategy=replace(half.strategy, every=100)) for half in (surface.rgb, surface.xray))
    expected = {
        "rgb": in_iterations(rgb, rgb.iterations // 2),
        "xray": in_iterations(xray, xray.iterations // 2),
        "joint": joint_in_iterations(joint, joint.iterations // 2),
    }
    assert expected["rgb"].strategy.every == expected["xray"].strategy.every == 50
    used, stopped = {}, []
    for module, name, part in (
        (surface_stage, "RgbTrainer", "rgb"),
        (surface_stage, "XrayTrainer", "xray"),
        (joint_stage, "JointTrainer", "joint"),
    ):
        trainer = getattr(module, name)

        def begun(*given, part=part, trainer=trainer):
            used.setdefault(part, []).extend(one for one in given if isinstance(one, type(expected[part])))
            return trainer(*given)

        monkeypatch.setattr(module, name, begun)
    monkeypatch.setattr(Pace, "iterations", lambda pace, part, planned: planned // 2)
    settings = replace(with_stage(tiny_settings, "surface", rgb=rgb, xray=xray), time_budget_s=900.0)

    def listen(progress):
        if progress.part == "joint" and progress.iteration:
            stopped.append(progress)

    with pytest.raises(Cancelled):
        reconstruct(tiny_capture, tmp_path / "run", settings=settings, reporter=Reporter(listen, lambda: bool(stopped)))
    report = reconstruct(tiny_capture, tmp_path / "run", settings=settings)
    assert used == {part: [one] * (2 if part == "joint" else 1) for part, one in expected.items()}
    for stage, part in PARTS:
        assert report["stages"][stage][part]["trained_with"] == json.loads(json.dumps(plain(expected[part])))


def test_a_time_that_cannot_be_kept_is_refused_before_anything_is_made(tiny_capture, tiny_settings, tmp_path):
    with pytest.raises(SettingError, match=r"--time-budget 1s: is too short; this capture takes some \d+ s"):
        reconstruct(tiny_capture, tmp_path / "run", settings=replace(tiny_settings, time_budget_s=1.0))
    assert not (tmp_path / "run" / "settings.json").exists()
    assert not (tmp_path / "run" / "initialize").exists()


def test_broken_off_and_taken_up_again_it_keeps_the_steps_it_began_with(tiny_capture, tiny_settings, tmp_path):
    settings, heard = replace(tiny_settings, time_budget_s=900.0), []

    def listen(progress):
        if progress.part == "xray" and progress.iteration > 3:
            heard.append(progress.iterations)

    with pytest.raises(Cancelled):
        reconstruct(tiny_capture, tmp_path / "run", settings=settings, reporter=Reporter(listen, lambda: bool(heard)))
    report = reconstruct(tiny_capture, tmp_path / "run", settings=settings)
    assert made(report)["xray"] == heard[0]


def test_starting_over_does_not_count_the_run_of_before(tiny_capture, tiny_settings, plain_run, tmp_path):
    shutil.copytree(plain_run[0], tmp_path / "run")
    for stage in STAGES:
        took(tmp_path / "run", stage, 500.0)
    settings = replace(tiny_settings, time_budget_s=900.0)
    again = reconstruct(tiny_capture, tmp_path / "run", settings=settings, fresh=True)
    assert all(made(again)[part] == 4 * steps for part, steps in planned(tiny_settings).items())


def test_a_run_that_was_begun_in_its_time_is_finished_however_late_it_is(tiny_capture, tiny_settings, tmp_path):
    settings, stopped = replace(tiny_settings, time_budget_s=900.0), []

    def listen(progress):
        if progress.stage == "report":
            stopped.append(progress)

    with pytest.raises(Cancelled):
        reconstruct(tiny_capture, tmp_path / "run", settings=settings, reporter=Reporter(listen, lambda: bool(stopped)))
    took(tmp_path / "run", "surface", 890.0)
    assert reconstruct(tiny_capture, tmp_path / "run", settings=settings)["time_budget_s"] == 900.0


@pytest.mark.parametrize("refine", ["joint", "apart"])
def test_a_forecast_has_the_parts_in_the_order_in_which_they_are_made(tiny_capture, tiny_settings, tmp_path, refine):
    capture = read_capture(tiny_capture)
    if refine == "apart":
        tiny_settings = with_stage(tiny_settings, "internal", joint=None)
    else:
        capture = capture.xrays_only()
    reconstruct(capture, tmp_path / "run", settings=tiny_settings)
    lines = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    trained = [line for line in lines if line.get("iterations") and line["stage"] != "initialize"]
    seen = dict.fromkeys(f"{line['stage']} {line['part']}" for line in trained)
    foreseen = forecasts(capture, [tiny_settings], Reporter())[0].parts
    assert list(seen) == [part for part in foreseen if part in seen]
    # All that is no training.
    measured = {"internal voxels", "internal xray measuring", "internal voxels after"}
    assert set(foreseen) - set(seen) <= {"initialize photos", "initialize xray", "align", "report", *measured}


def test_before_any_stage_is_done_more_time_may_bring_another_preset(tiny_capture, tmp_path, monkeypatch):
    """Who names no preset has not chosen that of the shorter time."""
    begun, run = [], tmp_path / "run"
    stop = Reporter(begun.append, lambda: any(progress.stage == "initialize" for progress in begun))
    for budget_s, preset in ((900.0, "draft"), (36_000.0, "paper")):
        begun.clear()
        chosen = {"draft": 0, "paper": -1}[preset]
        monkeypatch.setattr(budget, "choose_forecast", lambda found, left, chosen=chosen: found[chosen])
        with pytest.raises(Cancelled):
            reconstruct(tiny_capture, run, time_budget_s=budget_s, reporter=stop)
        kept = json.loads((run / "settings.json").read_text())
        assert (kept["preset"], kept["time_budget_s"]) == (preset, budget_s)
    begun.clear()
    with pytest.raises(RunFolderError, match="preset"):
        reconstruct(tiny_capture, run, preset="draft", time_budget_s=900.0, reporter=stop)


def test_another_time_is_another_run(tiny_capture, tiny_settings, plain_run, tmp_path):
    shutil.copytree(plain_run[0], tmp_path / "run")
    with pytest.raises(RunFolderError, match="time_budget_s"):
        reconstruct(tiny_capture, tmp_path / "run", settings=replace(tiny_settings, time_budget_s=900.0))


def test_a_figure_that_is_soon_reached_ends_each_part_there(tiny_capture, tiny_settings, tmp_path):
    report = reconstruct(tiny_capture, tmp_path / "run", settings=replace(tiny_settings, until_db=3.0))
    assert report["until_db"] == 3.0
    for stage, part in (("surface", "rgb"), ("internal", "joint")):
        history = report["stages"][stage][part]
        assert history["ended"] == "3 dB of photos: reached", part
        assert history["iterations"] < planned(tiny_settings)[part]
    # Projections are not what was asked about.
    assert made(report)["xray"] == planned(tiny_settings)["xray"]


def test_a_figure_that_was_not_reached_is_told(tiny_capture, tiny_settings, tmp_path):
    report = reconstruct(tiny_capture, tmp_path / "run", settings=replace(tiny_settings, until_db=90.0))
    assert any(line.startswith("--until 90dB: not reached; the best of held-out photos") for line in report["warnings"])
    assert set(report["endings"]) <= set(report["warnings"])
    assert report["seconds_in_all"] > report["seconds"]
    assert report["curve"][-1]["seconds"] == pytest.approx(report["seconds_in_all"])


def test_what_came_before_the_first_stage_counts_after_a_break(tiny_capture, tiny_settings, tmp_path):
    capture, stopped = read_capture(tiny_capture).xrays_only(), []

    def listen(progress):
        if progress.stage == "surface":
            stopped.append(progress)

    with pytest.raises(Cancelled):
        reconstruct(capture, tmp_path / "run", settings=tiny_settings, reporter=Reporter(listen, lambda: bool(stopped)))
    assert 0 < json.loads((tmp_path / "run" / "seconds.json").read_text()) < 60
    # As if the kernels had been compiled then.
    (tmp_path / "run" / "seconds.json").write_text("500.0")
    report = reconstruct(capture, tmp_path / "run", settings=tiny_settings)
    assert report["seconds_in_all"] > 500 + report["seconds"]


def test_a_run_whose_time_was_gone_before_its_first_training_goes_on_with_more(tiny_capture, tiny_settings, tmp_path):
    capture, stopped = read_capture(tiny_capture).xrays_only(), []

    def listen(progress):
        if progress.stage == "initialize":
            stopped.append(progress)

    def again(seconds, **options):
        return reconstruct(capture, tmp_path / "run", settings=replace(tiny_settings, time_budget_s=seconds), **options)

    with pytest.raises(Cancelled):
        again(900.0, reporter=Reporter(listen, lambda: bool(stopped)))
    (tmp_path / "run" / "seconds.json").write_text("895.0")
    with pytest.raises(SettingError, match="gone before the first training"):
        again(900.0)
    report = again(3000.0)
    assert report["time_budget_s"] == 3000.0
    assert report["stages"]["surface"]["xray"]["iterations"] > planned(tiny_settings)["xray"]


def test_the_report_has_the_run_s_curve_and_its_picture(plain_run):
    folder, report = plain_run
    curve = report["curve"]
    assert (folder / "curve.png").stat().st_size > 1000
    assert [point["seconds"] for point in curve] == sorted(point["seconds"] for point in curve)
    assert {(point["stage"], point["part"]) for point in curve} >= {*PARTS, ("report", "")}
    assert curve[-1]["photos"] == report["heldout"]["photos"]["psnr"]
    assert json.loads((folder / "report.json").read_text())["curve"] == curve
