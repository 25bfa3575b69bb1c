"""A user's volume becomes attenuation in mm⁻¹ where the projections are."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
import tifffile

from insideout.core.capture.volumes import MU_WATER_PER_MM, RELATIVE, find_volume, read_volume
from insideout.core.densities import Densities
from insideout.core.errors import CaptureError
from insideout.core.volume import Volume


def itk(array, spacing=(1.0, 2.0, 3.0), origin=(0.0, 0.0, 0.0), direction=None):
    image = sitk.GetImageFromArray(array)
    image.SetSpacing(spacing)
    image.SetOrigin(origin)
    if direction is not None:
        image.SetDirection(direction)
    return image


@pytest.mark.parametrize("name", ["volume.mha", "volume.nrrd", "volume.nii.gz"])
def test_medical_formats(tmp_path, values, name):
    sitk.WriteImage(itk(values), str(tmp_path / name))
    volume = read_volume(find_volume(tmp_path)).volume
    assert np.allclose(volume.spacing_mm, [1, 2, 3])
    assert np.allclose(volume.box_mm, [[-3, -5, -6], [3, 5, 6]])
    assert np.allclose(volume.values, values, atol=1e-6)


def test_a_raw_volume_with_the_header_that_the_docs_give(tmp_path):
    page = (Path(__file__).resolve().parents[3] / "docs" / "captures.md").read_text("utf-8")
    header = re.search(r"^ObjectType = Image\n(?:.+ = .+\n)+", page, re.M).group(0)
    grid = np.arange(4 * 5 * 6, dtype="<u2").reshape(4, 5, 6)
    (tmp_path / "volume.mhd").write_text(re.sub(r"DimSize = .*", "DimSize = 6 5 4", header), "utf-8")
    (tmp_path / "volume.raw").write_bytes(grid.tobytes())
    read = read_volume(find_volume(tmp_path))
    assert read.volume.spacing_mm == pytest.approx([0.4, 0.4, 0.4])
    assert np.corrcoef(read.volume.values.ravel(), grid.ravel())[0, 1] > 0.999
    assert {path.name for path in read.files} == {"volume.mhd", "volume.raw"}


@pytest.mark.parametrize(("header", "voxels"), [("volume.mhd", "of march.bin"), ("volume.nhdr", "of march.raw.gz")])
def test_voxels_in_a_file_of_any_name_count_as_the_volume_s(header, voxels, tmp_path, values):
    """Exported again, with the same header, they are another capture."""
    sitk.WriteImage(itk(values), str(tmp_path / header), header.endswith(".nhdr"))
    (beside,) = set(tmp_path.iterdir()) - {tmp_path / header}
    text = (tmp_path / header).read_text("utf-8")
    (tmp_path / header).write_text(text.replace(beside.name, f"./{voxels}"), "utf-8")
    beside.rename(tmp_path / voxels)
    (tmp_path / "of april.bin").touch()
    assert read_volume(find_volume(tmp_path)).files == [tmp_path / header, tmp_path / voxels]


def test_a_turned_volume_is_turned_back_and_never_mirrored(tmp_path, values):
    # Stored with x and y pointing the other way, as NIfTI files often are.
    turned = itk(values[:, ::-1, ::-1].copy(), direction=(-1, 0, 0, 0, -1, 0, 0, 0, 1))
    sitk.WriteImage(turned, str(tmp_path / "volume.mha"))
    assert np.allclose(read_volume(tmp_path / "volume.mha").volume.values, values)


def test_an_oblique_volume_is_resampled_along_the_axes(tmp_path):
    rows = np.zeros((12, 12, 12), np.float32)
    rows[5:7, 5:7, 5:7] = 0.05
    cos, sin = np.cos(0.3), np.sin(0.3)
    sitk.WriteImage(itk(rows, (1, 1, 1), direction=(cos, -sin, 0, sin, cos, 0, 0, 0, 1)), str(tmp_path / "volume.mha"))
    volume = read_volume(tmp_path / "volume.mha").volume
    assert volume.values.sum() == pytest.approx(rows.sum(), rel=0.1)
    assert volume.sample(np.zeros(3)) > 0.02


def test_hounsfield_units_are_recognised_and_water_is_adjustable(tmp_path):
    values = np.full((3, 3, 3), -1024, np.int16)
    values[1, 1, 1] = 1000
    np.savez(tmp_path / "volume.npz", volume=values, spacing_mm_zyx=[1.5, 1, 1])
    volume = read_volume(tmp_path / "volume.npz").volume
    assert volume.values[1, 1, 1] == pytest.approx(2 * MU_WATER_PER_MM)
    assert volume.values[0, 0, 0] == 0
    assert np.allclose(volume.spacing_mm, [1, 1, 1.5])
    (tmp_path / "volume.json").write_text(json.dumps({"mu_water_per_mm": 0.03}))
    assert read_volume(tmp_path / "volume.npz").volume.values[1, 1, 1] == pytest.approx(0.06)


@pytest.mark.parametrize("water", [0, -0.0195])
def test_water_that_attenuates_nothing_is_refused(tmp_path, values, water):
    np.savez(tmp_path / "volume.npz", volume=values, spacing_mm_zyx=[1, 1, 1])
    (tmp_path / "volume.json").write_text(json.dumps({"unit": "HU", "mu_water_per_mm": water}))
    with pytest.raises(CaptureError, match=r"volume\.json: 'mu_water_per_mm' is .*; give a value above zero"):
        read_volume(tmp_path / "volume.npz")


@pytest.mark.parametrize(("water", "odd"), [(0.195, True), (0.0071, True), (0.0376, False), (0.0147, False)])
def test_water_as_no_beam_has_it_is_pointed_out(tmp_path, values, water, odd):
    np.savez(tmp_path / "volume.npz", volume=values, spacing_mm_zyx=[1, 1, 1])
    (tmp_path / "volume.json").write_text(json.dumps({"unit": "HU", "mu_water_per_mm": water}))
    warnings = [found for found in read_volume(tmp_path / "volume.npz").findings if found.level == "warning"]
    assert any("but water has 0.01 to 0.05 mm⁻¹" in found.message for found in warnings) == odd


def test_grey_values_are_scaled_and_said_to_be_relative(tmp_path):
    grey = np.arange(1000, dtype=np.uint16).reshape(10, 10, 10)
    np.savez(tmp_path / "volume.npz", volume=grey, spacing_mm_zyx=[1, 1, 1])
    result = read_volume(tmp_path / "volume.npz")
    assert result.volume.values.max() == pytest.approx(0.05, rel=0.01)
    assert result.meaning.level == "warning"
    assert RELATIVE in result.meaning.message
    assert not result.unit_known


@pytest.mark.parametrize("stray", [-400, -600])
@pytest.mark.parametrize("noise", [0, 60])
def test_a_stray_voxel_below_air_makes_no_other_values_of_all(tmp_path, stray, noise):
    """An overshoot of a filter made Hounsfield units of them, or a fog of the air."""
    grey = np.random.default_rng(0).normal(0, noise, (12, 12, 12)).astype(np.float32)
    grey[4:8, 4:8, 4:8] += 1000
    grey[0, 0, 0] = stray
    np.savez(tmp_path / "volume.npz", volume=grey, spacing_mm_zyx=[1, 1, 1])
    result = read_volume(tmp_path / "volume.npz")
    values = result.volume.values
    assert RELATIVE in result.meaning.message
    assert values[0, 0, 0] == values.min() == 0
    assert np.median(values[4:8, 4:8, 4:8]) == pytest.approx(0.05, rel=0.2)
    assert np.median(values) < 1e-3


def test_grey_values_have_no_attenuation_where_they_have_least(tmp_path):
    grey = np.full((12, 12, 12), 9000, np.uint16)
    grey[4:8, 4:8, 4:8] = 30000
    grey[0, 0, 0] = 0
    np.savez(tmp_path / "volume.npz", volume=grey, spacing_mm_zyx=[1, 1, 1])
    values = read_volume(tmp_path / "volume.npz").volume.values
    assert values[1, 1, 1] == values[0, 0, 0] == 0
    assert values[5, 5, 5] == pytest.approx(0.05)


def test_the_volume_of_a_run_tells_what_its_own_scan_s_values_were(tmp_path, values):
    """Given to another capture, grey values have got no unit, and Hounsfield units have their water."""
    volume = Volume.centered(values, np.ones(3))
    volume.save(tmp_path / "volume.npz", Densities(relative=True))
    again = read_volume(tmp_path / "volume.npz")
    assert RELATIVE in again.meaning.message
    assert again.densities == Densities(relative=True)
    assert not again.unit_known
    volume.save(tmp_path / "volume.npz", Densities(water_per_mm=0.0206))
    again = read_volume(tmp_path / "volume.npz")
    assert again.densities == Densities(water_per_mm=0.0206)
    assert np.allclose(again.volume.values, values)
    (tmp_path / "volume.json").write_text(json.dumps({"unit": "1/cm"}))
    assert read_volume(tmp_path / "volume.npz").densities == Densities(), "of other values than the run's"


@pytest.mark.parametrize("water", [-1.0, np.nan, "much", [0.02, 0.02]])
def test_what_is_no_water_is_passed_over(tmp_path, values, water):
    np.savez(tmp_path / "volume.npz", volume=values, spacing_mm_zyx=[1, 1, 1], unit="1/mm", water_per_mm=water)
    assert read_volume(tmp_path / "volume.npz").densities == Densities()


@pytest.mark.parametrize(("unit", "factor"), [("1/mm", 1.0), ("1/cm", 0.1)])
def test_a_unit_in_the_notes_is_believed(tmp_path, values, unit, factor):
    np.save(tmp_path / "volume.npy", values * 100)
    (tmp_path / "volume.json").write_text(json.dumps({"spacing_mm": [1, 2, 3], "unit": unit}))
    result = read_volume(find_volume(tmp_path))
    assert np.allclose(result.volume.values, values * 100 * factor)
    assert {path.name for path in result.files} == {"volume.npy", "volume.json"}


def test_a_wrong_unit_is_blamed_on_the_file_that_says_it(tmp_path, values):
    np.savez(tmp_path / "volume.npz", volume=values, spacing_mm_zyx=[1, 1, 1], unit="inch")
    with pytest.raises(CaptureError, match=r"volume\.npz: 'unit' is 'inch'; say \"unit\" .* in volume\.json"):
        read_volume(tmp_path / "volume.npz")
    (tmp_path / "volume.json").write_text(json.dumps({"unit": "foot"}))
    with pytest.raises(CaptureError, match=r"volume\.json: 'unit' is 'foot'"):
        read_volume(tmp_path / "volume.npz")
    (tmp_path / "volume.json").write_text(json.dumps({"unit": "1/cm"}))
    assert np.allclose(read_volume(tmp_path / "volume.npz").volume.values, values / 10)


def test_imagej_stacks_bring_their_voxel_size(tmp_path, values):
    tifffile.imwrite(
        tmp_path / "volume.tif", values, imagej=True, resolution=(2, 4), metadata={"spacing": 0.75, "unit": "mm"}
    )
    assert np.allclose(read_volume(find_volume(tmp_path)).volume.spacing_mm, [0.5, 0.25, 0.75])


def test_the_files_own_position_is_kept_where_it_lines_up_with_the_projections(tmp_path, values):
    sitk.WriteImage(itk(values, origin=(-2.5, -4.0, -4.0)), str(tmp_path / "near.mha"))
    sitk.WriteImage(itk(values, origin=(90.0, 50.0, 30.0)), str(tmp_path / "far.mha"))
    box = np.array([[-3.0, -5, -6], [3, 5, 6]])
    assert np.allclose(read_volume(tmp_path / "near.mha", box).volume.origin_mm, [-2.5, -4, -4])
    assert np.allclose(read_volume(tmp_path / "far.mha", box).volume.origin_mm, [-2.5, -4, -4.5])


def test_a_volume_without_a_position_lies_in_the_middle_of_a_box_that_is_off_the_origin(tmp_path, values):
    sitk.WriteImage(itk(values, origin=(90.0, 50.0, 30.0)), str(tmp_path / "far.mha"))
    box = np.array([[-3.0, -3, 2], [3, 7, 14]])
    result = read_volume(tmp_path / "far.mha", box)
    assert np.allclose(result.volume.box_mm, box)
    assert not any("projections' box" in finding.message for finding in result.findings)


def test_a_lone_archive_says_what_it_lacks(tmp_path, values):
    np.savez(tmp_path / "head.npz", values)
    assert find_volume(tmp_path) is None, "without a folder for X-rays it may be anything"
    with pytest.raises(CaptureError, match=r"head\.npz: lacks 'volume'"):
        read_volume(find_volume(tmp_path, lone_array=True))


def test_hidden_files_of_a_mac_are_no_volumes(tmp_path, values):
    sitk.WriteImage(itk(values), str(tmp_path / "head.nii.gz"))
    (tmp_path / "._head.nii.gz").write_bytes(b"\0\5\x16\7")
    assert find_volume(tmp_path) == tmp_path / "head.nii.gz"


def test_a_volume_of_another_size_than_the_projections_is_pointed_out(tmp_path, values):
    sitk.WriteImage(itk(values), str(tmp_path / "volume.mha"))
    result = read_volume(tmp_path / "volume.mha", 10 * np.array([[-3.0, -5, -6], [3, 5, 6]]))
    assert any("projections' box" in finding.message for finding in result.findings)


def test_a_position_given_as_the_worlds_is_kept(tmp_path, values):
    np.savez(tmp_path / "volume.npz", volume=values, spacing_mm_zyx=[1, 1, 1], origin_mm_zyx=[7, 8, 9])
    assert np.allclose(read_volume(tmp_path / "volume.npz").volume.origin_mm, [9, 8, 7])


def test_a_volume_without_voxel_size_asks_for_it(tmp_path, values):
    np.save(tmp_path / "volume.npy", values)
    with pytest.raises(CaptureError, match=r"volume\.npy: has no voxel size; put a volume\.json beside it"):
        read_volume(find_volume(tmp_path))
    np.savez(tmp_path / "archive.npz", values)
    (tmp_path / "archive.npz").replace(tmp_path / "named.npy")
    (tmp_path / "named.json").write_text(json.dumps({"spacing_mm": [1, 1, 1]}))
    with pytest.raises(CaptureError, match=r"named\.npy: is an \.npz; export it as \.npy"):
        read_volume(tmp_path / "named.npy")
    (tmp_path / "volume.npy").replace(tmp_path / "named.npz")
    with pytest.raises(CaptureError, match=r"named\.npz: is an \.npy; export it as \.npz"):
        read_volume(tmp_path / "named.npz")
    tifffile.imwrite(tmp_path / "scan.tif", values, photometric="minisblack")
    with pytest.raises(CaptureError, match=r"scan\.tif: has no voxel size; put a scan\.json beside it"):
        read_volume(tmp_path / "scan.tif")
    np.savez(tmp_path / "scan.npz", volume=values)
    with pytest.raises(CaptureError, match=r"scan\.npz: has no voxel size"):
        read_volume(tmp_path / "scan.npz")


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ({"volume": np.full((3, 3, 3), np.nan)}, "holds NaN"),
        ({"volume": np.zeros((3, 3, 3))}, "is 0.0 everywhere"),
        ({"volume": np.zeros((3, 3))}, "not a 3D volume"),
        ({"volume": np.eye(3)[None] * np.ones((3, 1, 1)), "spacing_mm_zyx": [1, 0, 1]}, "has voxel size"),
        ({"other": np.zeros(3)}, "lacks 'volume'"),
    ],
)
def test_wrong_volumes_are_explained(tmp_path, content, says):
    np.savez(tmp_path / "volume.npz", **{"spacing_mm_zyx": [1, 1, 1], **content})
    with pytest.raises(CaptureError, match=says):
        read_volume(tmp_path / "volume.npz")


@pytest.mark.parametrize(
    ("name", "line"), [("volume.mhd", "ElementSpacing"), ("volume.mha", "ElementSpacing"), ("volume.nrrd", "space")]
)
def test_a_header_without_voxel_size_is_not_taken_for_one_of_1_mm(tmp_path, values, name, line):
    path = tmp_path / name
    sitk.WriteImage(itk(values), str(path))
    content = path.read_bytes().split(b"\n")
    path.write_bytes(b"\n".join(row for row in content if not row.startswith(line.encode())))
    with pytest.raises(CaptureError, match=r"has no voxel size; put a volume\.json beside it"):
        read_volume(path)
    (tmp_path / "volume.json").write_text(json.dumps({"unit": "1/mm"}))
    with pytest.raises(CaptureError, match="has voxel size"):
        read_volume(path)
    (tmp_path / "volume.json").write_text(json.dumps({"spacing_mm": [1, 2, 3]}))
    assert np.allclose(read_volume(path).volume.spacing_mm, [1, 2, 3])


@pytest.mark.parametrize("name", ["volume.npz", "volume.mha", "volume.nii.gz"])
def test_a_truncated_file_is_named(tmp_path, values, name):
    path = tmp_path / name
    if name.endswith("npz"):
        np.savez(path, volume=np.random.default_rng(0).random((9, 9, 9)), spacing_mm_zyx=[1, 1, 1])
    else:
        sitk.WriteImage(itk(values), str(path))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(CaptureError, match=name.replace(".", r"\.")):
        read_volume(path)


def test_two_volumes_are_one_too_many(tmp_path, values):
    for name in ("a.mha", "b.nrrd"):
        sitk.WriteImage(itk(values), str(tmp_path / name))
    with pytest.raises(CaptureError, match=r"several volumes: a\.mha, b\.nrrd; keep one"):
        find_volume(tmp_path)
    sitk.WriteImage(itk(values), str(tmp_path / "volume.mha"))
    assert find_volume(tmp_path).name == "volume.mha"


def test_projection_files_are_not_taken_for_a_volume(tmp_path, write_xray):
    write_xray(tmp_path)
    np.save(tmp_path / "vol_gt.npy", np.zeros((3, 3, 3)))
    assert find_volume(tmp_path) is None
