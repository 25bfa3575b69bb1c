"""A folder of DICOM slices: its values, its voxels, which folder it is."""

from __future__ import annotations

import json
import shutil
import struct

import numpy as np
import pytest
import SimpleITK as sitk

from insideout.core.capture.volumes import MU_WATER_PER_MM, RELATIVE, find_volume, read_volume
from insideout.core.errors import CaptureError

POSITION, THICKNESS, BETWEEN, PIXEL_SPACING = (0x20, 0x32), (0x18, 0x50), (0x18, 0x88), (0x28, 0x30)
GREY = (40 * np.arange(120)).reshape(4, 5, 6).astype(np.int16)


def dicom(folder, stored, **tags):
    """A CT series of slices 3 mm apart, values (nz, ny, nx) as they count; tags such as `RescaleType`."""
    keys = {"RescaleIntercept": "0028|1052", "RescaleType": "0028|1054"}
    writer = sitk.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    folder.mkdir(parents=True, exist_ok=True)
    for index in range(len(stored)):
        piece = sitk.GetImageFromArray(stored[index : index + 1])[:, :, 0]
        piece.SetSpacing([1.0, 2.0])
        known = {"0008|0060": "CT", "0020|000e": "1.2.3", "0020|000d": "1.2", "0020|0013": str(index)}
        known |= {"0020|0032": f"0\\0\\{index * 3}", "0020|0037": "1\\0\\0\\0\\1\\0", "0018|0050": "3"}
        known |= {"0008|0018": f"1.2.3.{index}", "0028|1052": "0", "0028|1053": "1"}
        known |= {keys[name]: value for name, value in tags.items()}
        for key, value in known.items():
            piece.SetMetaData(key, value)
        writer.SetFileName(str(folder / f"{index}.dcm"))
        writer.Execute(piece)


def test_dicom_slices_are_hounsfield_units(tmp_path, values):
    stored = np.round((values / MU_WATER_PER_MM - 1) * 1000).astype(np.int16)
    dicom(tmp_path / "scan", stored, RescaleType="HU")
    result = read_volume(find_volume(tmp_path))
    assert np.allclose(result.volume.spacing_mm, [1, 2, 3])
    assert np.allclose(result.volume.values, values, atol=2e-5)
    assert len(result.files) == 4
    assert "Hounsfield" in result.meaning.message


@pytest.mark.parametrize(
    ("low", "tags", "hounsfield"),
    [
        (0, {}, False),
        (0, {"RescaleType": "US"}, False),
        (0, {"RescaleType": "HU"}, True),
        (0, {"RescaleIntercept": "-1024"}, True),
        (-20, {}, False),
        (-1000, {}, True),
        (-32768, {"RescaleIntercept": "-32768"}, False),
        (-300, {"RescaleIntercept": "-300", "RescaleType": "mg/ccm"}, False),
    ],
)
def test_dicom_slices_of_ct_that_show_no_hounsfield_units_are_grey_values(tmp_path, low, tags, hounsfield):
    """As micro and industrial CT leaves them, with noise about 0."""
    dicom(tmp_path / "scan", (low + 40 * np.arange(120)).reshape(4, 5, 6).astype(np.int16), **tags)
    result = read_volume(find_volume(tmp_path))
    assert ("Hounsfield" in result.meaning.message) == hounsfield
    assert (RELATIVE in result.meaning.message) == (not hounsfield)
    assert result.unit_known == hounsfield


@pytest.mark.parametrize(("unit", "factor"), [("HU", MU_WATER_PER_MM / 1000), ("1/cm", 0.1)])
def test_notes_beside_dicom_slices_say_what_their_values_are(tmp_path, unit, factor):
    grey = (40 * np.arange(120)).reshape(4, 5, 6).astype(np.int16)
    dicom(tmp_path / "scan", grey)
    (tmp_path / "scan.json").write_text(json.dumps({"unit": unit}))
    result = read_volume(find_volume(tmp_path))
    assert result.unit_known
    assert np.ptp(result.volume.values) == pytest.approx(factor * np.ptp(grey))


