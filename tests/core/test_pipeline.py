"""The pipeline: all stages on a tiny capture, resumed after a kill, and the refusals that keep files safe."""

import json
import os
import pickle
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from insideout.core.capture.read import read_capture
from insideout.core.capture.registered import load_photos
from insideout.core.capture.volumes import read_volume
from insideout.core.densities import Densities
from insideout.core.errors import Cancelled, RunFolderError, SettingError
from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.pipeline import reconstruct
from insideout.core.ply import read_comments, says_relative
from insideout.core.progress import Reporter
from insideout.core.run_folder import STAGES, RunFolder
from insideout.core.settings import PRESETS, Settings
from insideout.core.told import Told


@pytest.fixture(scope="module")
def finished(tiny_capture, tiny_settings, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "run"
    heard = []
    report = reconstruct(
        tiny_capture, out, settings=tiny_settings, on_stage=lambda stage, state, _: heard.append((stage, state))
    )
    return out, report, heard


def test_a_run_leaves_all_its_files(finished):
    out, report, _ = finished
    for name in (*report["files"], "report.json", "log.jsonl"):
        assert (out / name).stat().st_size > 100, name
    assert report["files"] == [
        "rgb.ply",
        "xray.ply",
        "fused.ply",
        "volume.npz",
        "mesh.glb",
        "residual.npz",
        "curve.png",
    ]
    assert json.loads((out / "report.json").read_text()) == report
    assert not list(out.rglob("*.checkpoint.pt"))
    assert not list(out.rglob("*.tmp"))


def test_every_stage_is_told_from_start_to_end(finished):
    _, _, heard = finished
    assert heard == [(stage, state) for stage in (*STAGES, "report") for state in ("started", "done")]


def test_a_run_that_a_card_draws_comes_out_alike(finished, tiny_capture, tiny_settings, tmp_path, monkeypatch):
    """Without a card Warp's CPU back end draws: how the stages work with that kernel is the same."""
    pytest.importorskip("warp")
    monkeypatch.setattr("insideout.core.pipeline.require_card", lambda: None)
    report = reconstruct(tiny_capture, tmp_path / "run", settings=replace(tiny_settings, kernel="cuda"))
    found, expected = (one["heldout"] for one in (report, finished[1]))
    assert found["photos"]["rgb"]["psnr"] == pytest.approx(expected["photos"]["rgb"]["psnr"], abs=0.3)
    for figures in ("projections", "sections"):
        assert found[figures]["psnr"] == pytest.approx(expected[figures]["psnr"], abs=0.3), figures
    # After sixty steps rounding may decide whether outlines improve on the frame, whose size is 1 % off either way:
    # that is up to 0.6 dB of photos of both halves.
    assert found["photos"]["psnr"] == pytest.approx(expected["photos"]["psnr"], abs=1.0)


def test_the_report_has_the_figures_that_users_look_for(finished):
    _, report, _ = finished
    assert report["seconds"] > 0
    assert set(report["stages"]) == set(STAGES)
    assert all(sum(stage["splats"].values()) > 0 for stage in report["stages"].values())
    for view in ("photos", "projections", "sections"):
        for model in ({}, {"rgb"}, {"xray"}):
            figures = report["heldout"][view]
            for name in model:
                figures = figures[name]
            assert "psnr" in figures
    assert {"none", "align", "internal"} <= set(report["chamfer_mm"])
    assert 0 < report["residual"]["mean"] < report["residual"]["p95"] < 100


def test_the_photo_frame_s_similarity_is_found(finished, tiny_capture):
    _, report, _ = finished
    with np.load(tiny_capture / "truth.npz") as truth:
        scale, rotation = float(truth["scale"]), truth["rotation"]
    found = report["similarity"]
    assert found["scale"] == pytest.approx(scale, rel=0.05)
    turn = np.array(found["rotation"]) @ rotation.T
    assert np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))) < 2
    assert np.linalg.det(found["rotation"]) == pytest.approx(1.0, abs=1e-6)


def test_the_fused_model_holds_the_xray_splats_and_those_of_the_photos(finished):
    out, _, _ = finished
    fused = GaussianSet.load(out / "fused.ply")
    xray = GaussianSet.load(out / "xray.ply")
    assert (fused.modality == Modality.XRAY).sum() == len(xray)
    assert 0 < (fused.modality == Modality.RGB).sum() <= len(GaussianSet.load(out / "rgb.ply"))
    assert not fused.density[fused.modality == Modality.RGB].any()


def test_a_finished_run_is_not_made_again(finished, tiny_capture, tiny_settings):
    out, report, _ = finished
    before = (out / "fuse" / "fused.ply").stat().st_mtime_ns
    heard = []
    again = reconstruct(tiny_capture, out, settings=tiny_settings, on_stage=lambda stage, state, _: heard.append(stage))
    assert heard == [*STAGES, "report", "report"]
    assert (out / "fuse" / "fused.ply").stat().st_mtime_ns == before
    assert again["heldout"] == report["heldout"]


