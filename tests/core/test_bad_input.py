"""Bad input through the command line: exit code 2, one sentence that names the file, and every file left as it was."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
import sys

import numpy as np
import pytest
from PIL import Image

from insideout.core import cli


@pytest.fixture
def insideout(monkeypatch, capsys):
    """Runs the command line in this process: anything but a clean exit fails the test by itself."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["insideout", *map(str, arguments)])
        try:
            cli.main()
            code = 0
        except SystemExit as end:
            code = end.code
        said = capsys.readouterr()
        return code, said.out + said.err

    return run


def digest(folder):
    """One number over every name and content below a folder."""
    total = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        content = path.read_bytes() if path.is_file() else b""
        total.update(f"{path.relative_to(folder)}\0{len(content)}\n".encode() + content)
    return total.hexdigest()


def photo(folder, number):
    return sorted((folder / "photos").glob("*.jpg"))[number]


def projection(folder, number):
    return sorted((folder / "xray" / "proj_train").glob("*.npy"))[number]


def empty(folder):
    shutil.rmtree(folder)
    folder.mkdir()
    return folder.name


def unreadable_image(folder):
    photo(folder, 3).write_text("not an image")
    return photo(folder, 3).name


def truncated_image(folder):
    path = photo(folder, 5)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    return path.name


def one_photo(folder):
    for path in sorted((folder / "photos").iterdir())[1:]:
        path.unlink()
    return f"{photo(folder, 0).name}: is the only photo"


def photo_without_its_file(folder):
    name = photo(folder, 2).name
    photo(folder, 2).unlink()
    return f"transforms.json: names 1 of 16 images that are missing: {name}"


def all_photos_held_out(folder):
    path = folder / "photos" / "transforms.json"
    content = json.loads(path.read_text())
    content["test_filenames"] = [frame["file_path"] for frame in content["frames"]]
    path.write_text(json.dumps(content))
    return "transforms.json: holds out 16 of 16 photos"


def photos_that_share_nothing(folder):
    (folder / "photos" / "transforms.json").unlink()
    for index, path in enumerate(sorted((folder / "photos").glob("*.jpg"))):
        if index > 3:
            path.unlink()
            continue
        noise = np.random.default_rng(index).integers(0, 255, (30, 40, 3)).astype(np.uint8)
        Image.fromarray(noise).resize((320, 240)).save(path)
    return "photos: none of the 4 photos could be matched"


def change_projection(change, says):
    def spoil(folder):
        path = projection(folder, 2)
        np.save(path, change(np.load(path)))
        return f"{path.name}: {says}"

    return spoil


def with_nan(image):
    image[3, 4] = np.nan
    return image


def truncated_projection(folder):
    path = projection(folder, 2)
    path.write_bytes(path.read_bytes()[:300])
    return f"{path.name}: cannot be read as .npy"


def change_meta(change, says):
    def spoil(folder):
        path = folder / "xray" / "meta_data.json"
        meta = json.loads(path.read_text())
        change(meta)
        path.write_text(json.dumps(meta))
        return f"meta_data.json: {says}"

    return spoil


def without(key):
    return change_meta(lambda meta: meta["scanner"].pop(key), f"lacks '{key}'")


def file_twice(meta):
    meta["proj_test"].append(meta["proj_train"][0])


def volume_without_voxel_size(folder):
    np.save(folder / "xray" / "volume.npy", np.random.default_rng(0).random((4, 4, 4)))
    return "volume.npy: has no voxel size"


def truncated_volume(folder):
    path = folder / "xray" / "volume.npz"
    np.savez(path, volume=np.random.default_rng(0).random((9, 9, 9)), spacing_mm_zyx=[1, 1, 1])
    path.write_bytes(path.read_bytes()[:2000])
    return "volume.npz: is damaged"


