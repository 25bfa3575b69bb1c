"""Photos with cameras go through a file of the run unchanged."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest

from insideout.core.capture.model import Backdrop, Lens, Photo, Photos
from insideout.core.capture.registered import load_photos, save_photos
from insideout.core.errors import RunFolderError


@pytest.fixture
def photos(tmp_path, write_corner_photos):
    cameras = write_corner_photos(tmp_path / "capture", 3)
    lens = Lens(320, 240, 330.0, 331.0, 160.0, 120.0, (-0.1, 0.02, 0.0, 0.0))
    listed = [Photo(tmp_path / "capture" / f"{i:02d}.png", camera) for i, camera in enumerate(cameras)]
    listed[1] = replace(listed[1], held_out=True, lens=lens, upright=False)
    return Photos(listed, np.random.default_rng(0).normal(size=(5, 3)), np.linspace(0, 1, 15).reshape(5, 3))


def test_what_is_saved_is_loaded(tmp_path, photos):
    path = tmp_path / "run" / "initialize" / "photos.json"
    save_photos(path, photos)
    loaded = load_photos(path)
    assert np.array_equal(loaded.points, photos.points)
    assert np.array_equal(loaded.colors, photos.colors)
    for before, after in zip(photos.photos, loaded.photos, strict=True):
        assert after.path == before.path.resolve()
        assert (after.held_out, after.lens, after.upright) == (before.held_out, before.lens, before.upright)
        assert np.array_equal(after.camera.world_to_camera, before.camera.world_to_camera)
        for name in ("width", "height", "fx", "fy", "cx", "cy", "near", "orthographic"):
            assert getattr(after.camera, name) == getattr(before.camera, name)


def test_photos_without_cameras_or_points(tmp_path, photos):
    bare = Photos([replace(photo, camera=None) for photo in photos.photos])
    save_photos(tmp_path / "photos.json", bare)
    loaded = load_photos(tmp_path / "photos.json")
    assert loaded.points is None
    assert not loaded.posed


def test_capture_and_run_may_move_together(tmp_path, photos):
    save_photos(tmp_path / "run" / "photos.json", photos)
    (tmp_path / "elsewhere").mkdir()
    for name in ("capture", "run"):
        shutil.move(tmp_path / name, tmp_path / "elsewhere" / name)
    loaded = load_photos(tmp_path / "elsewhere" / "run" / "photos.json")
    assert loaded.photos[0].path == (tmp_path / "elsewhere" / "capture" / "00.png").resolve()


def test_backdrops_move_with_the_run_and_are_found_from_copies_elsewhere(tmp_path, photos):
    behind = Backdrop(tmp_path / "run" / "backdrop-1.png", (0.2, 0.8, 0.5), 0.04)
    first, *others = photos.photos
    for folder in ("run", "copy"):
        kept = replace(photos, photos=[replace(first, backdrop=behind), *others])
        save_photos(tmp_path / folder / "photos.json", kept)
    behind.path.touch()
    copied = load_photos(tmp_path / "copy" / "photos.json").photos
    assert copied[0].backdrop == behind
    assert all(photo.backdrop is None for photo in copied[1:])
    shutil.move(tmp_path / "run", tmp_path / "moved")
    moved = load_photos(tmp_path / "moved" / "photos.json").photos
    assert moved[0].backdrop == replace(behind, path=tmp_path / "moved" / "backdrop-1.png")


def test_a_photo_that_is_gone_is_named(tmp_path, photos):
    save_photos(tmp_path / "photos.json", photos)
    photos.photos[2].path.unlink()
    with pytest.raises(RunFolderError, match=r"02\.png: the photo is gone"):
        load_photos(tmp_path / "photos.json")


@pytest.mark.parametrize("content", ["", "{}", '{"photos": [{}], "points": null, "colors": null}'])
def test_a_damaged_file_is_named(tmp_path, content):
    (tmp_path / "photos.json").write_text(content)
    with pytest.raises(RunFolderError, match=r"photos\.json: cannot be read"):
        load_photos(tmp_path / "photos.json")
