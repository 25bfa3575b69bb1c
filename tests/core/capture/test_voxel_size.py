"""The size of a volume's voxels is in mm, whatever unit its file has it in."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
import SimpleITK as sitk
import tifffile

from insideout.core.capture.volumes import read_volume
from insideout.core.errors import CaptureError

VALUES = np.linspace(0, 0.05, 120, dtype=np.float32).reshape(4, 5, 6)
# As Fiji's writer of NRRD has it.
FIJI = """NRRD0004
# Created by Nrrd_Writer at Mon
type: float
encoding: raw
endian: little
dimension: 3
sizes: 6 5 4
space dimension: 3
space directions: (20,0,0) (0,20,0) (0,0,30)
space units: {units}

"""


def header_with(path, line):
    """An image of ITK's with one more line in its header; in a .mha before the last one, which ends it."""
    image = sitk.GetImageFromArray(VALUES)
    image.SetSpacing((20.0, 20.0, 30.0))
    image.SetOrigin((200.0, 0.0, 0.0))
    sitk.WriteImage(image, str(path))
    before = b"ElementDataFile" if path.suffix == ".mha" else b"encoding:"
    path.write_bytes(path.read_bytes().replace(before, line.encode() + b"\n" + before, 1))


@pytest.mark.parametrize(
    ("unit", "mm"),
    [("micrometres", 1e-3), ("microns", 1e-3), ("µm", 1e-3), ("mm", 1.0), ("cm", 10.0), ("inch", 25.4), ("", 1.0)],
)
def test_fiji_s_nrrd_has_its_unit_in_the_header(tmp_path, unit, mm):
    units = " ".join([f'"{unit}"'] * 3)
    (tmp_path / "volume.nrrd").write_bytes(FIJI.format(units=units).encode("utf-8") + VALUES.tobytes())
    volume = read_volume(tmp_path / "volume.nrrd").volume
    assert volume.spacing_mm == pytest.approx(np.array([20, 20, 30]) * mm)
    assert np.array_equal(volume.values, VALUES)


@pytest.mark.parametrize(
    ("name", "line"), [("volume.mha", "DistanceUnits = um"), ("volume.nrrd", 'space units: "um" "um" "um"')]
)
def test_the_unit_of_a_header_scales_the_position_with_the_voxels(tmp_path, name, line):
    header_with(tmp_path / name, line)
    box = np.array([[0.19, -0.01, -0.015], [0.31, 0.09, 0.105]])
    volume = read_volume(tmp_path / name, box).volume
    assert volume.spacing_mm == pytest.approx([0.02, 0.02, 0.03])
    assert volume.origin_mm == pytest.approx([0.2, 0, 0])


def test_a_metaimage_that_knows_no_unit_is_in_mm(tmp_path):
    header_with(tmp_path / "volume.mha", "DistanceUnits = ?")
    assert read_volume(tmp_path / "volume.mha").volume.spacing_mm == pytest.approx([20, 20, 30])


def test_the_unit_of_axes_without_a_space(tmp_path):
    header = re.sub(r"space directions.*\nspace units.*", 'spacings: 20 20 30\nunits: "um" "um" "um"', FIJI)
    header = header.replace("space dimension: 3\n", "")
    (tmp_path / "volume.nrrd").write_bytes(header.encode() + VALUES.tobytes())
    assert read_volume(tmp_path / "volume.nrrd").volume.spacing_mm == pytest.approx([0.02, 0.02, 0.03])


def test_a_fourth_axis_may_have_a_unit_of_time(tmp_path):
    header = re.sub(r"space directions.*\nspace units.*", 'spacings: 20 20 30 1\nunits: "um" "um" "um" "s"', FIJI)
    header = (
        header.replace("space dimension: 3\n", "").replace("dimension: 3", "dimension: 4").replace("6 5 4", "6 5 4 1")
    )
    (tmp_path / "volume.nrrd").write_bytes(header.encode() + VALUES.tobytes())
    assert read_volume(tmp_path / "volume.nrrd").volume.spacing_mm == pytest.approx([0.02, 0.02, 0.03])


