"""A capture folder as a whole: what is in it, its digest, and what `check` says about it."""

from __future__ import annotations

import json
import os
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image

from insideout.core.capture.check import check_capture
from insideout.core.capture.digest import capture_digest
from insideout.core.capture.read import read_capture
from insideout.core.densities import Densities
from insideout.core.errors import CaptureError


@pytest.fixture
def capture(tmp_path, write_xray, write_corner_photos, write_transforms):
    folder = tmp_path / "capture"
    write_xray(folder / "xray")
    cameras = write_corner_photos(folder / "photos", 9)
    write_transforms(folder / "photos", cameras)
    points = {"photo": [[0, 0, 0], [1, 0, 0], [0, 1, 0]], "xray": [[5, 5, 5], [7, 5, 5], [5, 7, 5]]}
    (folder / "landmarks.json").write_text(json.dumps(points))
    np.savez(
        folder / "xray" / "volume.npz",
        volume=np.random.default_rng(0).random((12, 15, 15)).astype(np.float32) * 0.05,
        spacing_mm_zyx=[2, 2, 2],
        unit="1/mm",
    )
    return folder


def snapshot(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def messages(folder, level=None):
    return [f"{f.subject}: {f.message}; {f.advice}" for f in check_capture(folder) if level in (None, f.level)]


def test_everything_is_read_and_nothing_is_changed(capture):
    before = snapshot(capture)
    result = read_capture(capture)
    assert len(result.photos.photos) == 9
    assert len(result.projections.images) == 24
    assert result.volume.values.shape == (12, 15, 15)
    assert len(result.landmarks.photo) == 3
    assert snapshot(capture) == before
    assert result.findings
    assert {finding.level for finding in result.findings} <= {"info", "warning"}


def test_check_says_what_was_found(capture):
    text = "\n".join(messages(capture))
    for part in (
        "9 photos (9 of 320 x 240 pixels)",
        "cameras from transforms.json, 2 held out",
        "24 projections of 32 x 28 pixels of 1.6 x 1.6 mm, cone beam, 3 held out",
        "source to axis 60 mm, to detector 90 mm, magnification 1.5",
        "angles cover 360°, largest step 15.0°",
        "line integrals",
        "volume of 15 x 15 x 12 voxels of 2 x 2 x 2 mm",
        "3 landmarks",
    ):
        assert part in text


def test_the_digest_follows_the_contents_not_the_place(capture, tmp_path):
    digest = read_capture(capture).digest
    shutil.copytree(capture, tmp_path / "elsewhere")
    assert read_capture(tmp_path / "elsewhere").digest == digest
    (tmp_path / "elsewhere" / "notes.txt").write_text("not part of the capture")
    assert read_capture(tmp_path / "elsewhere").digest == digest
    Image.new("RGB", (320, 240), (9, 9, 9)).save(tmp_path / "elsewhere" / "photos" / "03.png")
    assert read_capture(tmp_path / "elsewhere").digest != digest


def test_files_of_one_name_outside_the_folder_all_count(tmp_path):
    files = [tmp_path / "photos" / name / "0.jpg" for name in ("a", "b")]
    for index, path in enumerate(files):
        path.parent.mkdir(parents=True)
        path.write_bytes(bytes([index]))
    (tmp_path / "capture").mkdir()
    before = capture_digest(tmp_path / "capture", files)
    assert capture_digest(tmp_path / "capture", files[::-1]) == before
    for path in files:
        content = path.read_bytes()
        path.write_bytes(b"changed")
        assert capture_digest(tmp_path / "capture", files) != before
        path.write_bytes(content)


@pytest.mark.parametrize("place", ["photos", "images", "."])
def test_photos_alone_may_lie_in_the_folder_itself(tmp_path, write_corner_photos, place):
    write_corner_photos(tmp_path / "c" / place, 8)
    result = read_capture(tmp_path / "c")
    assert len(result.photos.photos) == 8
    assert not result.photos.posed
    assert result.projections is None


def test_a_volume_may_lie_beside_the_photos_folder(capture):
    shutil.move(capture / "xray" / "volume.npz", capture / "volume.npz")
    shutil.rmtree(capture / "xray")
    result = read_capture(capture)
    assert len(result.photos.photos) == 9
    assert result.volume is not None


@pytest.mark.parametrize(("unit", "water"), [("HU", 0.0206), ("1/mm", None)])
def test_the_water_of_hounsfield_units_is_known_of_the_capture(tmp_path, unit, water):
    values = np.linspace(-1000, 1000, 27, dtype=np.float32).reshape(3, 3, 3)
    np.savez(tmp_path / "volume.npz", volume=values, spacing_mm_zyx=[1, 1, 1])
    (tmp_path / "volume.json").write_text(json.dumps({"unit": unit, "mu_water_per_mm": 0.0206}))
    capture = read_capture(tmp_path)
    assert capture.densities == capture.xrays_only().densities == Densities(water_per_mm=water)
    assert capture.volume_densities == capture.densities, "there are no projections"
    photos = capture.photos_only()
    assert photos.densities == photos.volume_densities == Densities()


def test_xrays_alone_may_lie_in_the_folder_itself(tmp_path, write_xray):
    result = read_capture(write_xray(tmp_path))
    assert result.photos is None
    assert len(result.projections.images) == 24


def test_an_empty_folder_is_told_what_belongs_there(tmp_path):
    with pytest.raises(CaptureError, match="holds no photos and no X-rays; put photos into photos/"):
        read_capture(tmp_path)
    with pytest.raises(CaptureError, match="does not exist"):
        read_capture(tmp_path / "nowhere")
    (tmp_path / "file").write_text("")
    with pytest.raises(CaptureError, match="is a file"):
        read_capture(tmp_path / "file")


@pytest.mark.parametrize(
    ("name", "says"), [("photos", "holds no images"), ("xray", "neither projections nor a volume")]
)
def test_an_empty_part_is_named(capture, name, says):
    shutil.rmtree(capture / name)
    (capture / name).mkdir()
    with pytest.raises(CaptureError, match=says):
        read_capture(capture)


@pytest.mark.parametrize(("name", "write"), [("part.tif", tifffile.imwrite), ("part.npy", np.save)])
def test_the_only_array_where_x_rays_belong_is_the_volume(tmp_path, name, write):
    (tmp_path / "xray").mkdir()
    values = np.random.default_rng(0).integers(0, 99, (6, 8, 8)).astype(np.uint16)
    write(tmp_path / "xray" / name, values)
    (tmp_path / "xray" / "part.json").write_text('{"spacing_mm": [1, 1, 2]}')
    assert read_capture(tmp_path).volume.values.shape == (6, 8, 8)


def test_slices_of_a_volume_are_told_from_projections(tmp_path):
    (tmp_path / "xray").mkdir()
    for index in range(3):
        tifffile.imwrite(tmp_path / "xray" / f"slice_{index}.tif", np.full((8, 8), index, np.uint16))
    says = r"3 images \(slice_0\.tif, slice_1\.tif and 1 more\); .* or join slices into one file volume\.tif"
    with pytest.raises(CaptureError, match=says):
        read_capture(tmp_path)


def test_that_a_volume_leads_is_said(capture):
    assert any("sections are taken from it" in text for text in messages(capture, "info"))
    (capture / "xray" / "volume.npz").unlink()
    assert not any("sections are taken from it" in text for text in messages(capture))


def test_photos_of_a_phone_that_cannot_be_read_are_named(tmp_path, write_corner_photos):
    photos = tmp_path / "Photos"
    photos.mkdir()
    (photos / "IMG_1.HEIC").write_bytes(b"heic")
    with pytest.raises(CaptureError, match=r"in a format that cannot be read \(IMG_1\.HEIC\); export them as \.jpg"):
        read_capture(tmp_path)
    write_corner_photos(photos, 3)
    assert len(read_capture(tmp_path).photos.photos) == 3
    assert any("IMG_1.HEIC); they are left out" in message for message in messages(tmp_path, "warning"))


def test_one_photo_is_an_error(tmp_path, write_corner_photos):
    write_corner_photos(tmp_path, 1)
    with pytest.raises(CaptureError, match=r"00\.png: is the only photo; take at least 20"):
        read_capture(tmp_path)


def test_a_file_that_vanishes_while_it_is_read_is_an_error_of_the_capture(capture, monkeypatch):
    def gone(path):
        raise FileNotFoundError(2, "No such file or directory", str(path))

    monkeypatch.setattr("insideout.core.capture.digest.content_digest", gone)
    assert any("cannot be read (No such file or directory)" in message for message in messages(capture, "error"))
    with pytest.raises(CaptureError, match="cannot be read"):
        read_capture(capture)


def test_check_lists_every_error_and_never_raises(capture):
    for name in ("01.png", "05.png"):
        (capture / "photos" / name).write_bytes(b"broken")
    (capture / "xray" / "meta_data.json").write_text("{")
    (capture / "landmarks.json").write_text("[]")
    errors = messages(capture, "error")
    for part in ("01.png: cannot be read", "05.png: cannot be read", "meta_data.json: is not valid JSON", "landmarks"):
        assert sum(part in error for error in errors) == 1
    with pytest.raises(CaptureError, match=r"01\.png"):
        read_capture(capture)
    assert check_capture(capture / "nowhere")[0].level == "error"


def test_every_error_and_warning_says_what_to_do(capture):
    (capture / "photos" / "01.png").write_bytes(b"broken")
    shutil.copy(capture / "photos" / "00.png", capture / "photos" / "extra.png")
    for finding in check_capture(capture):
        assert bool(finding.advice) == (finding.level != "info")


def test_images_without_a_pose_are_mentioned(capture):
    shutil.copy(capture / "photos" / "00.png", capture / "photos" / "extra.png")
    assert any("1 images have no known camera and are not used: extra.png" in m for m in messages(capture, "warning"))


def warned(folder, part):
    return any(part in message for message in messages(folder, "warning"))


def test_normalised_units_are_pointed_out(tmp_path, write_xray):
    def shrink(meta):
        for key, factor in (("DSD", 0.08), ("DSO", 0.08)):
            meta["scanner"][key] *= factor
        for key in ("sDetector", "sVoxel"):
            meta["scanner"][key] = [0.08 * x for x in meta["scanner"][key]]

    assert warned(write_xray(tmp_path / "a", shrink), "units look normalized, not mm")
    assert not warned(write_xray(tmp_path / "b"), "units look normalized")


def test_missing_angles_are_pointed_out(tmp_path, write_xray):
    def half(meta):
        meta["proj_train"] = [frame for frame in meta["proj_train"] if frame["angle"] < 2.7]

    folder = write_xray(tmp_path, half, test=0)
    # Eleven steps of 15°; a fan of 2 · atan(25.6 / 90) needs more than half a turn.
    assert warned(folder, "angles cover 165°, largest step 210.0°; 212° are needed; scan the missing angles too")


def test_a_grid_too_fine_for_memory_is_pointed_out(tmp_path, write_xray):
    def fine(meta):
        meta["scanner"].update(nVoxel=[2000, 2000, 2000])

    folder = write_xray(tmp_path, fine)
    assert warned(folder, "the scanner's grid has 8000 million voxels")
    values = np.random.default_rng(0).random((12, 15, 15)).astype(np.float32) * 0.05
    np.savez(folder / "volume.npz", volume=values, spacing_mm_zyx=[2, 2, 2], unit="1/mm")
    assert not warned(folder, "the scanner's grid"), "nothing is reconstructed where there is a volume"
    np.savez(folder / "volume.npz", volume=values, spacing_mm_zyx=[2, 2, 2])
    assert warned(folder, "the scanner's grid"), "figures are against the FDK where the volume's scale is unknown"


def test_an_object_that_leaves_the_detector_is_pointed_out(tmp_path, write_xray):
    def half_the_width(array, index):
        return array[:, 8:24]

    def narrow(meta):
        meta["scanner"].update(nDetector=[28, 16], sDetector=[28 * 1.6, 16 * 1.6])

    folder = write_xray(tmp_path / "a", narrow, half_the_width)
    assert warned(folder, "leaves the detector at the side")
    assert warned(folder, "of the box falls outside the detector")
    assert not warned(write_xray(tmp_path / "b"), "leaves the detector")


def test_few_projections_are_pointed_out(tmp_path, write_xray):
    def thin(meta):
        meta["proj_train"] = meta["proj_train"][::3]

    assert warned(write_xray(tmp_path, thin), "7 projections to learn from are few")


def test_photos_without_exif_are_pointed_out(tmp_path, write_corner_photos):
    write_corner_photos(tmp_path, 8)
    assert warned(tmp_path, "no focal length in EXIF")


def test_what_does_not_fit_into_memory_is_told(capture, monkeypatch):
    def too_large(*_):
        raise MemoryError

    monkeypatch.setattr("insideout.core.capture.read.read_projections", too_large)
    assert any(
        f"{capture}: does not fit into memory; make the scan smaller with insideout bin" in told
        for told in messages(capture, "error")
    )


@pytest.mark.skipif(sys.platform != "linux", reason="file systems elsewhere have names of characters alone")
def test_names_that_are_no_text_are_read(tmp_path, write_corner_photos):
    write_corner_photos(tmp_path / "photos", 3)
    odd = os.fsencode(tmp_path / "photos") + b"/B\xfcste.png"
    os.rename(os.fsencode(tmp_path / "photos" / "00.png"), odd)
    read = read_capture(tmp_path)
    assert odd in [os.fsencode(photo.path) for photo in read.photos.photos]
    assert len(read.digest) == 64
