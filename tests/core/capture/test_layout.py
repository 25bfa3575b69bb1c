"""Half of a capture that lies where nobody looks is not left out without a word."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
import tifffile
from PIL import Image

from insideout.core.capture.check import check_capture
from insideout.core.capture.read import read_capture


def volume(folder, values):
    folder.mkdir(parents=True, exist_ok=True)
    sitk.WriteImage(sitk.GetImageFromArray(values), str(folder / "scan.nii.gz"))


def pictures(folder, count=3, suffix="jpg"):
    folder.mkdir(parents=True, exist_ok=True)
    for index in range(count):
        Image.new("RGB", (40, 30), (80 * index, 90, 90)).save(folder / f"IMG_{index}.{suffix}")


def warned(folder, words):
    return [found for found in check_capture(folder) if found.level == "warning" and words in found.message]


@pytest.mark.parametrize("name", ["CT", "x-ray", "scan"])
@pytest.mark.parametrize("kind", ["volume", "projections", "two volumes"])
@pytest.mark.parametrize("photos", ["photos", "."])
def test_x_rays_in_a_folder_of_another_name_are_pointed_out(tmp_path, values, write_xray, name, kind, photos):
    pictures(tmp_path / photos)
    if kind == "projections":
        write_xray(tmp_path / name)
    else:
        volume(tmp_path / name, values)
    if kind == "two volumes":
        sitk.WriteImage(sitk.GetImageFromArray(values), str(tmp_path / name / "other.nrrd"))
    (found,) = warned(tmp_path, "holds X-rays that are not read")
    assert found.subject == str(tmp_path / name)
    assert "rename it to xray/" in found.advice


def test_photos_beside_a_volume_are_pointed_out(tmp_path, values):
    pictures(tmp_path)
    volume(tmp_path, values)
    (found,) = warned(tmp_path, "3 images (IMG_0.jpg, IMG_1.jpg and 1 more) are not read")
    assert "put them into photos/" in found.advice
    assert read_capture(tmp_path).volume is not None


@pytest.mark.parametrize("xray", ["xray", "."])
def test_photos_in_a_folder_of_another_name_are_pointed_out(tmp_path, values, xray):
    pictures(tmp_path / "Fotos")
    volume(tmp_path / xray, values)
    (found,) = warned(tmp_path, "holds 3 images that are not read")
    assert found.subject == str(tmp_path / "Fotos")
    assert "rename it to photos/" in found.advice


def test_what_is_no_half_of_a_capture_is_not(tmp_path, values):
    """Projections, a picture of the scanner's settings, a run, masks; and all else where both halves are there."""
    only_xrays, only_photos, both = (tmp_path / name for name in ("x", "p", "b"))
    volume(only_xrays, values)
    pictures(only_xrays, 1)
    for name in ("masks", ".cache", "proj_train", "run"):
        pictures(only_xrays / name)
    (only_xrays / "run" / "capture.json").write_text("{}")
    for index in range(3):
        tifffile.imwrite(only_xrays / f"slice_{index}.tif", np.zeros((8, 8), np.uint16))
    pictures(only_photos / "photos")
    volume(only_photos / "run", values)
    (only_photos / "run" / "capture.json").write_text("{}")
    pictures(both / "photos")
    pictures(both / "more")
    volume(both / "xray", values)
    volume(both / "CT", values)
    for folder in (only_xrays, only_photos, both):
        assert not warned(folder, "not read")


def test_a_folder_that_nobody_may_look_into_is_passed_over(tmp_path, values, monkeypatch):
    """As `lost+found` of a disk, to whose first folder a scan was written."""
    sitk.WriteImage(sitk.GetImageFromArray(values), str(tmp_path / "scan.nii.gz"))
    (tmp_path / "lost+found").mkdir()
    usual = Path.is_file

    def is_file(path):
        if path.parent.name == "lost+found":
            raise PermissionError(13, "Permission denied", str(path))
        return usual(path)

    monkeypatch.setattr(Path, "is_file", is_file)
    assert read_capture(tmp_path).volume is not None
    assert not [one for one in check_capture(tmp_path) if "lost+found" in str(one.subject)]
