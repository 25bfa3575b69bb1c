"""A folder of DICOM slices: its values, its voxels, which folder it is."""

from __future__ import annotations

import json
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk

from insideout.core.capture.listing import notes_path
from insideout.core.capture.volumes import MU_WATER_PER_MM, RELATIVE, find_volume, read_volume
from insideout.core.errors import CaptureError

POSITION, THICKNESS, BETWEEN, PIXEL_SPACING = (0x20, 0x32), (0x18, 0x50), (0x18, 0x88), (0x28, 0x30)
GREY = (40 * np.arange(120)).reshape(4, 5, 6).astype(np.int16)


def dicom(folder, stored, **tags):
    """A CT series of slices 3 mm apart, values (nz, ny, nx) as they count; tags such as `RescaleType`."""
    keys = {"RescaleIntercept": "0028|1052", "RescaleType": "0028|1054", "ImageOrientationPatient": "0020|0037"}
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


@pytest.mark.parametrize("tilt", [-20.0, 0.0, 5.0, 20.0])
def test_slices_of_a_tilted_gantry_are_stacked_as_they_lie(tmp_path, tilt):
    """A bar along the patient's axis: sheared, it leaned by the tilt, and was too short by its cosine."""
    cos, sin = np.cos(np.radians(tilt)), np.sin(np.radians(tilt))
    stored = np.full((20, 20, 30), -1000, np.int16)
    stored[:, 9:12, 14:17] = 1000
    dicom(tmp_path / "scan", stored, ImageOrientationPatient=f"1\\0\\0\\0\\{cos:.8f}\\{-sin:.8f}")
    read = read_volume(find_volume(tmp_path))
    volume = read.volume
    dense = np.where(volume.values > MU_WATER_PER_MM, volume.values, 0)
    height = dense.sum(axis=(1, 2))
    inside = np.flatnonzero(height > 0.9 * height.max())
    rows = dense.sum(axis=2)[inside] @ np.arange(dense.shape[1]) / height[inside]
    assert volume.spacing_mm == pytest.approx([1, 2, 3])
    assert np.ptp(rows) < 0.1
    assert np.count_nonzero(height > 0.5 * height.max()) == pytest.approx(20, abs=1)
    assert not any("evenly" in finding.message for finding in read.findings)


def test_of_two_series_the_one_with_more_slices_is_taken_however_many_files_it_has(tmp_path):
    """A scout of two images, and an export of all slices in one file."""
    dicom(tmp_path / "scan", GREY[:2])
    image = sitk.GetImageFromArray((np.arange(40 * 64) % 999).reshape(40, 8, 8).astype(np.int16))
    for key, value in {"0008|0060": "CT", "0020|000e": "1.2.4", "0020|000d": "1.2"}.items():
        image.SetMetaData(key, value)
    writer = sitk.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    writer.SetFileName(str(tmp_path / "scan" / "all.dcm"))
    writer.Execute(image)
    read = read_volume(find_volume(tmp_path))
    assert read.volume.values.shape == (40, 8, 8)
    assert read.files == [tmp_path / "scan" / "all.dcm"]
    assert any("1 other DICOM series, not used" in finding.message for finding in read.findings)


@pytest.mark.parametrize(("inside", "place"), [("scan", "."), ("scan/deeper", "..")])
def test_the_folder_one_stands_in_has_its_notes_beside_it(tmp_path, monkeypatch, inside, place):
    dicom(tmp_path / "scan", GREY)
    (tmp_path / "scan.json").write_text(json.dumps({"spacing_mm": [1, 2, 4]}))
    (tmp_path / inside).mkdir(exist_ok=True)
    monkeypatch.chdir(tmp_path / inside)
    assert np.allclose(read_volume(find_volume(Path(place))).volume.spacing_mm, [1, 2, 4])


def test_a_disc_has_its_notes_on_it():
    root = Path(Path.cwd().anchor)
    assert notes_path(root) == root / "volume.json"


def test_the_notes_of_a_linked_folder_lie_beside_the_link(tmp_path):
    (tmp_path / "far").mkdir()
    (tmp_path / "xray").symlink_to(tmp_path / "far", target_is_directory=True)
    assert notes_path(tmp_path / "xray") == tmp_path / "xray.json"


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
