"""A scan made smaller is the same scan: where its pixels lie, what they hold, from which angles."""

from __future__ import annotations

import itertools
import json
from types import SimpleNamespace

import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from insideout.core import progress
from insideout.core.capture.binning import bin_scan
from insideout.core.capture.projections import find_projections, read_projections
from insideout.core.cli import app
from insideout.core.errors import Cancelled, CaptureError, SettingError
from insideout.core.progress import Reporter

NIKON = """[XTekCT]
Name=balls
VoxelsX=16
VoxelsY=16
VoxelsZ=16
VoxelSizeX=2
VoxelSizeY=2
VoxelSizeZ=2
SrcToObject=60
SrcToDetector=90
DetectorPixelsX=32
DetectorPixelsY=28
DetectorPixelSizeX=1.6
DetectorPixelSizeY=1.6
WhiteLevel=60000.0
Projections=12
InitialAngle=36
AngularStep=30.0
[Xrays]
Projections=99
"""


@pytest.fixture(params=["nikon", "r2"])
def full(request, tmp_path, scan, radiograph, write_xray):
    """A scan of 28 rows and 32 columns."""
    if request.param == "r2":
        return write_xray(tmp_path / "full")
    folder = tmp_path / "full"
    folder.mkdir()
    (folder / "balls.xtekct").write_text(NIKON, "utf-8")
    for index, angle in enumerate(np.deg2rad(36 + 30.0 * np.arange(12))):
        counts = 60000 * np.exp(-radiograph(scan.detector(angle))[:, ::-1])
        tifffile.imwrite(folder / f"balls_{index + 1:04d}.tif", counts.astype(np.uint16))
    return folder


def read(folder):
    return read_projections(find_projections(folder)).projections


def pixel_centers(detector):
    """(rows, columns, 3) mm."""
    columns, rows = np.meshgrid(
        np.arange(detector.width) + 0.5 - detector.width / 2, np.arange(detector.height) + 0.5 - detector.height / 2
    )
    return detector.center + columns[..., None] * detector.u + rows[..., None] * detector.v


