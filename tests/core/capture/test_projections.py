"""Projections on disk become line integrals with a detector each; what is wrong is said by name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from insideout.core.capture.air import look_like_intensities
from insideout.core.capture.model import Projections
from insideout.core.capture.projections import (
    find_projections,
    line_integrals,
    load_npy,
    read_projections,
    to_line_integrals,
)
from insideout.core.errors import CaptureError
from insideout.core.views import Detector


def read(folder):
    return read_projections(find_projections(folder))


def test_a_folder_in_r2_gaussians_layout(tmp_path, write_xray, radiograph):
    result = read(write_xray(tmp_path)).projections
    assert result.images.shape == (24, 28, 32)
    assert result.images.dtype == np.float32
    assert result.held_out.tolist() == [False] * 21 + [True] * 3
    assert np.allclose(result.box_mm, [[-15, -15, -12], [15, 15, 12]])
    assert (result.source_to_axis_mm, result.source_to_detector_mm, result.voxels) == (60, 90, (16, 16, 16))
    for image, detector in zip(result.images, result.detectors, strict=True):
        assert np.allclose(image, radiograph(detector), atol=1e-5)


def test_without_test_projections_every_eighth_is_held_out(tmp_path, write_xray):
    assert read(write_xray(tmp_path, test=0)).projections.held_out.nonzero()[0].tolist() == [0, 8, 16]


def test_half_precision_files_are_read_as_single(tmp_path, write_xray):
    write_xray(tmp_path, image=lambda array, i: array.astype(np.float16))
    assert read(tmp_path).projections.images.dtype == np.float32


def test_a_detector_offset_moves_the_detector(tmp_path, write_xray):
    result = read(write_xray(tmp_path, lambda meta: meta["scanner"].update(offDetector=[2.0, 3.0]))).projections
    assert np.allclose(result.detectors[0].center, [-30, 2, 3])


def test_transmissions_are_recognised_and_converted(tmp_path, write_xray):
    straight = read(write_xray(tmp_path / "a")).projections.images
    result = read(write_xray(tmp_path / "b", image=lambda array, i: np.exp(-array)))
    assert np.allclose(result.projections.images, straight, atol=1e-4)
    assert any("intensities" in finding.message for finding in result.findings)


def test_raw_counts_use_the_flat_and_dark_images_beside_them(tmp_path, write_xray):
    straight = read(write_xray(tmp_path / "a")).projections.images
    gain = np.linspace(8000, 12000, 32)[None, :]
    write_xray(tmp_path / "b", image=lambda array, i: np.round(np.exp(-array) * gain + 100).astype(np.uint16))
    np.save(tmp_path / "b" / "flat.npy", np.broadcast_to(gain + 100, (28, 32)))
    np.save(tmp_path / "b" / "dark.npy", np.full((28, 32), 100.0))
    assert np.allclose(read(tmp_path / "b").projections.images, straight, atol=2e-3)


@pytest.fixture
def write_readings(tmp_path, write_xray):
    """Writes 16-bit readings with a gain, their flat and dark image, and returns (line integrals, folder)."""
    gain = np.broadcast_to(np.linspace(8000, 12000, 32)[None, :], (28, 32))

    def write(flat=gain + 100, dark=100.0, dead=()):
        def reading(array, i):
            counts = np.round(np.exp(-array) * gain + 100).astype(np.uint16)
            for pixel in dead:
                counts[pixel] = 107
            return counts

        straight = read(write_xray(tmp_path / "straight")).projections.images
        write_xray(tmp_path / "readings", image=reading)
        for name, image in (("flat.npy", flat), ("dark.npy", dark)):
            if image is not None:
                np.save(tmp_path / "readings" / name, np.broadcast_to(image, (28, 32)))
        return straight, tmp_path / "readings"

    return write


def test_dead_pixels_are_filled_from_their_neighbours(write_readings):
    dead = [(13, 15), (13, 16), (14, 16), (0, 0)]
    flat = np.broadcast_to(np.linspace(8100, 12100, 32)[None, :], (28, 32)).copy()
    for pixel in dead:
        flat[pixel] = 100.0
    straight, folder = write_readings(flat=flat, dead=dead)
    result = read(folder)
    images = result.projections.images
    assert np.isfinite(images).all()
    living = np.ones((28, 32), bool)
    for row, column in dead:
        living[row, column] = False
        around = straight[:, max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3]
        assert (images[:, row, column] <= around.max((1, 2)) + 2e-3).all()
        assert (images[:, row, column] >= around.min((1, 2)) - 2e-3).all()
    assert np.allclose(images[:, living], straight[:, living], atol=2e-3)
    assert any("4 dead pixels" in finding.message for finding in result.findings)


@pytest.fixture
def write_silent(tmp_path, write_xray):
    """Writes transmissions that are 0 at some pixels of the first so many projections; (line integrals, folder)."""

    def write(rows, columns, views=24):
        def spoiled(array, i):
            image = np.exp(-array)
            if i < views:
                image[rows, columns] = 0.0
            return image

        straight = read(write_xray(tmp_path / "straight", image=lambda array, i: np.exp(-array))).projections
        return straight, write_xray(tmp_path / "silent", image=spoiled)

    return write


def test_pixels_that_see_nothing_in_any_projection_are_filled_without_a_flat_field(write_silent):
    """One, and a line two pixels wide; the full scale is the object's own."""
    rows, columns = np.array([13] + [20] * 32 + [21] * 32), np.array([15, *range(32), *range(32)])
    straight, folder = write_silent(rows, columns)
    result = read(folder)
    images = result.projections.images
    assert any("65 pixels saw no X-rays" in finding.message for finding in result.findings)
    everywhere = np.arange(len(images))
    assert result.projections.peak(everywhere) == pytest.approx(straight.peak(everywhere), rel=0.05)
    seen = np.ones((28, 32), bool)
    seen[rows, columns] = False
    np.testing.assert_array_equal(images[:, seen], straight.images[:, seen])


