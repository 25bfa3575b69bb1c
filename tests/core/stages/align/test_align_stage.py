"""The stage as the pipeline runs it: files in, aligned splats and a report out."""

from __future__ import annotations

import itertools
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from insideout.core.capture.model import Capture, Landmarks, Photo, Photos, Projections
from insideout.core.capture.registered import save_photos
from insideout.core.errors import Cancelled
from insideout.core.files import plain
from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.progress import Reporter
from insideout.core.render import splat
from insideout.core.resume import forget
from insideout.core.run_folder import RunFolder
from insideout.core.similarity import Similarity
from insideout.core.stages import align
from insideout.core.stages.align.silhouettes import silhouette_of
from insideout.core.stages.context import StageContext
from insideout.core.views import Camera
from insideout.core.volume import Volume

QUICK = align.AlignSettings(surface_points=3000, rotations=24, outline_photos=8, outline_size=160, local_points=1500)


def _make_run(folder, bodies, body, landmarks=None, **context):
    run = RunFolder(folder / "run")
    bodies.volume(body).save(run.stage("initialize") / "volume.npz")
    rgb, truth = bodies.shell(body, seed=0, count=3000)
    run.write_set("surface", "rgb", rgb)
    picked = None if landmarks is None else Landmarks(*landmarks(rgb, truth))
    return StageContext(Capture(folder, landmarks=picked), run, **context), truth


@pytest.fixture
def run_of(tmp_path, bodies):
    """Makes a run folder with a body's volume and the shell of it, and returns the context and the truth."""
    return lambda body, **options: _make_run(tmp_path, bodies, body, **options)


def _with_photos(context, truth, surface, folder, points=None):
    """Adds photos: the run's splats, painted, within the true outline, in front of a plain background; and points."""
    rgb = context.run.read_set("surface", "rgb")
    paint = np.sin(7 * rgb.means / rgb.means.std())[:, None, :].astype(np.float32)
    size = np.float32(0.7 / truth.scale)
    rgb = replace(rgb, sh=paint, scales=np.full_like(rgb.scales, size), opacities=np.full_like(rgb.opacities, 0.95))
    context.run.write_set("surface", "rgb", rgb)
    background = np.array([0.85, 0.85, 0.9], np.float32)
    vertices = truth.inverse().apply(surface.vertices)
    photos = []
    for number in range(8):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("xyz", [0.6 * (-1) ** number, np.pi * number / 4, 0.2]).as_matrix()
        pose[2, 3] = 220.0
        camera = Camera(160, 160, 300.0, 300.0, 80.0, 80.0, pose).transformed(truth.inverse())
        image = splat(rgb.to_torch(), camera, background.tolist()).color.numpy()
        image = np.where(silhouette_of(vertices, surface.faces, camera)[..., None], image, background)
        path = folder / f"{number}.png"
        Image.fromarray(np.round(255 * np.clip(image, 0, 1)).astype(np.uint8)).save(path)
        photos.append(Photo(path, camera, held_out=number == 7))
    save_photos(context.run.path / "initialize" / "photos.json", Photos(photos, points))


@pytest.fixture(scope="module")
def lump_run(tmp_path_factory, bodies):
    """The stage run on the lump: context, truth, report."""
    folder = tmp_path_factory.mktemp("lump")
    context, truth = _make_run(folder, bodies, bodies.lump)
    return context, truth, align.run(context, QUICK)


def test_it_leaves_the_splats_in_millimetres_with_a_report(lump_run, bodies):
    context, truth, report = lump_run
    rgb = context.run.read_set("surface", "rgb")
    aligned = context.run.read_set("align", "rgb")
    found = Similarity.from_json(report["similarity"])
    assert bodies.errors(found, truth, rgb.means).on_target
    assert len(aligned) == len(rgb)
    assert np.linalg.norm(aligned.means - truth.apply(rgb.means), axis=1).mean() < 0.5
    assert json.loads(json.dumps(plain(report)))["ambiguity"]["kind"] == "none"