@pytest.mark.parametrize("when", [("surface", "rgb", 20), ("surface", "xray", 15), ("internal", "joint", 3)], ids=str)
def test_cancelled_and_started_again_ends_like_the_unbroken_run(when, finished, tiny_capture, tiny_settings, tmp_path):
    stage, part, iteration = when
    reached = []

    def listen(progress):
        if progress.stage == stage and part in progress.part and progress.iteration >= iteration:
            reached.append(True)

    with pytest.raises(Cancelled):
        reconstruct(
            tiny_capture, tmp_path / "run", settings=tiny_settings, reporter=Reporter(listen, lambda: bool(reached))
        )
    assert not (tmp_path / "run" / stage / "report.json").exists()
    reconstruct(tiny_capture, tmp_path / "run", settings=tiny_settings)
    expected, resumed = (GaussianSet.load(folder / "fused.ply") for folder in (finished[0], tmp_path / "run"))
    assert len(expected) == len(resumed)
    np.testing.assert_allclose(resumed.means, expected.means, atol=1e-3)
    np.testing.assert_allclose(resumed.density, expected.density, atol=1e-5)


def test_killed_outright_it_goes_on_from_its_checkpoint(finished, tiny_capture, tiny_settings, tmp_path):
    """SIGKILL while the photos are fitted; the folder is whole and the same command ends as if nothing had been."""
    run = tmp_path / "run"
    (tmp_path / "settings.pickle").write_bytes(pickle.dumps(tiny_settings))
    code = (
        "import pathlib, pickle, sys, time; from insideout.core.train import loop\n"
        "from insideout.core.pipeline import reconstruct; from insideout.core.progress import Reporter\n"
        "loop._SAVE_SECONDS = 0.05; capture, run, settings = map(pathlib.Path, sys.argv[1:])\n"
        "slow = lambda progress: time.sleep(0.2 * (progress.iteration > 20))\n"
        "reconstruct(capture, run, settings=pickle.loads(settings.read_bytes()), reporter=Reporter(slow))"
    )
    process = subprocess.Popen([sys.executable, "-c", code, tiny_capture, run, tmp_path / "settings.pickle"])
    checkpoint = run / "surface" / "rgb.checkpoint.pt"
    while process.poll() is None and not checkpoint.exists():
        time.sleep(0.05)
    time.sleep(0.5)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert (run / "initialize" / "report.json").exists()
    assert not (run / "surface" / "report.json").exists()
    heard = []
    reconstruct(tiny_capture, run, settings=tiny_settings, reporter=Reporter(heard.append))
    first = next(progress for progress in heard if progress.stage == "surface" and progress.iteration)
    assert first.iteration > 1
    told = [point for p in heard if (p.stage, p.part) == ("surface", "rgb") for point in p.heldout or ()]
    report = json.loads((run / "surface" / "report.json").read_text("utf-8"))
    assert told == report["rgb"]["heldout"], "the whole curve, that of before it was killed first"
    expected, resumed = (GaussianSet.load(folder / "fused.ply") for folder in (finished[0], run))
    np.testing.assert_allclose(resumed.means, expected.means, atol=1e-3)


def test_a_model_without_a_surface_has_all_but_a_mesh(finished, tiny_capture, tiny_settings, tmp_path, monkeypatch):
    run = RunFolder(tmp_path / "run")
    shutil.copytree(finished[0], run.path)
    (run.path / "report.json").unlink()

    def refuse(*_, **__):
        raise SettingError("the volume is the same everywhere.")

    monkeypatch.setattr("insideout.core.mesh.extract_mesh", refuse)
    report = reconstruct(tiny_capture, run.path, settings=tiny_settings)
    assert "mesh.glb" not in report["files"]
    assert not (run.path / "mesh.glb").exists()
    assert report["warnings"][-1] == "there is no mesh: the volume is the same everywhere."
    assert [Told.from_json(told) for told in report["warnings_told"]] == report["warnings"]
    assert report["warnings_told"][-1]["template"] == "there is no mesh: {error}"
    assert (run.path / "volume.npz").exists()


def test_residuals_are_made_again_only_for_other_splats(finished, tiny_capture, tiny_settings, tmp_path):
    run = RunFolder(tmp_path / "run")
    shutil.copytree(finished[0], run.path)
    file = run.path / "residual.npz"
    before = file.read_bytes()
    time.sleep(0.01)
    stamp = file.stat().st_mtime_ns
    assert reconstruct(tiny_capture, run.path, settings=tiny_settings)["residual"] == finished[1]["residual"]
    assert file.stat().st_mtime_ns == stamp
    fused = run.read_set("fuse", "fused")
    run.write_set("fuse", "fused", replace(fused, density=0.5 * fused.density))
    report = reconstruct(tiny_capture, run.path, settings=tiny_settings)
    assert file.read_bytes() != before
    assert report["residual"]["mean"] > 2 * finished[1]["residual"]["mean"]


