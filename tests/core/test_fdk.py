"""FDK finds known balls: their attenuation, their place, and nothing mirrored, for every kind of scan."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from insideout.core.capture.detectors import CircularScan, visible_box
from insideout.core.capture.model import Projections
from insideout.core.errors import CaptureError, SettingError
from insideout.core.fdk import coverage, fdk
from insideout.core.progress import Reporter
from insideout.core.volume import Volume

# Centre (mm), radius (mm), attenuation (mm⁻¹); no mirror image of the scene is the scene.
BALLS = ((np.array([6.0, 3.0, 4.0]), 7.0, 0.05), (np.array([-8.0, -5.0, -6.0]), 5.0, 0.08))
CONE = CircularScan(96, 80, (0.8, 0.8), 120.0, 180.0)
PARALLEL = CircularScan(96, 80, (0.5, 0.5), 120.0, 180.0, parallel=True)


def degrees(start: float, stop: float, step: float) -> np.ndarray:
    return np.radians(np.arange(start, stop, step))


def scan_balls(scan: CircularScan, angles: np.ndarray) -> Projections:
    detectors = scan.detectors(angles)
    images = np.stack([ball_integrals(*detector.rays()) for detector in detectors])
    box = np.array([[-18.0, -18.0, -16.0], [18.0, 18.0, 16.0]])
    return Projections(images.astype(np.float32), detectors, np.zeros(len(angles), bool), angles, box, (48, 48, 42))


def ball_integrals(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    total = np.zeros(origins.shape[:2])
    for center, radius, attenuation in BALLS:
        toward = center - origins
        along = (toward * directions).sum(-1)
        squared = radius**2 - ((toward**2).sum(-1) - along**2)
        total += attenuation * 2 * np.sqrt(np.maximum(squared, 0))
    return total


def voxel_centers(volume: Volume) -> np.ndarray:
    axes = [volume.origin_mm[k] + volume.spacing_mm[k] * np.arange(volume.values.shape[2 - k]) for k in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).transpose(2, 1, 0, 3)


@pytest.mark.parametrize(
    ("scan", "angles"),
    [
        pytest.param(CONE, degrees(0, 360, 5), id="full circle"),
        pytest.param(CONE, degrees(170, 530, 5), id="another start"),
        pytest.param(CONE, degrees(360, 0, -5), id="turning the other way"),
        pytest.param(CONE, degrees(0, 230, 3), id="short scan"),
        pytest.param(replace(CONE, offset_mm=(4.0, 3.0)), degrees(0, 360, 5), id="detector offset"),
        pytest.param(replace(CONE, offset_mm=(8.0, 0.0)), degrees(0, 230, 3), id="short scan, detector offset"),
        pytest.param(replace(CONE, width=64, offset_mm=(16.0, 0.0)), degrees(0, 360, 2.5), id="half fan"),
        pytest.param(PARALLEL, degrees(0, 360, 5), id="parallel, full circle"),
        pytest.param(PARALLEL, degrees(0, 180, 3), id="parallel, half circle"),
        pytest.param(PARALLEL, degrees(0, 183, 3), id="parallel, half circle and its end"),
    ],
)
def test_attenuation_and_place_are_recovered(scan, angles):
    volume = fdk(scan_balls(scan, angles))

    centers = voxel_centers(volume)
    for middle, radius, attenuation in BALLS:
        distance = np.linalg.norm(centers - middle, axis=-1)
        assert volume.values[distance < 0.7 * radius].mean() == pytest.approx(attenuation, rel=0.01)
        around = distance < 1.3 * radius
        weight = np.maximum(volume.values[around], 0)
        found = weight @ centers[around] / weight.sum()
        np.testing.assert_allclose(found, middle, atol=0.1 * volume.spacing_mm.max())


def test_a_box_as_wide_as_the_field_of_view_changes_no_weights():
    """Where a scanner's file names none; off the axis densities of a short scan were 30 to 40 % off."""
    projections = scan_balls(replace(CONE, offset_mm=(8.0, 0.0)), degrees(0, 230, 3))
    volume = fdk(replace(projections, box_mm=visible_box(projections.detectors)))
    centers = voxel_centers(volume)
    for middle, radius, attenuation in BALLS:
        inside = np.linalg.norm(centers - middle, axis=-1) < 0.7 * radius
        assert volume.values[inside].mean() == pytest.approx(attenuation, rel=0.02)


