"""A Nikon scanner's own files: .xtekct settings and numbered .tif intensities."""

from __future__ import annotations

import numpy as np
import pytest
import tifffile

from insideout.core.capture.detectors import project_points
from insideout.core.capture.projections import find_projections, read_projections
from insideout.core.errors import CaptureError

SETTINGS = """[XTekCT]
Name=balls
VoxelsX=16
VoxelsY=16
VoxelsZ=16
VoxelSizeX=2
VoxelSizeY=2
VoxelSizeZ=2
SrcToObject=60
SrcToDetector=90
DetectorPixelsX=64
DetectorPixelsY=56
DetectorPixelSizeX=0.8
DetectorPixelSizeY=0.8
WhiteLevel=60000.0
Projections=10
InitialAngle=36
AngularStep=36.0
Units=mm
"""


@pytest.fixture
def folder(tmp_path, scan, radiograph):
    (tmp_path / "balls.xtekct").write_text(SETTINGS)
    for index, angle in enumerate(np.deg2rad(36 + 36.0 * np.arange(10))):
        counts = 60000 * np.exp(-radiograph(scan.detector(angle))[:, ::-1])
        tifffile.imwrite(tmp_path / f"balls_{index + 1:04d}.tif", counts.astype(np.uint16))
    return tmp_path


def test_intensities_become_line_integrals_at_the_right_angles(folder, radiograph):
    # The images are binned by two against the settings: the pitch doubles.
    result = read_projections(find_projections(folder)).projections
    assert np.allclose(result.box_mm, [[-16] * 3, [16] * 3])
    for image, detector in zip(result.images, result.detectors, strict=True):
        assert np.allclose(image, radiograph(detector), atol=1e-3)


def test_a_wire_is_where_a_stage_that_turns_clockwise_takes_it_seen_from_behind_the_detector(folder):
    """Told without a `CircularScan`: the source stands at x = 60, the detector crosses the x axis at -30."""
    path = folder / "balls.xtekct"
    path.write_text(SETTINGS + "DetectorOffsetX=2.4\n")
    wire = np.array([7.0, 4.0])
    for index, turned in enumerate(np.deg2rad(36 + 36.0 * np.arange(10))):
        x, y = np.cos(turned) * wire[0] + np.sin(turned) * wire[1], np.cos(turned) * wire[1] - np.sin(turned) * wire[0]
        # Who looks along x from behind the detector has y to the left.
        to_the_right_mm = -y * 90 / (60 - x)
        image = np.full((56, 64), 60000, np.uint16)
        image[:, int((to_the_right_mm - 2.4) / 0.8 + 32)] = 6000
        tifffile.imwrite(folder / f"balls_{index + 1:04d}.tif", image)
    read = read_projections(path).projections
    seen = [project_points(detector, np.array([*wire, 0.0]))[0] for detector in read.detectors]
    assert read.images[:, 28].argmax(axis=1).tolist() == [int(column) for column in seen]


def test_missing_images_are_counted(folder):
    (folder / "balls_0003.tif").unlink()
    with pytest.raises(CaptureError, match=r"names 10 projections but 9 \.tif files"):
        read_projections(find_projections(folder))


def test_flat_fields_beside_the_projections_are_not_taken_for_some(folder):
    expected = read_projections(find_projections(folder)).projections.images
    for name in ("flat_0003.tif", "balls_dark_0000.tif"):
        tifffile.imwrite(folder / name, np.full((28, 32), 60000, np.uint16))
    assert np.array_equal(read_projections(find_projections(folder)).projections.images, expected)


def test_two_whole_series_of_which_neither_is_named_as_the_settings_are_not_guessed_at(folder):
    for index in range(10):
        (folder / f"balls_{index + 1:04d}.tif").rename(folder / f"first_{index + 1:04d}.tif")
        tifffile.imwrite(folder / f"second_{index + 1:04d}.tif", np.full((28, 32), 60000, np.uint16))
    with pytest.raises(
        CaptureError, match=r"more than one series of \.tif files \(first_0001\.tif, second_0001\.tif\)"
    ):
        read_projections(find_projections(folder))


@pytest.mark.parametrize(("count", "warned"), [(10, False), (8, False), (7, True)])
def test_files_that_the_settings_do_not_name_are_told_but_for_the_last_of_a_turn(folder, count, warned):
    path = folder / "balls.xtekct"
    path.write_text(SETTINGS.replace("Projections=10", f"Projections={count}"))
    read = read_projections(path)
    told = [finding for finding in read.findings if "names 7 projections" in str(finding.message)]
    assert len(read.projections.images) == count
    assert bool(told) is warned
    if warned:
        assert told[0].level == "warning"
        assert "balls_0008.tif, balls_0009.tif, balls_0010.tif" in str(told[0].message)


def test_an_axis_that_the_file_has_elsewhere_is_told(folder):
    path = folder / "balls.xtekct"
    read = read_projections(path).findings
    path.write_text(SETTINGS + "CentreOfRotationTop=0.12\nObjectTilt=0.0\nObjectRoll=automatic\n")
    (told,) = [finding for finding in read_projections(path).findings if finding not in read]
    assert told.level == "warning"
    assert "(CentreOfRotationTop=0.12), which is not read" in str(told.message)


def test_a_missing_setting_is_named(folder):
    path = folder / "balls.xtekct"
    path.write_text(SETTINGS.replace("SrcToObject=60\n", ""))
    with pytest.raises(CaptureError, match="lacks 'srctoobject'"):
        read_projections(path)


def test_without_voxels_the_box_is_what_every_detector_sees(folder):
    path = folder / "balls.xtekct"
    path.write_text("".join(line for line in SETTINGS.splitlines(True) if not line.startswith("VoxelSize")))
    box = read_projections(path).projections.box_mm
    assert np.allclose(box[1], [32 * 1.6 / 2 / 1.5] * 2 + [28 * 1.6 / 2 / 1.5])


@pytest.mark.parametrize(
    ("line", "named"),
    [("Projections=10", "Projections"), ("DetectorPixelsY=56", "DetectorPixels"), ("VoxelsZ=16", "Voxels")],
)
def test_counts_of_nothing_are_named(folder, line, named):
    (folder / "balls.xtekct").write_text(SETTINGS.replace(line, line.split("=")[0] + "=0"))
    with pytest.raises(CaptureError, match=f"balls.xtekct: '{named}' is"):
        read_projections(find_projections(folder))


def test_hidden_files_of_a_mac_are_no_scans(folder, radiograph):
    expected = read_projections(find_projections(folder)).projections.images
    for path in list(folder.iterdir()):
        (folder / f"._{path.name}").write_bytes(b"\0\5\x16\7")
    assert np.array_equal(read_projections(find_projections(folder)).projections.images, expected)


def test_settings_that_an_editor_saved_with_a_mark_are_read(folder):
    (folder / "balls.xtekct").write_text(SETTINGS, "utf-8-sig")
    assert len(read_projections(find_projections(folder)).projections.images) == 10


def test_without_a_white_level_it_says_what_helps(folder):
    (folder / "balls.xtekct").write_text(SETTINGS.replace("WhiteLevel=60000.0\n", ""))
    (advice,) = [
        found.advice for found in read_projections(find_projections(folder)).findings if "flat" in found.message
    ]
    assert advice.startswith("give WhiteLevel")
