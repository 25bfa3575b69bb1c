"""A user's volume is held against the projections beside it: its unit, which way it lies, whose scan it is."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from insideout.core.capture.agreement import compare, match_projections
from insideout.core.capture.check import check_capture
from insideout.core.capture.detectors import CircularScan
from insideout.core.capture.findings import warning
from insideout.core.capture.model import Projections
from insideout.core.capture.read import read_capture
from insideout.core.capture.volumes import RELATIVE, VolumeFiles
from insideout.core.densities import Densities
from insideout.core.volume import Volume

BALLS = (((10.0, 0.0, 0.0), 4.0, 0.05), ((0.0, 6.0, 3.0), 3.0, 0.08), ((-2.0, -3.0, 8.0), 2.5, 0.12))


@pytest.fixture(scope="module")
def balls():
    """The scene of the projections, in mm⁻¹ on a grid over their box."""
    spacing = np.array([0.75, 0.75, 0.6])
    volume = Volume.centered(np.zeros((40, 40, 40), np.float32), spacing)
    axes = [volume.origin_mm[k] + spacing[k] * np.arange(40) for k in range(3)]
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    values = np.zeros(volume.values.shape)
    for center, radius, attenuation in BALLS:
        distance = np.sqrt((x - center[0]) ** 2 + (y - center[1]) ** 2 + (z - center[2]) ** 2)
        values += attenuation * np.clip((radius - distance) / 0.7 + 0.5, 0, 1)
    return Volume(values.astype(np.float32), spacing, volume.origin_mm)


@pytest.fixture
def folder(tmp_path, write_xray):
    return write_xray(tmp_path / "capture" / "xray").parent


def put(folder, volume, change=lambda values: values, **notes):
    np.savez(folder / "xray" / "volume.npz", volume=change(volume.values), spacing_mm_zyx=volume.spacing_mm[::-1])
    if notes:
        (folder / "xray" / "volume.json").write_text(json.dumps(notes))


def lines(folder, level):
    return [finding.message for finding in check_capture(folder) if finding.level == level]


def test_the_right_volume_agrees(folder, balls):
    put(folder, balls, unit="1/mm")
    found = compare(balls, read_capture(folder).projections)
    assert found.correlation > 0.97
    assert found.factor == pytest.approx(1, abs=0.05)
    assert found.orientation == ""
    assert any("correlates with the projections by 0.9" in line for line in lines(folder, "info"))
    assert not any("volume" in line for line in lines(folder, "warning"))


@pytest.mark.parametrize(
    ("flips", "orientation"),
    [
        ((1, 0), "turned by 180° about x"),
        ((0, 2), "turned by 180° about y"),
        ((1, 2), "turned by 180° about z"),
        ((0,), "mirrored along z"),
        ((0, 1, 2), "mirrored along x and y and z"),
    ],
)
def test_a_turned_or_mirrored_volume_is_named_and_left_as_it_is(folder, balls, flips, orientation):
    put(folder, balls, lambda values: np.flip(values, flips), unit="1/mm")
    assert any(f"{orientation} it would by 0.9" in line for line in lines(folder, "warning"))
    assert np.array_equal(read_capture(folder).volume.values, np.flip(balls.values, flips))


@pytest.mark.parametrize(
    "change",
    [lambda values: (values * 5e4).astype(np.uint16), lambda values: values * 8],
    ids=["grey 16-bit", "fractions without a unit"],
)
def test_a_volume_without_a_unit_is_scaled_to_the_projections(folder, balls, change):
    put(folder, balls, change)
    capture = read_capture(folder)
    assert capture.volume.values.sum() == pytest.approx(balls.values.sum(), rel=0.05)
    assert not capture.densities.relative
    told = lines(folder, "info")
    assert any("no unit; it was scaled to mm⁻¹" in line for line in told)
    assert any("voxels of" in line and "attenuation" in line for line in told)
    assert not any("relative" in line for line in [*told, *lines(folder, "warning")])


def test_a_turned_volume_without_a_unit_is_scaled_as_it_would_fit(folder, balls):
    put(folder, balls, lambda values: np.flip(values, (1, 2)) * 8)
    assert read_capture(folder).volume.values.sum() == pytest.approx(balls.values.sum(), rel=0.05)


def test_a_known_unit_that_does_not_fit_is_said_and_kept(folder, balls):
    put(folder, balls, lambda values: values * 2, unit="1/mm")
    assert np.array_equal(read_capture(folder).volume.values, 2 * balls.values)
    assert any(line.startswith("the projections show 0.5") for line in lines(folder, "warning"))


def test_water_of_hounsfield_units_is_in_the_model_as_the_projections_have_it(folder, balls):
    """Splats are fitted to these; the volume stays as it is, and so does its own water."""
    put(folder, balls, lambda values: 1000 * (values / 0.02 - 1), unit="HU", mu_water_per_mm=0.025)
    capture = read_capture(folder)
    assert capture.volume.values.sum() == pytest.approx(1.25 * balls.values.sum(), rel=1e-3)
    assert capture.densities.water_per_mm == pytest.approx(0.02, rel=0.05)
    assert capture.volume_densities == Densities(water_per_mm=0.025)
    assert any(line.startswith("water has 0.0") and "mm⁻¹ in the model, 0." in line for line in lines(folder, "info"))


def test_water_that_a_file_tells_is_more_exact_than_the_comparison(folder, balls):
    """Of data that agree, the factor is the coarse comparison's own error."""
    put(folder, balls, lambda values: 1000 * (values / 0.02 - 1), unit="HU", mu_water_per_mm=0.02)
    capture = read_capture(folder)
    assert compare(capture.volume, capture.projections).factor != 1
    assert capture.densities == capture.volume_densities == Densities(water_per_mm=0.02)
    assert not any("in the model" in line for line in lines(folder, "info"))


