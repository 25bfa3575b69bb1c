"""A made capture reads back as any other, and its truth fits it."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from insideout.core.capture.photos import read_photo
from insideout.core.capture.read import read_capture
from insideout.core.errors import Cancelled, SettingError
from insideout.core.fdk import coverage, fdk
from insideout.core.phantoms import make
from insideout.core.phantoms.distance_grid import DistanceGrid
from insideout.core.phantoms.make import make_capture
from insideout.core.phantoms.part_tables import PartTables
from insideout.core.phantoms.photos import render_photo
from insideout.core.phantoms.scanner import scan_geometry
from insideout.core.phantoms.truth import truth_volume
from insideout.core.progress import Reporter
from insideout.core.similarity import Similarity
from insideout.core.volume import Volume


@pytest.fixture(scope="module")
def capture(small_capture):
    return read_capture(small_capture)


@pytest.fixture(scope="module")
def to_world(small_capture):
    with np.load(small_capture / "truth.npz") as truth:
        return Similarity(float(truth["scale"]), truth["rotation"], truth["translation"])


def test_it_reads_without_complaint(capture, small_settings):
    assert not [finding for finding in capture.findings if finding.level == "error"]
    assert len(capture.photos.photos) == small_settings.photos
    assert capture.photos.posed
    assert capture.projections.held_out.sum() == small_settings.heldout_projections
    assert len(capture.landmarks.photo) >= 3
    assert capture.volume is None


def test_geometry_reads_back_as_it_was_projected(capture, doll, small_settings):
    scan = scan_geometry(doll, small_settings.detector_width, small_settings.detector_height)
    for read, angle in zip(capture.projections.detectors, capture.projections.angles_rad, strict=True):
        made = scan.detector(float(angle))
        for name in ("source", "center", "u", "v"):
            np.testing.assert_allclose(getattr(read, name), getattr(made, name), atol=1e-9)


def test_reconstruction_finds_the_truth_and_not_its_mirror_image(capture, small_capture):
    truth = Volume.load(small_capture / "truth.npz")
    found = fdk(capture.projections)

    np.testing.assert_allclose(found.origin_mm, truth.origin_mm)
    np.testing.assert_allclose(found.spacing_mm, truth.spacing_mm)

    def error(values):
        return float(np.mean((found.values - values) ** 2))

    straight = error(truth.values)
    for axis in range(3):
        assert straight < 0.97 * error(np.flip(truth.values, axis))
        assert straight < 0.97 * error(np.roll(truth.values, 1, axis))
    assert np.sum(found.values * truth.values) / np.sum(truth.values**2) == pytest.approx(1.0, abs=0.12)
    assert coverage(capture.projections)["cut_off"] == 0


@pytest.mark.usefixtures("only_ball")
def test_the_usual_reconstruction_is_left_where_it_is_asked_for(tmp_path, ball_settings):
    """Of one photo, too, which is no capture; and it is no part of what a run is given."""
    one = make_capture("ball", tmp_path / "one", replace(ball_settings, fdk=True, photos=1), 0)
    assert (one / "fdk.npz").exists()
    made = make_capture("ball", tmp_path / "with", replace(ball_settings, fdk=True), 0)
    found, capture = Volume.load(made / "fdk.npz"), read_capture(made)
    assert capture.volume is None
    expected = fdk(capture.projections, window="hann")
    np.testing.assert_allclose(found.values, expected.values, atol=1e-6)
    np.testing.assert_allclose(found.origin_mm, Volume.load(made / "truth.npz").origin_mm)
    without = make_capture("ball", tmp_path / "without", ball_settings, 0)
    assert sorted(path.name for path in made.iterdir() if path.name != "fdk.npz") == sorted(
        path.name for path in without.iterdir()
    )


def test_photos_are_those_of_the_truth_moved_by_the_similarity(capture, doll, to_world):
    grid = DistanceGrid.bake(doll.surface, np.array(doll.size_mm), 0.5)
    for photo in capture.photos.photos[::4]:
        pixels, camera = read_photo(photo)
        again = render_photo(doll, grid, camera.transformed(to_world), supersample=4)
        assert np.abs(pixels - again).mean() < 0.02


def test_photo_frame_is_some_way_from_the_world(to_world):
    assert 50 < to_world.scale < 70
    assert np.linalg.det(to_world.rotation) == pytest.approx(1)
    assert np.abs(to_world.rotation - np.eye(3)).max() > 0.2


def test_landmarks_match_through_the_similarity(capture, to_world, doll):
    np.testing.assert_allclose(to_world.apply(capture.landmarks.photo), capture.landmarks.xray, atol=1e-6)
    np.testing.assert_allclose(capture.landmarks.xray, doll.landmarks)


@pytest.mark.parametrize(("of_revolution", "asked", "there"), [
    (True, None, True), (False, None, False), (True, False, False), (False, True, True),
])  # fmt: skip
def test_landmarks_are_given_where_shape_leaves_a_turn_open_or_they_are_asked_for(
    monkeypatch, tmp_path, ball, ball_settings, of_revolution, asked, there
):
    turned = replace(ball, of_revolution=of_revolution)
    monkeypatch.setattr("insideout.core.phantoms.make.PHANTOMS", {"ball": lambda: turned})
    made = make_capture("ball", tmp_path / "new", replace(ball_settings, landmarks=asked), 0)
    assert (made / "landmarks.json").exists() == there


def test_truth_is_the_attenuation(small_capture, doll, small_settings):
    tables = PartTables.bake(doll, small_settings.table_mm)
    saved, made = Volume.load(small_capture / "truth.npz"), truth_volume(doll, tables, small_settings.voxel_mm)

    np.testing.assert_allclose(saved.values, made.values, atol=1e-4)
    voxel = np.array([9, made.values.shape[1] // 2, made.values.shape[2] // 2])
    center = made.origin_mm + voxel[::-1] * made.spacing_mm
    around = center + np.random.default_rng(0).uniform(-0.5, 0.5, (4000, 3)) * made.spacing_mm
    assert made.values[tuple(voxel)] == pytest.approx(doll.attenuation(around).mean(), abs=2e-3)


@pytest.mark.usefixtures("only_ball")
def test_same_seed_same_files_another_seed_another_frame(tmp_path, ball_settings):
    noisy = replace(ball_settings, effects=("noise", "defocus", "rolling_shutter"))
    folders = [make_capture("ball", tmp_path / str(i), noisy, seed) for i, seed in enumerate((1, 1, 2))]

    def content(folder, name):
        return (folder / name).read_bytes()

    for name in ("photos/001.jpg", "xray/proj_train/0001.npy", "xray/meta_data.json", "landmarks.json"):
        assert content(folders[0], name) == content(folders[1], name)
    assert content(folders[0], "landmarks.json") != content(folders[2], "landmarks.json")


def test_layout_is_that_of_r2_gaussian(small_capture):
    meta = json.loads((small_capture / "xray" / "meta_data.json").read_text())
    scanner = meta["scanner"]
    image = np.load(small_capture / "xray" / meta["proj_train"][0]["file_path"])

    assert image.dtype == np.float16
    assert list(image.shape) == scanner["nDetector"]
    assert scanner["DSD"] > scanner["DSO"] > 102
    np.testing.assert_allclose(np.diff(meta["bbox"], axis=0)[0], scanner["sVoxel"])


def test_mistakes_are_named_and_nothing_is_overwritten(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(SettingError, match="is not empty"):
        make_capture("matryoshka", tmp_path)
    with pytest.raises(SettingError, match="is a file"):
        make_capture("matryoshka", tmp_path / "mine.txt")
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]
    with pytest.raises(SettingError, match="choose one of: matryoshka"):
        make_capture("teapot", tmp_path / "new")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("photos", 0),
        ("photons", 0.0),
        ("voxel_mm", np.inf),
        ("voxel_mm", 0.05),
        ("surface_mm", 20.0),
        ("heldout_projections", -1),
    ],
)
def test_settings_out_of_range_are_named(tmp_path, small_settings, name, value):
    with pytest.raises(SettingError, match=name):
        make_capture("matryoshka", tmp_path / "new", replace(small_settings, **{name: value}))
    assert not (tmp_path / "new").exists()


@pytest.mark.usefixtures("only_ball")
@pytest.mark.parametrize("part", ["photos", "xray", "truth"])
def test_a_cancelled_capture_leaves_nothing_and_the_same_call_works_again(tmp_path, ball_settings, part):
    seen = []

    def stop():
        return bool(seen) and seen[-1] == part

    reporter = Reporter(lambda progress: seen.append(progress.part), stop)
    with pytest.raises(Cancelled):
        make_capture("ball", tmp_path / "new", ball_settings, reporter=reporter)
    assert seen[-1] == part
    assert not any(tmp_path.iterdir())

    folder = make_capture("ball", tmp_path / "new", ball_settings)
    assert not [finding for finding in read_capture(folder).findings if finding.level == "error"]
    assert [path.name for path in tmp_path.iterdir()] == ["new"]


@pytest.mark.usefixtures("only_ball")
def test_what_photos_are_taken_with_is_closed_when_writing_fails(tmp_path, ball_settings, monkeypatch):
    closed = []

    def photos(*_):
        try:
            yield np.zeros((8, 8, 3))
        finally:
            closed.append(True)

    monkeypatch.setattr(make, "take_photos", photos)
    with pytest.raises(TypeError) as caught:
        make_capture("ball", tmp_path / "new", ball_settings)
    assert closed
    del caught