def test_each_step_that_is_kept_brings_the_surfaces_nearer(lump_run):
    chamfer = lump_run[2]["chamfer_mm"]
    assert list(chamfer) == ["none", "global", "local_1", "local_2", "local_3", "fine"]
    values = list(chamfer.values())
    assert values[0] > 10 * values[1]
    assert all(later <= earlier for earlier, later in itertools.pairwise(values[1:]))
    assert values[-1] < values[1]


def test_the_same_seed_gives_the_same_result(lump_run):
    context, _, first = lump_run
    means = context.run.read_set("align", "rgb").means
    forget(context.run, "align")
    second = align.run(context, QUICK)
    assert first["similarity"] == second["similarity"]
    assert np.array_equal(means, context.run.read_set("align", "rgb").means)


@pytest.fixture(scope="module")
def photo_run(tmp_path_factory, bodies, lump_surface):
    """The stage run on the lump with photos of it: context and report."""
    folder = tmp_path_factory.mktemp("photos")
    context, truth = _make_run(folder, bodies, bodies.lump)
    _with_photos(context, truth, lump_surface, folder)
    report = align.run(context, QUICK)
    return context, report


def test_photos_keep_the_frame_and_local_steps_in_check(photo_run, bodies):
    context, report = photo_run
    truth = bodies.shell(bodies.lump, seed=0, count=3000)[1]
    rgb = context.run.read_set("surface", "rgb")
    errors = bodies.errors(Similarity.from_json(report["similarity"]), truth, rgb.means)
    assert errors.on_target, errors
    assert report["outlines"]["overlap_after"] > 0.97
    assert report["photo_psnr"]["before"] > 20.0
    assert report["photo_psnr"]["after"] > report["photo_psnr"]["before"] - 0.5


def test_outlines_decide_where_triangulated_points_scatter(tmp_path, bodies, lump_surface):
    """The toy gun: on plain plastic matched highlights put the scale 0.5 to 1 % off, outlines 0.1 %."""
    context, truth = _make_run(tmp_path, bodies, bodies.lump)
    rgb = context.run.read_set("surface", "rgb")
    inwards = rgb.means.mean(axis=0) - rgb.means
    depth = np.abs(np.random.default_rng(0).normal(0, 0.15, (len(rgb), 1)))
    _with_photos(context, truth, lump_surface, tmp_path, rgb.means + depth * inwards)
    painted = context.run.read_set("surface", "rgb")
    context.run.write_set("surface", "rgb", replace(painted, means=painted.means + 0.04 * inwards))
    report = align.run(context, QUICK)
    errors = bodies.errors(Similarity.from_json(report["similarity"]), truth, rgb.means)
    assert errors.on_target, errors
    points, outlines = report["steps"][:2]
    assert (points["step"], points["kept"], outlines["step"], outlines["kept"]) == ("points", False, "outlines", True)
    assert "scatter" in points["reason"]


def test_the_radiative_model_is_laid_on_rather_than_the_first_volume(tmp_path, bodies):
    """An FDK of few projections: here its voxels are 4 % too large."""
    context, truth = _make_run(tmp_path, bodies, bodies.lump)
    volume = bodies.volume(bodies.lump)
    inside = np.argwhere(volume.values > 0.02)[:, ::-1] * volume.spacing_mm + volume.origin_mm
    sigma = 0.8 * float(volume.spacing_mm[0])
    # Splats on a grid add up to their density times (2π)^1.5 σ³ in each cell.
    density = 0.04 * float(volume.spacing_mm[0]) ** 3 / ((2 * np.pi) ** 1.5 * sigma**3)
    model = GaussianSet.create(inside, sigma, density=density, modality=Modality.XRAY)
    context.run.write_set("surface", "xray", model)
    Volume(volume.values, 1.04 * volume.spacing_mm, 1.04 * volume.origin_mm).save(
        context.run.path / "initialize" / "volume.npz"
    )
    box = volume.box_mm
    none = Projections(np.zeros((0, 8, 8), np.float32), [], np.zeros(0, bool), np.zeros(0), box, (8, 8, 8))
    report = align.run(replace(context, capture=replace(context.capture, projections=none)), QUICK)
    rgb = context.run.read_set("surface", "rgb")
    errors = bodies.errors(Similarity.from_json(report["similarity"]), truth, rgb.means)
    assert errors.on_target, errors