def test_a_few_readings_below_zero_behind_metal_make_no_line_integrals_of_all(tmp_path, write_xray):
    """Where a dark image was taken off them already."""

    def reading(array, i):
        image = np.exp(-array)
        if i % 2:
            image[13, 15] = -1e-4
        return image

    straight = read(write_xray(tmp_path / "straight")).projections.images
    result = read(write_xray(tmp_path / "readings", image=reading))
    assert any("intensities without a flat field" in finding.message for finding in result.findings)
    others = np.arange(28 * 32) != 13 * 32 + 15
    images = result.projections.images.reshape(24, -1)
    np.testing.assert_allclose(images[:, others], straight.reshape(24, -1)[:, others], atol=1e-5)


def test_noisy_line_integrals_without_air_beside_the_object_are_no_readings(tmp_path, write_xray):
    """It is wider than the detector, and air is seen above it alone."""
    rng = np.random.default_rng(0)
    across = np.linspace(-0.7, 0.7, 32)
    image = np.where(np.arange(28)[:, None] < 3, 0.0, 3 * np.sqrt(1 - across**2)).astype(np.float32)
    folder = write_xray(tmp_path, image=lambda array, i: image + rng.normal(0, 0.003, image.shape).astype(np.float32))
    assert any("are line integrals" in finding.message for finding in read(folder).findings)


def test_of_two_scans_in_a_folder_none_is_taken(tmp_path):
    for name in ("first", "again"):
        (tmp_path / f"{name}.xtekct").touch()
    with pytest.raises(CaptureError, match=r"holds several scans: again\.xtekct, first\.xtekct; keep the file"):
        find_projections(tmp_path)


def test_pixels_that_see_nothing_are_filled_in_line_integrals_too(tmp_path, write_xray):
    """Saved as -ln(max(T, 1e-6)) by whoever made them."""

    def spoiled(array, i):
        array = array.copy()
        array[13, 15] = -np.log(1e-6)
        return array

    straight = read(write_xray(tmp_path / "straight")).projections
    result = read(write_xray(tmp_path / "spoiled", image=spoiled))
    assert any("1 pixels saw no X-rays" in finding.message for finding in result.findings)
    assert any("are line integrals" in finding.message for finding in result.findings)
    everywhere = np.arange(24)
    assert result.projections.peak(everywhere) == pytest.approx(straight.peak(everywhere), rel=0.05)
    np.testing.assert_array_equal(
        np.delete(result.projections.images.reshape(24, -1), 13 * 32 + 15, axis=1),
        np.delete(straight.images.reshape(24, -1), 13 * 32 + 15, axis=1),
    )


