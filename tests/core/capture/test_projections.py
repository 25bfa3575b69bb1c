"""Projections on disk become line integrals with a detector each; what is wrong is said by name."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.capture.projections import (
    find_projections,
    line_integrals,
    look_like_intensities,
    read_projections,
)
from insideout.core.errors import CaptureError


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
    assert any("1 projections in the folder are not listed" in f.message for f in read(tmp_path).findings)
