"""The figures of a run: a run whose models are the truth, and runs of one modality alone."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from insideout.core.capture.model import Capture, Photo, Photos, Projections
from insideout.core.capture.registered import save_photos
from insideout.core.densities import Densities
from insideout.core.errors import Cancelled
from insideout.core.evaluate.photos import registered_photos
from insideout.core.evaluate.report import evaluate_run
from insideout.core.files import plain, write_json
from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.progress import Reporter
from insideout.core.render import radiograph, splat
from insideout.core.render.voxels import voxelize
from insideout.core.run_folder import RunFolder
from insideout.core.similarity import Similarity
from insideout.core.stages.context import StageContext
from insideout.core.views import Camera, Detector
from insideout.core.volume import Volume

TO_MM = Similarity(20.0, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([1.0, -2.0, 3.0]))
BACKGROUND = np.array([0.9, 0.85, 0.8], np.float32)


def _ball(count, radius, seed):
    random = np.random.default_rng(seed)
    directions = random.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions * radius * random.random((count, 1)) ** (1 / 3 if seed == 1 else 0)


@pytest.fixture(scope="module")
def xray():
    return GaussianSet.create(_ball(1500, 14.0, seed=1), 1.5, opacities=0.5, density=0.01, modality=Modality.XRAY)


@pytest.fixture(scope="module")
def rgb():
    """A painted shell, in the photo frame."""
    means = _ball(2500, 15.0, seed=2)
    paint = np.sin(means / 4)[:, None, :].astype(np.float32)
    return GaussianSet.create(means, 0.6, opacities=0.9, sh=paint).transformed(TO_MM.inverse())


@pytest.fixture(scope="module")
def projections(xray):
    detectors = []
    for angle in np.arange(12) * np.pi / 6:
        out = np.array([np.cos(angle), np.sin(angle), 0.0])
        across = np.array([-np.sin(angle), np.cos(angle), 0.0])
        detectors.append(Detector(40, 40, 100 * out, -50 * out, 1.6 * across, np.array([0, 0, -1.6])))
    images = np.stack([radiograph(xray.to_torch(), detector).numpy() for detector in detectors])
    held_out = np.arange(12) % 4 == 0
    box = np.array([[-20.0] * 3, [20.0] * 3])
    return Projections(images, detectors, held_out, np.arange(12) * np.pi / 6, box, (32, 32, 32), 100.0, 150.0)


def _photos(rgb, folder):
    photos = []
    for number in range(8):
        angle = number * np.pi / 4
        pose = np.eye(4)
        pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        pose[2, 3] = 5.0
        pose[:3, 3] -= pose[:3, :3] @ rgb.means.mean(axis=0)
        camera = Camera(64, 64, 120.0, 120.0, 32.0, 32.0, pose)
        image = splat(rgb.to_torch(), camera, BACKGROUND.tolist()).color.numpy()
        Image.fromarray(np.round(255 * np.clip(image, 0, 1)).astype(np.uint8)).save(folder / f"{number}.png")
        photos.append(Photo(folder / f"{number}.png", camera, held_out=number % 4 == 0))
    return Photos(photos)


@pytest.fixture
def whole_run(tmp_path, xray, rgb, projections):
    volume = voxelize(xray, np.full(3, -19.375), np.full(3, 1.25), (32, 32, 32))
    run = RunFolder(tmp_path / "run")
    save_photos(run.stage("initialize") / "photos.json", _photos(rgb, tmp_path))
    run.write_set("surface", "rgb", rgb)
    run.write_set("surface", "xray", xray)
    run.write_set("internal", "xray", xray)
    run.write_set("align", "rgb", rgb.transformed(TO_MM))
    write_json(run.stage("align") / "report.json", {"similarity": TO_MM.to_json()})
    clones = rgb.transformed(TO_MM)
    clones = GaussianSet.create(
        clones.means, clones.scales, opacities=clones.opacities, sh=clones.sh, modality=Modality.CLONE
    )
    run.write_set("fuse", "fused", GaussianSet.concatenate([xray, clones]))
    return StageContext(Capture(tmp_path, projections=projections, volume=volume), run)


def test_models_that_are_the_truth_score_near_the_limit(whole_run):
    heldout = evaluate_run(whole_run)["heldout"]
    assert heldout["projections"]["psnr"] > 60
    assert heldout["projections"]["xray"]["psnr"] > 60
    assert heldout["sections"]["psnr"] > 45
    assert heldout["sections"]["ssim"] > 0.99
    assert heldout["photos"]["rgb"]["psnr"] > 45
    assert heldout["photos"]["psnr"] > heldout["photos"]["xray"]["psnr"]


def test_a_true_model_of_walls_thinner_than_a_voxel_has_no_error_either(whole_run):
    """Values at points, which are what a section of the model shows, would have 8 dB."""
    means = np.stack(np.meshgrid(*[np.arange(-14, 14, 0.7)] * 2, [-4.1, 0.3, 4.4], indexing="ij"), -1).reshape(-1, 3)
    sheets = GaussianSet.create(means, np.array([0.8, 0.8, 0.15]), density=0.02, modality=Modality.XRAY)
    fine = voxelize(sheets, np.full(3, -19.875), np.full(3, 0.25), (160, 160, 160)).values
    averages = fine.reshape(32, 5, 32, 5, 32, 5).mean(axis=(1, 3, 5))
    capture = replace(whole_run.capture, volume=Volume(averages, np.full(3, 1.25), np.full(3, -19.375)))
    for stage, name in (("surface", "xray"), ("fuse", "fused")):
        whole_run.run.write_set(stage, name, sheets)
    assert evaluate_run(replace(whole_run, capture=capture))["heldout"]["sections"]["psnr"] > 45


def test_rgb_alone_knows_the_outside_and_not_the_inside(whole_run):
    heldout = evaluate_run(whole_run)["heldout"]
    assert heldout["projections"]["rgb"]["psnr"] < heldout["projections"]["psnr"] - 10
    assert heldout["sections"]["rgb"]["psnr"] < heldout["sections"]["psnr"] - 10
    assert heldout["sections"]["rgb"]["fitted_attenuation_per_mm"] > 0


def test_the_report_says_what_was_measured_and_is_json(whole_run):
    report = evaluate_run(whole_run)
    assert json.loads(json.dumps(plain(report)))["heldout"]["photos"]["count"] == 2
    assert report["heldout"]["sections"]["reference"] == "the capture's volume"
    assert "how well they follow it" in report["heldout"]["sections"]["note"]
    assert report["heldout"]["photos"]["background"] == pytest.approx(BACKGROUND.tolist(), abs=0.01)
    assert 0 <= report["heldout"]["sections"]["piqe"] <= 100


@pytest.mark.parametrize(("relative", "unit"), [(False, "mm⁻¹"), (True, "relative")])
def test_the_largest_value_of_sections_is_in_the_units_of_the_densities(tmp_path, xray, relative, unit):
    """Grey values are only scaled: their report named a unit that they do not have."""
    run = RunFolder(tmp_path / "run")
    run.write_set("surface", "xray", xray)
    volume = voxelize(xray, np.full(3, -19.375), np.full(3, 1.25), (32, 32, 32))
    densities = Densities(relative=relative)
    capture = Capture(tmp_path, volume=volume, densities=densities, volume_densities=densities)
    assert f", {unit};" in evaluate_run(StageContext(capture, run))["heldout"]["sections"]["peak_is"]


def test_chamfer_falls_when_the_frames_are_aligned(whole_run):
    distances = evaluate_run(whole_run)["chamfer_mm"]
    assert distances["align"] < 3.0 < 8.0 < distances["none"]
    assert distances["internal"] is None


def test_what_a_skipped_stage_left_before_is_not_measured(whole_run):
    run = whole_run.run
    for name, stage in (("rgb", "align"), ("xray", "surface")):
        run.write_set("internal", name, run.read_set(stage, name))
    assert evaluate_run(whole_run)["chamfer_mm"]["internal"] is not None
    write_json(run.stage("internal") / "report.json", {"skipped": "left out"})
    assert evaluate_run(whole_run)["chamfer_mm"]["internal"] is None


def test_photos_alone_are_a_valid_run(tmp_path, rgb):
    run = RunFolder(tmp_path / "run")
    save_photos(run.stage("initialize") / "photos.json", _photos(rgb, tmp_path))
    run.write_set("surface", "rgb", rgb)
    write_json(run.stage("align") / "report.json", {"skipped": "no X-rays"})
    report = evaluate_run(StageContext(Capture(tmp_path), run))
    assert report["heldout"]["photos"]["psnr"] > 45
    assert report["heldout"]["projections"]["psnr"] is None
    assert report["heldout"]["sections"]["psnr"] is None
    assert "X-ray" in report["heldout"]["sections"]["note"]


def test_xrays_alone_are_a_valid_run(tmp_path, xray, projections):
    run = RunFolder(tmp_path / "run")
    run.write_set("surface", "xray", xray)
    report = evaluate_run(StageContext(Capture(tmp_path, projections=projections), run))
    assert report["heldout"]["projections"]["psnr"] > 60
    assert report["heldout"]["sections"]["reference"] == "FDK of all projections"
    assert report["heldout"]["sections"]["psnr"] > 15
    assert report["heldout"]["photos"]["psnr"] is None


def test_sections_are_measured_where_internal_held_them_out(whole_run):
    settings = {"planes": ["sagittal"], "step_mm": 4.0}
    write_json(whole_run.run.stage("internal") / "report.json", {"settings": settings})
    measured = evaluate_run(whole_run)["heldout"]["sections"]
    # 40 mm in steps of 4 are ten planes, of which every fifth is held out; two series would be twice as many.
    assert measured["count"] == 2


def test_xray_splats_are_shown_as_opaque_as_internal_learnt_them(whole_run, xray):
    """`surface` leaves all of them with one opacity, which shows nothing of the object."""
    shown = []
    for opacity in (0.5, 0.01):
        faint = replace(xray, opacities=np.full_like(xray.opacities, opacity))
        whole_run.run.write_set("internal", "xray", faint)
        shown.append(evaluate_run(whole_run)["heldout"]["photos"]["xray"]["psnr"])
    assert shown[0] > shown[1] + 1


def test_xray_splats_are_shown_in_the_training_photos_colour(whole_run):
    """Held-out photos painted over lower the score; they must not lend the model their colour."""
    photos = registered_photos(whole_run).photos
    before = evaluate_run(whole_run)["heldout"]["photos"]["xray"]["psnr"]
    for photo in photos:
        if photo.held_out:
            Image.new("RGB", Image.open(photo.path).size, (0, 255, 0)).save(photo.path)
    assert evaluate_run(whole_run)["heldout"]["photos"]["xray"]["psnr"] < before - 3


def test_cancelling_stops_it(whole_run):
    asked = []
    reporter = Reporter(is_cancelled=lambda: len(asked) > 3 or asked.append(1))
    with pytest.raises(Cancelled):
        evaluate_run(StageContext(whole_run.capture, whole_run.run, reporter=reporter))