@pytest.mark.parametrize(("pixels", "views"), [(1, 23), (3, 24)])
def test_what_is_starved_now_and_then_or_where_metal_may_be_stays(write_silent, pixels, views):
    """Steel on the axis lets nothing through in all of them."""
    square = np.mgrid[10 : 10 + pixels, 12 : 12 + pixels].reshape(2, -1)
    straight, folder = write_silent(*square, views)
    result = read(folder)
    expected = straight.images.copy()
    starved = [index for index, image in enumerate(result.projections.images) if image[10, 12] > 13]
    assert len(starved) == views
    for index in starved:
        expected[index][square[0], square[1]] = -np.log(np.float32(1e-6))
    np.testing.assert_array_equal(result.projections.images, expected)
    assert not any("saw no X-rays" in finding.message for finding in result.findings)


def test_swapped_flat_and_dark_images_are_pointed_out(write_readings):
    _, folder = write_readings(flat=100.0, dark=9000.0)
    with pytest.raises(CaptureError, match=r"check that flat\.npy and dark\.npy are not swapped"):
        read(folder)


def test_readings_below_the_dark_image_are_named_after_conversion(write_readings):
    _, folder = write_readings(flat=6e4, dark=3e4)
    with pytest.raises(CaptureError, match=r"0000\.npy: is 13\.8155 everywhere"):
        read(folder)


def test_what_the_user_says_goes_before_a_flat_field(tmp_path, write_xray):
    folder = write_xray(tmp_path, lambda meta: meta.update(values="line_integral"))
    straight = read(folder).projections.images
    np.save(folder / "flat.npy", np.ones((28, 32)))
    result = read(folder)
    assert np.array_equal(result.projections.images, straight)
    assert any(f.level == "warning" and "flat.npy not used" in f.message for f in result.findings)


def test_a_dark_image_alone_is_subtracted(write_readings):
    straight, folder = write_readings(flat=None)
    images = read(folder).projections.images
    # Without a flat field the gain of a column stays: 8000 to 12000, and air is its brightest.
    gain = np.linspace(8000, 12000, 32)[None, :]
    air = np.percentile(gain * np.exp(-straight), 99.5, axis=(1, 2))[:, None, None]
    assert np.allclose(images, straight - np.log(gain / air), atol=2e-3)


def test_a_dark_image_beside_line_integrals_is_mentioned(tmp_path, write_xray):
    folder = write_xray(tmp_path)
    np.save(folder / "dark.npy", np.zeros((28, 32)))
    assert any(f.level == "warning" and "dark.npy not used" in f.message for f in read(folder).findings)


def test_the_user_may_say_what_the_values_are(tmp_path, write_xray):
    write_xray(tmp_path, lambda meta: meta.update(values="line_integral"), lambda array, i: np.exp(-array))
    assert read(tmp_path).projections.images.max() == pytest.approx(1.0)


def test_line_integrals_clip_dead_pixels_at_a_millionth():
    values = line_integrals(np.array([[[1000.0, 100.0, 0.0]]]), flat=1000.0, dark=100.0)
    assert values[0, 0, 0] == pytest.approx(0)
    assert np.allclose(values[0, 0, 1:], -np.log(1e-6))


def test_line_integrals_are_not_taken_for_intensities(scan, radiograph):
    images = np.stack([radiograph(scan.detector(angle)) for angle in (0.0, 1.0, 2.0)])
    noisy = np.maximum(images + np.random.default_rng(0).normal(0, 0.02, images.shape), 0)
    assert not look_like_intensities(images)
    assert not look_like_intensities(noisy)
    assert look_like_intensities(np.exp(-images))


def spoil(index, value):
    def change(array, i):
        if i == index:
            array = array.copy()
            array[3, 4] = value
        return array

    return change


@pytest.mark.parametrize(
    ("image", "says"),
    [
        (spoil(5, np.nan), "0005.npy: has 1 pixels that are NaN"),
        (spoil(5, np.inf), "0005.npy: has 1 pixels that are NaN or infinite"),
        (lambda array, i: array * (i != 6), "0006.npy: is zero everywhere"),
        (lambda array, i: array[:-1] if i == 7 else array, "0007.npy: is 32 x 27 but"),
        (lambda array, i: array[None], "not rows x columns"),
    ],
)
def test_spoilt_images_are_named(tmp_path, write_xray, image, says):
    with pytest.raises(CaptureError, match=says):
        read(write_xray(tmp_path, image=image))