def test_photos_alone_are_a_valid_run(tiny_capture, tiny_settings, tmp_path):
    shutil.copytree(tiny_capture / "photos", tmp_path / "capture" / "photos")
    report = reconstruct(tmp_path / "capture", tmp_path / "run", settings=tiny_settings)
    assert "skipped" in report["stages"]["align"]
    assert "skipped" in report["stages"]["internal"]
    assert report["heldout"]["photos"]["psnr"] > 10
    assert "arbitrary" in report["units"]["length"]
    assert report["residual"]["mean"] is None
    assert not (tmp_path / "run" / "residual.npz").exists()
    assert (tmp_path / "run" / "fused.ply").exists()


def test_xrays_alone_are_a_valid_run(tiny_capture, tiny_settings, tmp_path):
    shutil.copytree(tiny_capture / "xray", tmp_path / "capture" / "xray")
    report = reconstruct(tmp_path / "capture", tmp_path / "run", settings=tiny_settings)
    assert "skipped" in report["stages"]["align"]
    assert report["heldout"]["projections"]["psnr"] > 15
    assert report["units"]["length"] == "mm"
    assert report["water_per_mm"] is None, "there are no Hounsfield units"
    assert (tmp_path / "run" / "mesh.glb").exists()


@pytest.mark.parametrize(
    ("notes", "densities"),
    [({"unit": "grey"}, Densities(relative=True)), ({"unit": "HU", "mu_water_per_mm": 0.03}, Densities(False, 0.03))],
    ids=["grey values", "Hounsfield units"],
)
def test_what_densities_are_in_is_told_by_each_file_of_a_run(tiny_settings, tmp_path, notes, densities):
    radius = np.linalg.norm(np.indices((16, 16, 16)) - 7.5, axis=0)
    values = np.where(radius < 5, 900, -1000).astype(np.int16)
    (tmp_path / "capture" / "xray").mkdir(parents=True)
    np.save(tmp_path / "capture" / "xray" / "volume.npy", values)
    told = json.dumps({"spacing_mm": [1, 1, 1], **notes})
    (tmp_path / "capture" / "xray" / "volume.json").write_text(told, "utf-8")
    run = tmp_path / "run"
    report = reconstruct(tmp_path / "capture", run, settings=tiny_settings)
    made = [stage for stage in report["stages"].values() if "skipped" not in stage]
    for one in (report, *made):
        assert one["units"]["density"] == ("relative" if densities.relative else "1/mm")
        assert one["water_per_mm"] == densities.water_per_mm
    sets = sorted(run.rglob("*.ply"))
    assert {run / "fused.ply", run / "xray.ply", run / "initialize" / "xray.ply"} <= set(sets)
    for path in sets:
        assert says_relative(read_comments(path)) == densities.relative
        water = f"insideout water_per_mm = {densities.water_per_mm}"
        assert (water in read_comments(path)) == (densities.water_per_mm is not None)
    for path in (run / "volume.npz", run / "initialize" / "volume.npz"):
        assert read_volume(path).densities == densities


def test_another_preset_or_seed_needs_another_folder(finished, tiny_capture):
    with pytest.raises(RunFolderError, match="--fresh"):
        reconstruct(tiny_capture, finished[0], preset="paper")


def test_a_run_folder_of_another_capture_is_refused(finished, tiny_capture, tmp_path):
    shutil.copytree(tiny_capture / "xray", tmp_path / "other" / "xray")
    before = sorted(p.name for p in finished[0].iterdir())
    with pytest.raises(RunFolderError, match="another capture"):
        reconstruct(tmp_path / "other", finished[0], preset="draft")
    assert sorted(p.name for p in finished[0].iterdir()) == before


def test_a_stage_needs_the_ones_before_it(tiny_capture, tmp_path):
    with pytest.raises(SettingError, match="needs the stage 'initialize' first"):
        reconstruct(tiny_capture, tmp_path / "run", preset="draft", stages=["surface"])


def test_fresh_with_a_later_stage_gives_up_nothing(finished, tiny_capture, tiny_settings):
    with pytest.raises(SettingError, match="needs the stage 'initialize' first"):
        reconstruct(tiny_capture, finished[0], settings=tiny_settings, stages=["internal"], fresh=True)
    assert (finished[0] / "report.json").exists()
    assert all((finished[0] / stage / "report.json").exists() for stage in STAGES)