@pytest.mark.parametrize(
    "change",
    [lambda values: (values * 5e4).astype(np.uint16), lambda values: values * 8],
    ids=["grey 16-bit", "fractions without a unit"],
)
def test_a_volume_of_another_object_stays_relative_and_the_model_is_in_mm(folder, balls, change):
    """What is fitted to projections has their unit, whatever lies beside them; fractions may be of any scale."""
    other = np.random.default_rng(0).permutation(balls.values.ravel()).reshape(balls.values.shape)
    put(folder, balls, lambda _: change(other))
    warned = lines(folder, "warning")
    assert any("correlates with the projections by" in line for line in warned)
    assert any("fits the projections too badly" in line for line in warned)
    assert not any("taken for attenuation in mm⁻¹" in line for line in warned)
    assert not any(RELATIVE in line for line in warned), "by which the add-on knows such a model"
    capture = read_capture(folder)
    assert np.percentile(capture.volume.values, 99.9) == pytest.approx(0.05)
    assert (capture.densities, capture.volume_densities) == (Densities(), Densities(relative=True))
    assert not capture.can_follow_volume
    assert replace(capture, volume=None).can_follow_volume, "then it is the FDK of the projections"
    told = lines(folder, "info")
    assert any("relative densities 0 to 0.05" in line for line in told)
    assert any("the outline is taken from it, but no density" in line for line in told)
    assert not any("sections are taken from it" in line for line in told)


def test_a_volume_beside_the_rays_is_pointed_out(folder, balls):
    put(folder, balls, unit="1/mm")
    projections = read_capture(folder).projections
    beside = Volume(balls.values, balls.spacing_mm, balls.origin_mm + np.array([0, 0, 500.0]))
    assert compare(beside, projections) is None
    grey = VolumeFiles(beside, [], warning("v.tif", RELATIVE, "say its unit"), False, [], Densities(relative=True))
    found = match_projections("v.tif", grey, projections)
    assert "no ray" in found.findings[0].message
    assert "too badly" in found.meaning.message
    assert (found.of_model, found.densities) == (Densities(), Densities(relative=True))


def test_without_projections_numbers_without_a_unit_are_a_warning(tmp_path, balls):
    (tmp_path / "xray").mkdir()
    put(tmp_path, balls)
    assert any("has no unit" in line for line in lines(tmp_path, "warning"))


def test_large_projections_are_averaged_in_place(balls, radiograph):
    scan = CircularScan(130, 115, (0.4, 0.4), 60.0, 90.0, offset_mm=(1.0, 0.5))
    detectors = scan.detectors(np.array([0.3, 1.4, 2.5, 3.6]))
    images = np.stack([radiograph(detector) for detector in detectors])
    projections = Projections(images, detectors, np.zeros(4, bool), np.zeros(4), balls.box_mm, (40, 40, 40))
    found = compare(balls, projections)
    assert found.correlation > 0.97
    assert found.factor == pytest.approx(1, abs=0.05)