def drop(key):
    return lambda meta: meta["scanner"].pop(key)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda meta: meta.pop("scanner"), "lacks 'scanner'"),
        (lambda meta: meta.pop("proj_train"), "lacks 'proj_train'"),
        (drop("DSD"), "lacks 'DSD'"),
        (drop("nDetector"), "lacks 'nDetector'"),
        (drop("sVoxel"), "lacks 'sVoxel'"),
        (lambda meta: meta["proj_train"][2].pop("angle"), "0003.npy has no 'angle'; add the gantry angle"),
        (lambda meta: meta["proj_train"][2].update(angle=200.0), "looks like degrees"),
        (lambda meta: meta["scanner"].update(DSO=200.0), "DSO must be above zero and below DSD"),
        (lambda meta: meta["scanner"].update(nDetector=[32, 28]), "swap the two numbers"),
        (lambda meta: meta["scanner"].update(sDetector=[0, 10]), "'sDetector' is"),
        (lambda meta: meta["scanner"].update(DSD="far"), "'DSD' is 'far'"),
        (lambda meta: meta["scanner"].update(mode="spiral"), "'mode' is 'spiral'"),
        (lambda meta: meta.update(proj_train=[]), "lists no projections"),
        (lambda meta: meta.update(values="counts"), "'values' is 'counts'"),
        (lambda meta: meta.update(proj_train=None), "lists no projections"),
        (lambda meta: meta.update(proj_train=5), "'proj_train' is 5; make it a list"),
        (lambda meta: meta.update(proj_test=3), "'proj_test' is 3; make it a list"),
        (lambda meta: meta["proj_test"].append(meta["proj_train"][4]), r"1 projections more than once: 0005\.npy"),
    ],
)
def test_a_wrong_description_is_explained(tmp_path, write_xray, change, says):
    with pytest.raises(CaptureError, match=says) as caught:
        read(write_xray(tmp_path, change))
    assert "meta_data.json" in str(caught.value)


def test_missing_files_are_named(tmp_path, write_xray):
    write_xray(tmp_path)
    (tmp_path / "proj_train" / "0002.npy").unlink()
    (tmp_path / "proj_train" / "0004.npy").unlink()
    with pytest.raises(CaptureError, match=r"2 files are missing: proj_train/0002.npy, proj_train/0004.npy"):
        read(tmp_path)


def test_a_truncated_file_is_named(tmp_path, write_xray):
    path = write_xray(tmp_path) / "proj_train" / "0002.npy"
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(CaptureError, match=r"0002.npy: cannot be read as .npy"):
        read(tmp_path)


def test_broken_json_is_located(tmp_path, write_xray):
    path = write_xray(tmp_path) / "meta_data.json"
    path.write_text(path.read_text()[:-10])
    with pytest.raises(CaptureError, match=r"meta_data.json: is not valid JSON at line 1"):
        read(tmp_path)


def test_files_that_are_not_listed_are_mentioned(tmp_path, write_xray):
    write_xray(tmp_path, lambda meta: meta["proj_train"].pop())
    for path in list((tmp_path / "proj_train").glob("*.npy")):
        (path.parent / f"._{path.name}").touch()
    assert any("1 projections in the folder are not listed" in f.message for f in read(tmp_path).findings)


def test_a_pixel_at_the_object_is_smaller_than_on_the_detector_of_a_cone():
    cone = Detector(8, 8, source=[100, 0, 0], center=[-50, 0, 0], u=[0, 1.5, 0], v=[0, 0, -1.5])
    straight = replace(cone, source=[-1, 0, 0], parallel=True)
    images, box = np.zeros((1, 8, 8), np.float32), np.array([[-4.0] * 3, [4.0] * 3])
    for detector, pixel_mm in ((cone, 1.0), (straight, 1.5)):
        projections = Projections(images, [detector], np.zeros(1, bool), np.zeros(1), box, (8, 8, 8))
        assert projections.pixel_mm == pytest.approx(pixel_mm)


def lines(images):
    images = np.asarray(images, np.float32)
    box = np.array([[-4.0] * 3, [4.0] * 3])
    return Projections(images, [], np.zeros(len(images), bool), np.zeros(len(images)), box, (8, 8, 8))


def test_what_rays_through_a_body_measure_does_not_depend_on_the_air_beside_it():
    body = np.full((1, 4, 4), 0.8)
    assert lines(body).body([0]) == pytest.approx(0.8)
    beside = np.pad(body, ((0, 0), (4, 4), (4, 4)))
    beside[0, 0, :4] = -0.01, 0.01, np.nan, np.inf
    assert lines(beside).body([0]) == pytest.approx(0.8, rel=1e-3)