@pytest.mark.parametrize("content", ["{", '{"photos": [{"path": "/gone/x.jpg"}]}'], ids=["damaged", "moved"])
def test_photos_that_an_earlier_run_placed_are_nothing_to_a_new_start(
    content, finished, tiny_capture, tiny_settings, tmp_path
):
    run = shutil.copytree(finished[0], tmp_path / "run")
    (run / "initialize" / "photos.json").write_text(content)
    reconstruct(tiny_capture, run, settings=tiny_settings, stages=["initialize"], fresh=True)
    found = load_photos(run / "initialize" / "photos.json").photos
    assert len(found) == len(read_capture(tiny_capture).photos.photos)


def test_landmarks_picked_in_a_run_s_own_frame_leave_its_cameras_as_they_are(
    finished, tiny_capture, tiny_settings, tmp_path
):
    capture, run = shutil.copytree(tiny_capture, tmp_path / "capture"), shutil.copytree(finished[0], tmp_path / "run")
    points = json.loads((capture / "landmarks.json").read_text())
    (capture / "landmarks.json").write_text(json.dumps({name: found[::-1] for name, found in points.items()}))
    before = (run / "initialize" / "photos.json").stat().st_mtime_ns
    with pytest.raises(SettingError, match=r"landmarks\.json is not what 'align' was made with"):
        reconstruct(capture, run, settings=tiny_settings, stages=["fuse"])
    assert (run / "report.json").exists()
    heard = []
    reconstruct(capture, run, settings=tiny_settings, on_stage=lambda stage, state, _: heard.append((stage, state)))
    states = {stage: [state for name, state in heard if name == stage] for stage in STAGES}
    assert states["initialize"] == states["surface"] == ["kept"]
    assert all(states[stage] == ["started", "done"] for stage in ("align", "internal", "fuse"))
    assert (run / "initialize" / "photos.json").stat().st_mtime_ns == before


def test_an_alignment_taken_over_from_another_run_brings_its_landmarks(finished, tiny_capture, tiny_settings, tmp_path):
    for stage in ("initialize", "surface", "align"):
        shutil.copytree(finished[0] / stage, tmp_path / "run" / stage)
    shutil.copy(finished[0] / "capture.json", tmp_path / "run" / "capture.json")
    heard = []
    reconstruct(
        tiny_capture,
        tmp_path / "run",
        settings=tiny_settings,
        leave_out=["internal"],
        on_stage=lambda stage, state, _: heard.append((stage, state)),
    )
    assert ("align", "kept") in heard


def test_one_stage_again_leaves_the_run_unfinished_until_the_rest_follows(
    finished, tiny_capture, tiny_settings, tmp_path
):
    run = shutil.copytree(finished[0], tmp_path / "run")
    answer = reconstruct(tiny_capture, run, settings=tiny_settings, stages=["internal"])
    assert set(answer["stages"]) == {"initialize", "surface", "align", "internal"}
    assert not (run / "report.json").exists()
    assert not (run / "fuse" / "report.json").exists()
    heard = []
    reconstruct(tiny_capture, run, settings=tiny_settings, on_stage=lambda stage, state, _: heard.append(stage))
    assert heard == [*STAGES[:-1], "fuse", "fuse", "report", "report"]
    assert (run / "report.json").exists()


def test_a_run_inside_the_capture_is_refused(tiny_capture):
    with pytest.raises(RunFolderError, match="inside the capture"):
        reconstruct(tiny_capture, tiny_capture / "photos" / "run", preset="draft")
    assert not (tiny_capture / "photos" / "run").exists()


def test_the_halves_refined_apart_become_one_model_by_transfer_and_clones(
    finished, tiny_capture, tiny_settings, tmp_path
):
    out, _, _ = finished
    for stage in ("initialize", "surface", "align"):
        shutil.copytree(out / stage, tmp_path / "run" / stage)
    for name in ("capture.json", "settings.json"):
        shutil.copy(out / name, tmp_path / "run")
    internal = replace(tiny_settings.stages["internal"], joint=None)
    settings = replace(tiny_settings, stages={**tiny_settings.stages, "internal": internal})
    report = reconstruct(tiny_capture, tmp_path / "run", settings=settings)
    assert report["stages"]["internal"]["mode"] == "apart"
    fused, xray = (GaussianSet.load(tmp_path / "run" / name) for name in ("fused.ply", "xray.ply"))
    clones = fused.modality == Modality.CLONE
    assert 0 < clones.sum() == len(fused) - len(xray)
    assert not fused.density[clones].any()


@pytest.mark.parametrize("preset", PRESETS)
def test_the_halves_are_refined_together_unless_asked_otherwise(preset):
    assert Settings.of(preset).stages["internal"].joint is not None
    apart = Settings.of(preset, refine="apart").stages
    assert apart["internal"] == replace(Settings.of(preset).stages["internal"], joint=None)


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_knows_every_stage(preset):
    assert tuple(Settings.of(preset).stages) == STAGES
