"""Photos through a lens that transforms.json does not tell, through a run: found, kept, and what it wins back."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image

from insideout.core.capture import sfm_steps
from insideout.core.capture.photos import read_photo
from insideout.core.capture.read import read_capture
from insideout.core.capture.registered import load_photos
from insideout.core.effects import choose
from insideout.core.effects.look.lenses import distorted
from insideout.core.errors import SettingError
from insideout.core.gaussians import GaussianSet
from insideout.core.phantoms.matryoshka import matryoshka
from insideout.core.phantoms.photos import BACKGROUND
from insideout.core.phantoms.shots import transforms
from insideout.core.pipeline import reconstruct
from insideout.core.render import splat
from insideout.core.render.options import SplatOptions
from insideout.core.run_folder import RunFolder
from insideout.core.settings import Settings
from insideout.core.similarity import Similarity
from insideout.core.stages.effects import FILES, STRAIGHT_PHOTOS, RunEffects

SIZE, CORNER_PX = 240, -10.0
LENS = "auto,-moving_background,-exposure,-rolling_shutter,-defocus,-motion_blur,-pixel_integration"
STILL = Similarity(1.0, np.eye(3), np.zeros(3))


def bend(camera):
    return CORNER_PX / np.hypot(SIZE, SIZE) * 2 / (2 * (0.5 * SIZE / camera.fx) ** 2)


@pytest.fixture(scope="module")
def captures(walls, optics, tmp_path_factory):
    """Photos of the walls by pinholes, and what a lens with a corner 10 px farther in makes of them."""
    folder = tmp_path_factory.mktemp("walls")
    cameras = [camera.resized(SIZE, SIZE) for camera in walls.cameras]
    images = [optics.pinhole(walls.set, camera) for camera in cameras]
    at = np.stack(np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5), axis=-1)
    names = [f"{index:03d}.png" for index in range(len(cameras))]
    for kind in ("straight", "bent"):
        photos = folder / kind / "photos"
        photos.mkdir(parents=True)
        (photos / "transforms.json").write_text(json.dumps(transforms(cameras, names, STILL)))
        for camera, image, name in zip(cameras, images, names, strict=True):
            if kind == "bent":
                seen = (at - SIZE / 2) / camera.fx
                ideal = seen
                for _ in range(20):
                    ideal = seen - (distorted(ideal, np.array([bend(camera), 0, 0, 0])) - ideal)
                places = (camera.fx * ideal + SIZE / 2 - 0.5).astype(np.float32)
                image = cv2.remap(image, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            Image.fromarray(np.round(255 * image).astype(np.uint8)).save(photos / name)
    return folder


def initialized(capture, out, settings, effects, **options):
    reconstruct(capture, out, settings=replace(settings, effects=effects), stages=["initialize"], **options)
    return out / "initialize"


@pytest.fixture(scope="module")
def run(captures, tiny_settings, tmp_path_factory):
    """A run of the bent photos that looks for a lens."""
    out = tmp_path_factory.mktemp("runs") / "bent"
    initialized(captures / "bent", out, tiny_settings, LENS)
    return out


def test_a_run_finds_the_lens_and_all_photos_are_read_with_it(captures, run):
    folder = run / "initialize"
    (row,) = RunEffects(folder).rows("photos")
    assert (row["name"], row["found"], row["used"]) == ("lens", True, True)
    assert row["strength"] == pytest.approx(-CORNER_PX, rel=0.1)
    assert row["seconds"] > 0
    photos, given = load_photos(folder / "photos.json").photos, read_capture(captures / "bent").photos.photos
    straight = read_capture(captures / "straight").photos.photos
    assert any(photo.held_out for photo in photos)
    for photo, own, clean in zip(photos, given, straight, strict=True):
        assert photo.lens.coefficients[0] == pytest.approx(bend(own.camera), rel=0.1)
        assert own.lens is None
        np.testing.assert_array_equal(photo.camera.world_to_camera, own.camera.world_to_camera)
        # As the pinhole has it, where that sees as much.
        image, camera = read_photo(photo)
        inner = [np.array([[c.fx, 0, c.cx - 0.5], [0, c.fy, c.cy - 0.5], [0, 0, 1]]) for c in (own.camera, camera)]
        turned = cv2.warpPerspective(image, inner[0] @ np.linalg.inv(inner[1]), (SIZE, SIZE))
        truth, bent = (np.asarray(Image.open(one.path), np.float32) / 255 for one in (clean, own))
        middle = slice(20, -20)
        off, before = (((one - truth)[middle, middle] ** 2).mean() for one in (turned, bent))
        assert off < 0.2 * before
    assert not (folder / "sfm-lens").exists()


def test_points_are_those_of_the_photos_without_the_lens(run):
    """Of which other effects are told, too."""
    folder = run / "initialize"
    photos = [photo for photo in load_photos(folder / "photos.json").photos if not photo.held_out]
    model = pycolmap.Reconstruction(folder / "sfm" / "model")
    assert len(model.images) == len(photos)
    for camera in model.cameras.values():
        np.testing.assert_allclose(camera.params[:2], [photos[0].camera.fx, photos[0].camera.fy])


def test_straight_photos_are_left_as_they_are_to_the_last_bit(captures, tiny_settings, tmp_path, monkeypatch):
    monkeypatch.setattr(sfm_steps, "MATCHING_THREADS", 1)  # what several threads match is not always the same
    folders = [
        initialized(captures / "straight", tmp_path / name, tiny_settings, effects)
        for name, effects in (("none", "none"), ("auto", LENS))
    ]
    (row,) = RunEffects(folders[1]).rows("photos")
    assert (row["found"] is True, row["used"]) == (False, False)
    for name in ("photos.json", "rgb.ply"):
        assert (folders[0] / name).read_bytes() == (folders[1] / name).read_bytes()
    assert not (folders[0] / FILES["lens"]).exists()


def test_a_run_that_was_broken_off_goes_on_with_the_lens_that_was_found(captures, tiny_settings, tmp_path, monkeypatch):
    class StoppedError(Exception):
        pass

    def stop(*_):
        raise StoppedError

    with monkeypatch.context() as during:
        during.setattr("insideout.core.stages.initialize.photos.save_photos", stop)
        with pytest.raises(StoppedError):
            initialized(captures / "bent", tmp_path / "run", tiny_settings, LENS)
    found = load_photos(tmp_path / "run" / "initialize" / STRAIGHT_PHOTOS)
    with monkeypatch.context() as during:
        during.setattr("insideout.core.effects.lens.look", stop)
        folder = initialized(captures / "bent", tmp_path / "run", tiny_settings, LENS)
    # Not the points: they were others once, on busy cores, and in a dozen tries since never.
    went_on = load_photos(folder / "photos.json")
    assert [photo.path for photo in went_on.photos] == [photo.path for photo in found.photos]
    for one, other in zip(went_on.photos, found.photos, strict=True):
        assert one.lens is not None
        assert one.lens == other.lens
        np.testing.assert_array_equal(one.camera.world_to_camera, other.camera.world_to_camera)
    assert len(GaussianSet.load(folder / "rgb.ply")) > 0


def test_a_run_begun_anew_without_effects_leaves_nothing_of_it(captures, run, tiny_settings, tmp_path):
    out = tmp_path / "run"
    shutil.copytree(run, out)
    folder = initialized(captures / "bent", out, tiny_settings, "none", fresh=True)
    assert all(photo.lens is None for photo in load_photos(folder / "photos.json").photos)
    assert not (folder / FILES["lens"]).exists()
    assert not (folder / STRAIGHT_PHOTOS).exists()


@pytest.fixture(scope="module")
def with_points(captures, tiny_settings, tmp_path_factory):
    """Bent photos with the points of a COLMAP model, and the folder of a run that found the lens."""
    folder = tmp_path_factory.mktemp("points")
    made = initialized(captures / "bent", folder / "made", tiny_settings, "none") / "sfm"
    shutil.copytree(made / "images", folder / "capture" / "photos")
    shutil.copytree(made / "model", folder / "capture" / "sparse" / "0")
    initialized(folder / "capture", folder / "run", tiny_settings, LENS)
    return folder


def test_a_capture_with_points_has_the_lens_found_again_when_its_run_is_begun_anew(with_points, tiny_settings):
    folder = with_points / "run" / "initialize"
    assert (folder / "sfm" / "model" / "points3D.bin").is_file(), "of the photos without the lens"
    initialized(with_points / "capture", with_points / "run", tiny_settings, LENS, fresh=True)
    (row,) = RunEffects(folder).rows("lens")
    assert row["strength"] == pytest.approx(-CORNER_PX, rel=0.1)
    assert all(photo.lens is not None for photo in load_photos(folder / "photos.json").photos)


def test_other_effects_are_looked_for_with_the_points_that_the_run_uses(
    with_points, tiny_settings, tmp_path, monkeypatch
):
    look, models = choose.look_at_photos, []

    def watched(request, evidence, given):
        models.append(evidence.model)
        return look(request, evidence, given)

    monkeypatch.setattr(choose, "look_at_photos", watched)
    out = tmp_path / "run"
    shutil.copytree(with_points / "run", out)
    initialized(with_points / "capture", out, tiny_settings, LENS, fresh=True)
    initialized(with_points / "capture", out, tiny_settings, LENS.replace("-exposure", "-lens"), fresh=True)
    assert models == [out / "initialize" / "sfm" / "model", with_points / "capture" / "sparse" / "0"]


def test_where_it_cannot_be_it_is_not_looked_for_and_refused_where_it_is_asked_for(captures, tiny_settings, tmp_path):
    told = tmp_path / "told"
    shutil.copytree(captures / "bent", told)
    poses = told / "photos" / "transforms.json"
    content = json.loads(poses.read_text())
    poses.write_text(
        json.dumps({**content, "camera_model": "OPENCV", "k1": bend(read_capture(told).photos.photos[0].camera)})
    )
    folder = initialized(told, tmp_path / "run", tiny_settings, LENS)
    (row,) = RunEffects(folder).rows("photos")
    assert (row["found"], row["used"]) == (False, False)
    assert "the file says" in row["reason"]
    with pytest.raises(SettingError, match="lens is for cameras whose file says nothing of it"):
        initialized(told, tmp_path / "asked", tiny_settings, "lens")
    poses.unlink()
    with pytest.raises(SettingError, match="structure from motion finds the lens"):
        initialized(told, tmp_path / "asked", tiny_settings, "lens")


SLOW_SIZE, SLOW_SIDE, SLOW_PHOTOS, SLOW_STEPS = 256, 96, 32, 1200


def decibels(run, plain):
    """Mean PSNR in dB of held-out photos as pinholes at the given places have them."""
    splats, found = RunFolder(run).read_set("surface", "rgb").to_torch(), []
    options = vars(SplatOptions.of(RunFolder(run)))
    for photo in plain.photos:
        if photo.held_out:
            truth, camera = read_photo(photo, SLOW_SIDE)
            with torch.no_grad():
                drawn = splat(splats, camera, torch.tensor(BACKGROUND), **options)
            shown = drawn.color.clamp(0, 1).numpy()
            found.append(-10 * np.log10(((shown - truth) ** 2).mean()))
    return float(np.mean(found))


@pytest.mark.slow
def test_most_of_what_a_lens_costs_comes_back(photographs, tmp_path):
    """93 %: held-out photos as pinholes have them 31.9 dB, through the lens 26.7, with it taken out 31.5."""
    folder = photographs.of_phantom(tmp_path, matryoshka(), SLOW_SIZE, SLOW_PHOTOS, ("lens",))
    settings = Settings.of("draft")
    surface = settings.stages["surface"]
    surface = replace(surface, rgb=replace(surface.rgb, iterations=SLOW_STEPS, long_side=SLOW_SIDE))
    settings = replace(settings, stages={**settings.stages, "surface": surface})
    plain, found = read_capture(folder / "plain").photos, {}
    for kind, effects in (("plain", "none"), ("seen", "none"), ("seen", LENS)):
        out = tmp_path / f"{kind}-{effects[:4]}"
        given = replace(settings, effects=effects)
        reconstruct(folder / kind, out, settings=given, stages=["initialize", "surface"])
        found[kind, effects] = decibels(out, plain)
    best, lost, left = found["plain", "none"], found["seen", "none"], found["seen", LENS]
    assert best - lost > 3
    assert best - left < 0.2 * (best - lost)