def test_the_index_of_a_disc_is_no_slice(tmp_path, values):
    dicom(tmp_path / "disc" / "S1", np.round((values / MU_WATER_PER_MM - 1) * 1000).astype(np.int16))
    shutil.copy(tmp_path / "disc" / "S1" / "0.dcm", tmp_path / "disc" / "DICOMDIR")
    assert find_volume(tmp_path / "disc") == tmp_path / "disc" / "S1"


def test_of_two_folders_of_slices_none_is_taken(tmp_path, values):
    """The first by name may be the scout."""
    for name in ("S1", "S2"):
        dicom(tmp_path / name, np.round((values / MU_WATER_PER_MM - 1) * 1000).astype(np.int16))
    with pytest.raises(CaptureError, match="several folders of DICOM slices: S1, S2; keep the one"):
        find_volume(tmp_path)


def change(folder, tag, value=None):
    """Another value of an element of each slice, or none; ITK writes them as tag, length, value."""
    for path in folder.glob("*.dcm"):
        content = path.read_bytes()
        start = content.index(struct.pack("<HH", *tag))
        (length,) = struct.unpack("<I", content[start + 4 : start + 8])
        new = b"" if value is None else content[start : start + 4] + struct.pack("<I", len(value)) + value.encode()
        path.write_bytes(content[:start] + new + content[start + 8 + length :])


@pytest.mark.parametrize(("between", "apart"), [(None, 3.0), ("2.50", 2.5)])
def test_slices_without_a_position_are_as_far_apart_as_they_say_otherwise(tmp_path, between, apart):
    dicom(tmp_path / "scan", GREY)
    change(tmp_path / "scan", POSITION)
    change(tmp_path / "scan", BETWEEN, between)
    result = read_volume(find_volume(tmp_path))
    assert np.allclose(result.volume.spacing_mm, [1, 2, apart])
    assert any(f"no position; {apart:g} mm apart was taken" in finding.message for finding in result.findings)
    (tmp_path / "scan.json").write_text(json.dumps({"spacing_mm": [1, 2, 4]}))
    result = read_volume(find_volume(tmp_path))
    assert np.allclose(result.volume.spacing_mm, [1, 2, 4])
    assert not any("no position" in finding.message for finding in result.findings)


def test_slices_all_at_one_position_have_none(tmp_path):
    """As some exports of screenshots leave them."""
    dicom(tmp_path / "scan", GREY)
    change(tmp_path / "scan", POSITION, "0\\0\\7 ")
    change(tmp_path / "scan", BETWEEN)
    assert np.allclose(read_volume(find_volume(tmp_path)).volume.spacing_mm, [1, 2, 3])


@pytest.mark.parametrize("missing", [(POSITION, THICKNESS, BETWEEN), (PIXEL_SPACING,)], ids=["apart", "pixels"])
def test_slices_without_a_size_are_not_taken_for_1_mm(tmp_path, missing):
    dicom(tmp_path / "scan", GREY)
    for tag in missing:
        change(tmp_path / "scan", tag)
    with pytest.raises(CaptureError, match=r"scan: has no voxel size; put a scan\.json beside it"):
        read_volume(find_volume(tmp_path))
    (tmp_path / "scan.json").write_text(json.dumps({"spacing_mm": [1, 2, 4]}))
    assert np.allclose(read_volume(find_volume(tmp_path)).volume.spacing_mm, [1, 2, 4])


def test_hidden_files_of_a_mac_do_not_hide_the_slices(tmp_path):
    dicom(tmp_path / "scan", GREY)
    for index in range(30):
        (tmp_path / "scan" / f"._{index}.dcm").write_bytes(b"\0\5\x16\7")
    assert len(read_volume(find_volume(tmp_path)).files) == len(GREY)