@pytest.mark.parametrize("scan", [PARALLEL, CONE], ids=["parallel", "cone"])
def test_no_view_of_a_quarter_turn_counts_for_many(scan):
    """Beside a wedge that nobody measured a view of a parallel beam once had as much say as forty others."""
    angles = degrees(0, 90, 2)
    projections = scan_balls(scan, angles)
    one = np.zeros_like(projections.images)
    said = []
    for view in (0, len(angles) // 2, len(angles) - 1):
        alone = one.copy()
        alone[view] = projections.images[view]
        said.append(np.linalg.norm(fdk(replace(projections, images=alone)).values))
    assert max(said) < 2 * min(said)


def test_a_tilted_detector_is_taken_as_it_stands():
    straight = scan_balls(CONE, degrees(0, 360, 5))
    cos, sin = np.cos(np.radians(10.0)), np.sin(np.radians(10.0))
    tilted = [replace(d, u=cos * d.u + sin * d.v, v=cos * d.v - sin * d.u) for d in straight.detectors]
    images = np.stack([ball_integrals(*d.rays()) for d in tilted]).astype(np.float32)

    right = fdk(replace(straight, images=images, detectors=tilted))
    ignored = fdk(replace(straight, images=images))

    truth = fdk(straight).values
    assert np.abs(right.values - truth).mean() < 0.4 * np.abs(ignored.values - truth).mean()


def test_grid_fills_the_box():
    projections = scan_balls(CONE, degrees(0, 360, 20))

    volume = fdk(projections, voxels=(20, 30, 10))

    assert volume.values.shape == (10, 30, 20)
    np.testing.assert_allclose(volume.box_mm, projections.box_mm)


def test_held_out_projections_are_left_out_unless_asked_for():
    projections = scan_balls(CONE, degrees(0, 360, 10))
    spoilt = projections.images.copy()
    spoilt[::4] = 100.0
    held_out = np.arange(len(spoilt)) % 4 == 0
    projections = replace(projections, images=spoilt, held_out=held_out)

    assert fdk(projections).values.max() < 0.15
    assert fdk(projections, subset=np.ones(len(spoilt), bool)).values.max() > 1.0


def test_hann_window_is_smoother():
    projections = scan_balls(CONE, degrees(0, 360, 5))
    noise = np.random.default_rng(0).normal(0, 0.05, projections.images.shape).astype(np.float32)
    noisy = replace(projections, images=projections.images + noise)

    assert np.diff(fdk(noisy, window="hann").values).std() < 0.6 * np.diff(fdk(noisy).values).std()


def test_mistakes_are_named():
    projections = scan_balls(CONE, degrees(0, 360, 60))
    with pytest.raises(CaptureError, match="at least two projections"):
        fdk(projections, subset=np.arange(6) == 0)
    with pytest.raises(SettingError, match="subset has shape"):
        fdk(projections, subset=np.ones(5, bool))
    with pytest.raises(SettingError, match="window is 'box'"):
        fdk(projections, window="box")
    lying = [replace(d, u=-d.v, v=d.u) for d in projections.detectors]
    with pytest.raises(CaptureError, match="do not turn about the z axis"):
        fdk(replace(projections, detectors=lying))


def test_what_rtk_refuses_is_a_mistake_of_the_capture():
    projections = scan_balls(CONE, degrees(0, 360, 60))
    aside = [replace(d, center=np.asarray(d.center) + 200 * np.asarray(d.u)) for d in projections.detectors]
    with pytest.raises(CaptureError, match=r"the FDK of 6 projections .* failed \(.*detector displacement"):
        fdk(replace(projections, detectors=aside))
    with pytest.raises(CaptureError, match="a volume of 90000 x 90000 x 90000 voxels does not fit into memory"):
        fdk(projections, voxels=(90_000, 90_000, 90_000))


def test_cancel_stops_it():
    class Stop(Exception):
        pass

    calls = []

    def listener(progress):
        calls.append(progress.fraction)
        if progress.fraction > 0:
            raise Stop

    with pytest.raises(Stop):
        fdk(scan_balls(CONE, degrees(0, 360, 10)), reporter=Reporter(listener))
    assert calls[-1] < 1.0


def test_coverage_tells_a_full_circle_from_a_short_scan():
    full = coverage(scan_balls(CONE, degrees(0, 360, 5)))
    short = coverage(scan_balls(CONE, degrees(0, 150, 5)))

    assert full["angular_range_deg"] == pytest.approx(360)
    assert full["enough"]
    assert short["angular_range_deg"] == pytest.approx(150)
    assert short["largest_gap_deg"] == pytest.approx(215)
    assert not short["enough"]
    assert coverage(scan_balls(PARALLEL, degrees(0, 180, 5)))["enough"]


def test_coverage_tells_when_the_box_leaves_the_detector():
    assert coverage(scan_balls(CONE, degrees(0, 360, 30)))["cut_off"] == 0
    assert coverage(scan_balls(replace(CONE, width=60), degrees(0, 360, 30)))["cut_off"] == 1