def test_landmarks_in_the_capture_decide_a_body_of_revolution(run_of, bodies):
    def picked(rgb, truth):
        points = rgb.means[[10, 400, 900, 2000]].astype(np.float64)
        return points, truth.apply(points)

    context, truth = run_of(bodies.vase, landmarks=picked)
    report = align.run(context, QUICK)
    rgb = context.run.read_set("surface", "rgb")
    assert bodies.errors(Similarity.from_json(report["similarity"]), truth, rgb.means).on_target
    assert report["ambiguity"]["decided_by_landmarks"]
    assert not report["warnings"]


@pytest.mark.parametrize(("order", "told"), [([0, 1, 2, 3], False), ([0, 2, 1, 3], True)])
def test_landmarks_that_contradict_one_another_are_told(order, told, run_of, bodies):
    """A body of revolution lies on its surface at any turn: nothing else would say that two of them changed places."""

    def picked(rgb, truth):
        points = rgb.means[[10, 400, 900, 2000]].astype(np.float64)
        return points, truth.apply(points)[order]

    context, _ = run_of(bodies.vase, landmarks=picked)
    warnings = align.run(context, QUICK)["warnings"]
    assert any("check that both lists have the same points" in warning for warning in warnings) is told


def test_landmarks_on_one_line_are_not_used_and_said_so(run_of, bodies):
    line = np.outer(np.arange(4.0), [1.0, 0, 0])
    context, _ = run_of(bodies.lump, landmarks=lambda rgb, truth: (line, line))
    assert any("landmarks.json" in warning for warning in align.run(context, QUICK)["warnings"])


def test_cancelling_stops_it_and_leaves_nothing_half_done(run_of, bodies):
    asked = []
    context, _ = run_of(bodies.lump, reporter=Reporter(is_cancelled=lambda: len(asked) > 5 or asked.append(1)))
    with pytest.raises(Cancelled):
        align.run(context, QUICK)
    assert not context.run.has_set("align", "rgb")


@pytest.mark.parametrize(
    "reached",
    ["global", "fine", *(pytest.param(part, marks=pytest.mark.slow) for part in ("outlines", "local_2"))],
)
def test_broken_off_anywhere_it_goes_on_after_the_last_finished_step(reached, photo_run, tmp_path):
    context, report = photo_run
    run = RunFolder(shutil.copytree(context.run.path, tmp_path / "run"))
    forget(run, "align")
    (run.path / "align" / "rgb.ply").unlink()
    with pytest.raises(Cancelled):
        align.run(replace(context, run=run, reporter=_stops_at(reached)), QUICK)
    assert not run.has_set("align", "rgb")

    heard = []
    again = align.run(replace(context, run=run, reporter=Reporter(heard.append)), QUICK)
    fitted = [progress for progress in heard if progress.part == "global" and progress.fraction > 0.1]
    assert bool(fitted) == (reached == "global")
    assert again | {"seconds": 0} == plain(report) | {"seconds": 0}
    expected = context.run.read_set("align", "rgb")
    found = run.read_set("align", "rgb")
    assert np.array_equal(found.means, expected.means)
    assert np.array_equal(found.quats, expected.quats)


def _stops_at(part):
    """A reporter that cancels as soon as a part of the stage has begun."""
    reached = []
    return Reporter(lambda progress: reached.extend([1] * (progress.part == part)), lambda: bool(reached))


def test_one_modality_alone_is_skipped_with_a_reason(tmp_path):
    run = RunFolder(tmp_path / "run")
    context = StageContext(Capture(tmp_path), run)
    assert "photos" in align.reason_to_skip(context)
    splats = GaussianSet.create(np.zeros((3, 3)), 1.0)
    run.write_set("surface", "rgb", splats)
    assert "X-ray" in align.reason_to_skip(context)
    run.write_set("surface", "xray", splats)
    (run.stage("initialize") / "volume.npz").touch()
    assert align.reason_to_skip(context) is None


def test_every_preset_exists():
    assert set(align.PRESETS) == {"draft", "standard", "paper"}