def block_means(pixels, by):
    """Of an image (rows, columns, ...), what is left over dropped before and after."""
    for axis in (0, 1):
        rest = pixels.shape[axis] % by
        pixels = np.take(pixels, range(rest // 2, pixels.shape[axis] - (rest - rest // 2)), axis=axis)
    rows, columns, *more = pixels.shape
    return pixels.reshape(rows // by, by, columns // by, by, *more).mean(axis=(1, 3))


@pytest.mark.parametrize("by", [4, 5])
def test_every_pixel_lies_where_those_lay_that_it_is_the_mean_of(full, tmp_path, by):
    """28 and 32 pixels are not multiples of 5."""
    made = bin_scan(full, tmp_path / "small", by)
    before, after = read(full), read(tmp_path / "small")
    assert (made.projections, made.height, made.width) == after.images.shape
    assert made.voxels == after.voxels == (round(16 / by),) * 3
    np.testing.assert_allclose(after.box_mm, before.box_mm)
    np.testing.assert_allclose(after.angles_rad, before.angles_rad)
    for old, new in zip(before.detectors, after.detectors, strict=True):
        np.testing.assert_allclose(pixel_centers(new), block_means(pixel_centers(old), by), atol=1e-9)
        np.testing.assert_allclose(new.source, old.source)
    # Counts are averaged before the logarithm, line integrals as they are.
    for old, new in zip(before.images, after.images, strict=True):
        np.testing.assert_allclose(new, block_means(old, by), atol=0.05)


def test_every_third_projection_keeps_its_angle(full, tmp_path):
    bin_scan(full, tmp_path / "small", by=2, every=3)
    before, after = read(full), read(tmp_path / "small")
    # Held-out ones are thinned by themselves where the scan says which they are, and listed last.
    parts = np.split(np.arange(len(before.images)), [21]) if len(before.images) == 24 else [np.arange(12)]
    kept = np.concatenate([part[::3] for part in parts])
    np.testing.assert_allclose(after.angles_rad, before.angles_rad[kept])
    for new, old in zip(after.images, before.images[kept], strict=True):
        np.testing.assert_allclose(new, block_means(old, 2), atol=0.05)


def test_what_the_scanner_s_file_says_else_stays(full, tmp_path):
    bin_scan(full, tmp_path / "small", by=2)
    source = find_projections(tmp_path / "small")
    if source.suffix == ".xtekct":
        text = source.read_text("utf-8")
        assert "Name=balls" in text
        assert "WhiteLevel=60000.0" in text
        assert "[Xrays]\nProjections=99" in text
        assert tifffile.imread(tmp_path / "small" / "balls_0001.tif").dtype == np.uint16
    else:
        assert json.loads(source.read_text("utf-8"))["scanner"]["DSO"] == 60.0


@pytest.mark.parametrize("full", ["nikon"], indirect=True)
def test_files_that_a_scan_does_not_name_are_told_for_the_new_one_has_them_no_more(full, tmp_path):
    (full / "balls.xtekct").write_text(NIKON.replace("Projections=12", "Projections=3"), "utf-8")
    told = CliRunner().invoke(app, ["bin", str(full), "--out", str(tmp_path / "small"), "--by", "2"])
    assert told.exit_code == 0, told.output
    assert "names 3 projections but 12 .tif files are here" in " ".join(told.output.split())
    assert len(read(tmp_path / "small").images) == 3


def test_flat_and_dark_images_are_binned_with_the_readings(tmp_path, write_xray):
    folder = write_xray(tmp_path / "full", image=lambda line, index: 100 + 5000 * np.exp(-line))
    rng = np.random.default_rng(0)
    np.save(folder / "flat.npy", 5100 + rng.random((3, 28, 32)))
    np.save(folder / "dark.npy", 100 + 0.1 * rng.random((28, 32)))
    bin_scan(folder, tmp_path / "small", by=2)
    before, after = read(folder), read(tmp_path / "small")
    np.testing.assert_allclose(after.images[0], block_means(before.images[0], 2), atol=0.05)
    assert np.load(tmp_path / "small" / "flat.npy").shape == (14, 16)


@pytest.fixture
def with_spoiled(tmp_path, full):
    """Sets pixels, a mask (28, 32) as they are read, of all views of the scan to what a dead one has; returns line
    integrals (M, 28, 32) of before."""

    def spoil(dead):
        straight = read(full).images.copy()
        for file in [*full.rglob("*.tif"), *full.rglob("*.npy")]:
            counts = file.suffix == ".tif"
            image = tifffile.imread(file) if counts else np.load(file)
            image[dead[:, ::-1] if counts else dead] = 0 if counts else -np.log(1e-6)
            (tifffile.imwrite if counts else np.save)(file, image)
        return straight

    return spoil


@pytest.mark.parametrize("by", [2, 4])
def test_pixels_that_see_nothing_have_no_part_in_their_blocks(full, tmp_path, with_spoiled, by):
    """In counts as in line integrals, where such a pixel would be seen in all views as a ring."""
    dead = np.zeros((28, 32), bool)
    dead[13, 15] = dead[3, 4] = True
    straight = with_spoiled(dead)
    assert bin_scan(full, tmp_path / "small", by).dead == 2
    living = np.where(dead, np.nan, straight)
    for old, new in zip(living, read(tmp_path / "small").images, strict=True):
        blocks = old.reshape(28 // by, by, 32 // by, by)
        np.testing.assert_allclose(new, np.nanmean(blocks, axis=(1, 3)), atol=0.05)


def test_a_block_that_sees_nothing_is_found_when_it_is_read(full, tmp_path, with_spoiled):
    """A line two pixels wide becomes one of one pixel."""
    dead = np.zeros((28, 32), bool)
    dead[:, 14:16] = True
    with_spoiled(dead)
    assert bin_scan(full, tmp_path / "small", by=2).dead == 56
    result = read_projections(find_projections(tmp_path / "small"))
    assert any("14 pixels saw no X-rays" in finding.message for finding in result.findings)
    assert result.projections.images.max() < 3


def test_who_bins_is_told_of_dead_pixels(full, tmp_path, with_spoiled):
    dead = np.zeros((28, 32), bool)
    dead[13, 15] = True
    with_spoiled(dead)
    ran = CliRunner().invoke(app, ["bin", str(full), "--out", str(tmp_path / "small")])
    assert ran.exit_code == 0
    assert "1 pixels saw no X-rays in any projection" in ran.output


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_millionth_of_the_light_is_nothing(tmp_path, write_xray, dtype):
    """Transmissions may have been cut off there when they were saved."""

    def transmission(line, index):
        image = np.exp(-line).astype(dtype)
        image[3, 4] = 1e-6
        return image

    full = write_xray(tmp_path / "full", image=transmission)
    assert bin_scan(full, tmp_path / "small", by=2).dead == 1
    assert read(tmp_path / "small").images[:, 1, 2] == pytest.approx(0, abs=0.01)


def test_metal_that_lets_nothing_through_is_no_dead_pixel(full, tmp_path, with_spoiled):
    metal = np.zeros((28, 32), bool)
    metal[9:16, 13:19] = True
    with_spoiled(metal)
    assert bin_scan(full, tmp_path / "small", by=4).dead == 0


def test_air_of_line_integrals_is_no_dead_pixel(tmp_path, write_xray):
    """A pixel of it may be 0 in all views where noise is about others."""
    noise = np.random.default_rng(0).uniform(0.01, 0.02, (28, 32)).astype(np.float32)
    noise[5, 6] = 0
    full = write_xray(tmp_path / "full", image=lambda line, index: np.where(noise == 0, 0, line + noise))
    assert bin_scan(full, tmp_path / "small", by=2).dead == 0
    np.testing.assert_allclose(read(tmp_path / "small").images[0], block_means(read(full).images[0], 2), atol=1e-6)


def test_dead_pixels_have_no_part_in_the_flat_field_either(tmp_path, write_xray):
    """It may have seen what the readings do not: a pixel that was covered later."""

    def reading(line, index):
        counts = np.round(100 + 5000 * np.exp(-line)).astype(np.uint16)
        counts[13, 15] = 98
        return counts

    folder = write_xray(tmp_path / "full", image=reading)
    np.save(folder / "flat.npy", np.full((28, 32), 5100))
    np.save(folder / "dark.npy", np.full((28, 32), 100))
    assert bin_scan(folder, tmp_path / "small", by=2).dead == 1
    straight = read(write_xray(tmp_path / "straight")).images
    after = read(tmp_path / "small").images
    np.testing.assert_allclose(after[0], block_means(straight[0], 2), atol=0.05)


def test_a_capture_s_own_xray_folder_is_found(tmp_path, write_xray):
    write_xray(tmp_path / "object" / "xray")
    assert bin_scan(tmp_path / "object", tmp_path / "small").projections == 24


def test_the_first_thing_that_is_wrong_is_named_and_nothing_is_written(tmp_path, write_xray):
    full = write_xray(tmp_path / "full")
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "work").write_text("a day's", "utf-8")
    (tmp_path / "empty").mkdir()
    (tmp_path / "naf").mkdir()
    (tmp_path / "naf" / "scan.pickle").write_bytes(b"")
    for arguments, error, says in (
        ((full, tmp_path / "small", 0), SettingError, "--by 0: give 1 or more"),
        ((full, tmp_path / "small", 4, -1), SettingError, "--every -1: give 1 or more"),
        ((full, tmp_path / "small", 10), SettingError, "--by 10: leaves 3 x 2 pixels of 32 x 28; give less"),
        ((full, tmp_path / "taken"), SettingError, "is not empty; choose another --out"),
        ((tmp_path / "nowhere", tmp_path / "small"), CaptureError, "nowhere: is not a folder"),
        ((tmp_path / "empty", tmp_path / "small"), CaptureError, "empty: is no scan that can be binned"),
        ((tmp_path / "naf", tmp_path / "small"), CaptureError, r"scan\.pickle: is no scan that can be binned"),
    ):
        with pytest.raises(error, match=says):
            bin_scan(*arguments)
    (full / "proj_train" / "0005.npy").write_bytes(b"broken")
    with pytest.raises(CaptureError, match=r"0005\.npy: cannot be read as \.npy"):
        bin_scan(full, tmp_path / "small")
    assert {path.name for path in tmp_path.iterdir()} == {"full", "taken", "empty", "naf"}


def test_it_can_be_stopped_and_leaves_nothing(tmp_path, write_xray):
    full, answers = write_xray(tmp_path / "full"), iter([False, False, False, True])
    with pytest.raises(Cancelled):
        bin_scan(full, tmp_path / "small", reporter=Reporter(is_cancelled=lambda: next(answers)))
    assert [path.name for path in tmp_path.iterdir()] == ["full"]


@pytest.mark.parametrize("dead", [False, True])
def test_progress_rises_from_nothing_whether_or_not_all_is_read_twice(full, tmp_path, with_spoiled, monkeypatch, dead):
    """A dead pixel is known to be one only when all projections were read."""
    pixels = np.zeros((28, 32), bool)
    pixels[13, 15] = dead
    with_spoiled(pixels)
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=itertools.count().__next__))
    told = []
    made = bin_scan(full, tmp_path / "small", reporter=Reporter(lambda one: told.append(one.fraction)))
    assert made.dead == dead
    assert told == sorted(told)
    assert told[0] == 0
    assert told[-1] == 1
    assert np.diff(told).max() < 1.01 / made.projections
    assert (len(told) > 2 * made.projections) == dead