def test_a_few_rays_through_steel_are_the_peak_and_hardly_raise_the_body():
    images = np.full((2, 40, 40), 0.5)
    images[0, 0, 0] = 10.0
    assert lines(images).peak([0, 1]) == 10.0
    assert lines(images).body([0, 1]) == pytest.approx(0.5, rel=0.15)


def test_a_body_that_no_projection_shows_is_not_divided_by_nothing():
    assert lines(np.zeros((1, 4, 4))).body([0]) > 0
    assert lines(np.zeros((1, 4, 4))).body([]) > 0


def ball_in_air(air, read_noise=0.0):
    """(16, 24, 40) shares of the full scale behind a ball on a stand, which leave air at both sides."""
    rows, columns = np.mgrid[:24, :40]
    through = 2 * np.sqrt(np.maximum(1 - ((rows - 11.5) ** 2 + (columns - 19.5) ** 2) / 81, 0))
    through[22:] += 3.0
    noise = np.random.default_rng(0).normal(0, read_noise, (16, 24, 40))
    return (air * np.exp(-through) * (1 + noise)).astype(np.float32), through


@pytest.mark.parametrize("air", [0.4, 0.6, 0.8, 0.96, 12000.0])
@pytest.mark.parametrize("noise", [0.0, 0.01, 0.05])
def test_readings_divided_by_full_scale_are_no_transmissions(air, noise):
    """16 bits by 65535, say: air is not 1 then, and less would be haze everywhere."""
    images, through = ball_in_air(air, noise)
    integrals, findings = to_line_integrals(Path("scan"), ["a"] * 16, images)
    np.testing.assert_allclose(integrals.mean(axis=0), through, atol=0.002 + noise)
    beside = integrals[:, :22, :3]
    assert abs(float(beside.mean())) < 0.002 + noise / 10, "no haze"
    assert any("air was taken from where each image is brightest" in finding.message for finding in findings)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_transmissions_stay_as_they_are(noise):
    images, _ = ball_in_air(1.0, noise)
    integrals, findings = to_line_integrals(Path("scan"), ["a"] * 16, images)
    np.testing.assert_allclose(integrals, -np.log(images), atol=1e-6)
    assert any("air was taken to be 1" in finding.message for finding in findings)


@pytest.mark.parametrize("round_", [True, False])
def test_transmissions_of_what_fills_the_detector_stay_as_they_are(round_):
    """Without air nothing but full scale says what 1 is; what is brightest is the thinnest part."""
    columns = np.linspace(-0.9, 0.9, 40)
    turned = np.zeros(16) if round_ else 0.2 * np.sin(np.linspace(0, 2 * np.pi, 16))
    through = 2 * np.sqrt(np.maximum(1 - (columns - 0.3 * turned[:, None]) ** 2, 0))
    images = np.repeat(np.exp(-through)[:, None], 24, axis=1).astype(np.float32)
    integrals, _ = to_line_integrals(Path("scan"), ["a"] * 16, images, declared="intensity")
    np.testing.assert_allclose(integrals[:, 0], through, atol=1e-5)


def test_an_archive_that_is_called_npy_is_named(tmp_path, write_xray):
    folder = write_xray(tmp_path)
    first = sorted((folder / "proj_train").glob("*.npy"))[0]
    np.savez(tmp_path / "a.npz", np.zeros((28, 32)))
    (tmp_path / "a.npz").replace(first)
    with pytest.raises(CaptureError, match=f"{first.name}: is an .npz; export it as .npy"):
        read(folder)


def test_a_damaged_header_of_an_array_is_told(tmp_path):
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (2, 2".ljust(117) + b"\n"
    (tmp_path / "a.npy").write_bytes(b"\x93NUMPY\1\0" + len(header).to_bytes(2, "little") + header + bytes(16))
    with pytest.raises(CaptureError, match=r"a\.npy: cannot be read as \.npy"):
        load_npy(tmp_path / "a.npy")


def test_a_list_that_was_written_on_windows_is_read(tmp_path, write_xray):
    def backwards(meta):
        for frame in meta["proj_train"] + meta["proj_test"]:
            frame["file_path"] = frame["file_path"].replace("/", "\\")

    assert len(read(write_xray(tmp_path, backwards)).projections.images) == 24