FOUND_BY_CHECK = [
    empty,
    unreadable_image,
    truncated_image,
    one_photo,
    photo_without_its_file,
    all_photos_held_out,
    pytest.param(change_projection(with_nan, "has 1 pixels that are NaN"), id="projection with NaN"),
    pytest.param(change_projection(np.zeros_like, "is zero everywhere"), id="projection of zeros"),
    pytest.param(change_projection(lambda image: image[:-1], "is 36 x 47 but"), id="projections of mixed sizes"),
    truncated_projection,
    pytest.param(
        change_meta(lambda meta: meta["proj_train"][2].pop("angle"), "proj_train/0002.npy has no 'angle'"),
        id="missing angle",
    ),
    pytest.param(change_meta(lambda meta: meta.pop("scanner"), "lacks 'scanner'"), id="no scanner"),
    pytest.param(change_meta(lambda meta: meta.pop("proj_train"), "lacks 'proj_train'"), id="no list"),
    pytest.param(change_meta(lambda meta: meta.update(proj_train=None), "lists no projections"), id="null list"),
    pytest.param(change_meta(file_twice, "lists 1 projections more than once"), id="projection listed twice"),
    *(
        pytest.param(without(key), id=f"no {key}")
        for key in ("DSO", "DSD", "nDetector", "sDetector", "nVoxel", "sVoxel")
    ),
    volume_without_voxel_size,
    truncated_volume,
]


@pytest.fixture
def capture(tiny_capture, tmp_path):
    return shutil.copytree(tiny_capture, tmp_path / "capture")


@pytest.mark.parametrize("spoil", FOUND_BY_CHECK)
@pytest.mark.parametrize("command", ["run", "check"])
def test_a_bad_capture_is_named_and_left_alone(spoil, command, capture, insideout, tmp_path):
    named = spoil(capture)
    before = digest(tmp_path)
    code, said = insideout(command, capture, *(["--out", tmp_path / "run"] if command == "run" else []))
    assert code == 2, said
    assert named in said
    assert "Traceback" not in said
    assert digest(tmp_path) == before, "neither is the capture changed nor a run begun"


def test_photos_that_share_nothing_are_told_what_to_do(capture, insideout, tmp_path):
    named = photos_that_share_nothing(capture)
    before = digest(capture)
    code, said = insideout("run", capture, "--out", tmp_path / "run", "--preset", "draft")
    assert code == 2, said
    assert named in said
    assert "photograph one still object from all around" in said
    assert "Traceback" not in said
    assert digest(capture) == before


def test_a_disk_without_room_is_told_before_anything_is_written(capture, insideout, tmp_path, monkeypatch):
    before = digest(tmp_path)
    monkeypatch.setattr("shutil.disk_usage", lambda _: type("Usage", (), {"free": 5 * 2**20})())
    code, said = insideout("run", capture, "--out", tmp_path / "run", "--preset", "draft")
    assert code == 2, said
    assert "only 5 MB are free" in said
    assert "Traceback" not in said
    assert digest(tmp_path) == before


@pytest.mark.parametrize("part", ["photos", "xray"])
def test_a_disk_that_fills_up_during_the_run_is_named(part, capture, insideout, tmp_path, monkeypatch):
    for other in {"photos", "xray", "truth.npz"} - {part}:
        shutil.rmtree(capture / other) if (capture / other).is_dir() else (capture / other).unlink()
    before = digest(capture)
    really_sync = os.fsync

    def full(descriptor):
        if os.fstat(descriptor).st_size > 20_000:
            raise OSError(errno.ENOSPC, "No space left on device")
        really_sync(descriptor)

    monkeypatch.setattr("os.fsync", full)
    code, said = insideout("run", capture, "--out", tmp_path / "run", "--preset", "draft")
    assert code == 2, said
    assert f"{tmp_path / 'run' / 'initialize'}" in said
    assert "the disk is full; free some space" in said
    assert "Traceback" not in said
    assert digest(capture) == before


def test_the_run_folder_of_another_capture_is_named_and_left_alone(capture, insideout, tmp_path):
    shutil.copytree(capture / "xray", tmp_path / "other" / "xray")
    code, said = insideout("run", tmp_path / "other", "--out", tmp_path / "run", "--stage", "initialize")
    assert code == 0, said
    before = digest(tmp_path)
    code, said = insideout("run", capture, "--out", tmp_path / "run")
    assert code == 2, said
    assert f"{tmp_path / 'run'}: holds the run of another capture" in said
    assert "Traceback" not in said
    assert digest(tmp_path) == before