def test_a_note_called_units_is_none(tmp_path):
    header = FIJI.format(units='"mm" "mm" "mm"').replace("space units", 'units:="HU"\nspace units')
    (tmp_path / "volume.nrrd").write_bytes(header.encode() + VALUES.tobytes())
    assert read_volume(tmp_path / "volume.nrrd").volume.spacing_mm == pytest.approx([20, 20, 30])


@pytest.mark.parametrize("units", ['"pixel" "pixel" "pixel"', '"mm" "mm" "um"'])
def test_what_is_no_length_is_not_taken_for_mm(tmp_path, units):
    """Fiji calls voxels of unknown size 1 pixel large."""
    (tmp_path / "volume.nrrd").write_bytes(FIJI.format(units=units).encode() + VALUES.tobytes())
    with pytest.raises(CaptureError, match=r"which is no length known here; put a volume\.json beside it"):
        read_volume(tmp_path / "volume.nrrd")
    (tmp_path / "volume.json").write_text(json.dumps({"spacing_mm": [0.1, 0.2, 0.3]}))
    assert read_volume(tmp_path / "volume.nrrd").volume.spacing_mm == pytest.approx([0.1, 0.2, 0.3])


def test_voxels_that_look_like_a_line_of_the_header_are_none(tmp_path):
    looks = b'\nspace units: "um" "um" "um"\n'
    header = FIJI.format(units="").replace("space units: \n", "").replace("float", "uint8").encode()
    (tmp_path / "volume.nrrd").write_bytes(header + looks.ljust(VALUES.size, b"\0"))
    assert read_volume(tmp_path / "volume.nrrd").volume.spacing_mm == pytest.approx([20, 20, 30])


@pytest.mark.parametrize(
    ("unit", "stored", "mm"),
    [
        ("mm", "mm", 1.0),
        ("micron", "micron", 1e-3),
        ("µm", "\\u00B5m", 1e-3),
        ("cm", "cm", 10.0),
        ("inch", "inch", 25.4),
    ],
)
def test_imagej_s_unit(tmp_path, unit, stored, mm):
    notes = {"spacing": 0.75, "unit": stored}
    tifffile.imwrite(tmp_path / "volume.tif", VALUES, imagej=True, resolution=(2, 4), metadata=notes)
    assert read_volume(tmp_path / "volume.tif").volume.spacing_mm == pytest.approx(np.array([0.5, 0.25, 0.75]) * mm)


def test_imagej_leaves_out_that_slices_are_1_apart(tmp_path):
    tifffile.imwrite(tmp_path / "even.tif", VALUES, imagej=True, resolution=(1, 1), metadata={"unit": "mm"})
    result = read_volume(tmp_path / "even.tif")
    assert result.volume.spacing_mm == pytest.approx([1, 1, 1])
    assert not result.findings


def test_slices_that_may_be_1_apart_by_default_alone_are_pointed_out(tmp_path):
    """Whoever sets the size of pixels and forgets the depth gets such a file, too."""
    tifffile.imwrite(tmp_path / "volume.tif", VALUES, imagej=True, resolution=(10, 10), metadata={"unit": "micron"})
    result = read_volume(tmp_path / "volume.tif")
    assert result.volume.spacing_mm == pytest.approx([1e-4, 1e-4, 1e-3])
    (found,) = result.findings
    assert found.level == "warning"
    assert "says no distance of slices, by which ImageJ means 0.001 mm; its voxels are 0.0001 x 0.0001" in found.message
    (tmp_path / "volume.json").write_text(json.dumps({"spacing_mm": [1e-4, 1e-4, 1e-4]}))
    assert not read_volume(tmp_path / "volume.tif").findings


def test_imagej_s_pixels_are_no_length(tmp_path):
    notes = {"unit": "pixel", "spacing": 1.0}
    tifffile.imwrite(tmp_path / "volume.tif", VALUES, imagej=True, resolution=(1, 1), metadata=notes)
    with pytest.raises(CaptureError, match="has no voxel size"):
        read_volume(tmp_path / "volume.tif")
