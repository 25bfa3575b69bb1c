"""A stack in one .tif: all of its images, as ImageJ shows them, or what is wrong with it."""

from __future__ import annotations

import json
import lzma
import struct
import zlib

import numpy as np
import pytest
import tifffile

from insideout.core.capture.projections import find_projections, read_projections
from insideout.core.capture.tiff import read_image, read_stack
from insideout.core.capture.volumes import MU_WATER_PER_MM, read_volume
from insideout.core.errors import CaptureError

HOUNSFIELD = np.linspace(-1000, 2000, 10 * 24 * 32).reshape(10, 24, 32).astype(np.int16)
STORED = (HOUNSFIELD.astype(np.int32) + 32768).astype(np.uint16)


def imagej(path, stored=STORED, **notes):
    notes = {"spacing": 0.75, "unit": "mm", **notes}
    tifffile.imwrite(path, stored, imagej=True, resolution=(2, 4), metadata=notes)


@pytest.mark.parametrize("unit", [None, "HU"])
def test_signed_values_of_imagej_are_those_that_it_shows(tmp_path, unit):
    """Stored 32768 higher, air attenuated 33 times as much as water."""
    imagej(tmp_path / "volume.tif", cf=0, c0=-32768.0, c1=1.0, vunit="HU")
    (tmp_path / "volume.json").write_text(json.dumps({"unit": unit}))
    read = read_volume(tmp_path / "volume.tif")
    assert np.allclose(read.volume.values, MU_WATER_PER_MM * (1 + HOUNSFIELD / 1000), atol=1e-6)
    assert not read.findings


def test_imagej_s_line_may_have_any_slope(tmp_path):
    imagej(tmp_path / "volume.tif", cf=0, c0=-0.5, c1=0.25)
    assert np.array_equal(read_stack(tmp_path / "volume.tif").values, 0.25 * STORED.astype(np.float32) - 0.5)


@pytest.mark.parametrize("notes", [{"cf": 1, "c0": 1.0, "c1": 2.0, "c2": 3.0}, {"cf": 21}, {"cf": 0, "c1": 0.0}])
def test_a_curve_of_imagej_is_said_not_to_be_used(tmp_path, notes):
    imagej(tmp_path / "volume.tif", **notes)
    stack = read_stack(tmp_path / "volume.tif")
    assert np.array_equal(stack.values, STORED)
    (found,) = stack.findings
    assert "calibration of its values that is not a straight line; it is not used" in found.message


@pytest.mark.parametrize("notes", [{}, {"cf": 20}])
def test_values_without_a_calibration_are_as_stored(tmp_path, notes):
    imagej(tmp_path / "volume.tif", **notes)
    stack = read_stack(tmp_path / "volume.tif")
    assert stack.values.dtype == STORED.dtype
    assert np.array_equal(stack.values, STORED)
    assert not stack.findings


def test_floats_have_no_calibration_in_imagej_either(tmp_path):
    imagej(tmp_path / "volume.tif", HOUNSFIELD.astype(np.float32), cf=0, c0=-32768.0, c1=1.0)
    assert np.array_equal(read_stack(tmp_path / "volume.tif").values, HOUNSFIELD)


def test_images_that_were_written_one_by_one_are_one_stack(tmp_path):
    with tifffile.TiffWriter(tmp_path / "volume.tif") as writer:
        for image in STORED:
            writer.write(image)
    (tmp_path / "volume.json").write_text(json.dumps({"spacing_mm": [1, 1, 1], "unit": "grey"}))
    assert np.array_equal(read_stack(tmp_path / "volume.tif").values, STORED)
    assert read_volume(tmp_path / "volume.tif").volume.values.shape == STORED.shape


def test_images_of_two_sizes_are_no_stack(tmp_path):
    with tifffile.TiffWriter(tmp_path / "volume.tif") as writer:
        writer.write(STORED[0])
        writer.write(STORED[0, ::2, ::2])
    assert read_stack(tmp_path / "volume.tif").values.shape == STORED[0].shape


@pytest.mark.parametrize("share", [0.3, 0.9])
def test_a_stack_that_is_cut_short_is_told(tmp_path, share):
    imagej(tmp_path / "whole.tif")
    whole = (tmp_path / "whole.tif").read_bytes()
    (tmp_path / "volume.tif").write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(CaptureError, match=r"volume\.tif: is cut short: 1 of its 10 images are there; copy it again"):
        read_volume(tmp_path / "volume.tif")


FAULTS = [zlib.error, lzma.LZMAError, struct.error, TypeError, ZeroDivisionError, IndexError, KeyError, AssertionError]


@pytest.mark.parametrize("fault", FAULTS)
def test_whatever_a_damaged_file_raises_is_told(tmp_path, monkeypatch, fault):
    imagej(tmp_path / "a.tif")

    def fail(*_, **__):
        raise fault("odd")

    monkeypatch.setattr(tifffile.TiffFile, "asarray", fail)
    for read in (read_image, read_stack):
        with pytest.raises(CaptureError, match=r"a\.tif: cannot be read as .*odd"):
            read(tmp_path / "a.tif")


def damaged(path, image):
    """A compressed .tif, of whose numbers a few bytes are others."""
    tifffile.imwrite(path, image, compression="zlib", photometric="minisblack", metadata=None)
    with tifffile.TiffFile(path) as file:
        start = file.pages.first.dataoffsets[0]
    content = bytearray(path.read_bytes())
    content[start + 8 : start + 24] = bytes(255 - value for value in content[start + 8 : start + 24])
    path.write_bytes(content)


def test_a_damaged_compressed_stack_is_told(tmp_path):
    damaged(tmp_path / "volume.tif", STORED)
    (tmp_path / "volume.json").write_text(json.dumps({"spacing_mm": [1, 1, 1]}))
    with pytest.raises(CaptureError, match=r"volume\.tif: cannot be read as a \.tif stack"):
        read_volume(tmp_path / "volume.tif")


def test_a_damaged_compressed_projection_is_told(tmp_path):
    sizes = "SrcToObject=60\nSrcToDetector=90\nDetectorPixelsX=32\nDetectorPixelsY=24\n"
    pitch = "DetectorPixelSizeX=1\nDetectorPixelSizeY=1\nProjections=2\nAngularStep=180\n"
    (tmp_path / "a.xtekct").write_text("[XTekCT]\n" + sizes + pitch)
    tifffile.imwrite(tmp_path / "a_1.tif", STORED[0])
    damaged(tmp_path / "a_2.tif", STORED[1])
    with pytest.raises(CaptureError, match=r"a_2\.tif: cannot be read as \.tif .*; copy it again from the scanner"):
        read_projections(find_projections(tmp_path))
