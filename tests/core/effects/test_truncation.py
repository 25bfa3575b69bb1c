"""An object that is wider than the detector is found by the rule of `insideout check`, and rows go on for the FDK."""

from dataclasses import replace

import numpy as np
import pytest

from insideout.core.capture.detectors import CircularScan
from insideout.core.effects import truncation
from insideout.core.effects.choose import look_at_rays, without_effects
from insideout.core.effects.rays import RayEvidence
from insideout.core.effects.request import parse_effects
from insideout.core.evaluate.metrics import psnr

# Columns of 64 that see less than the body from all sides, and a little less from some.
NARROW, NEARLY = 28, 46


@pytest.fixture(scope="module")
def whole(scans):
    return scans.ellipsoid_scan()


def narrowed(scan, columns, first=None):
    """The scan as a detector with fewer columns has it; those about the middle, or from `first` on."""
    width = scan.images.shape[2]
    first = (width - columns) // 2 if first is None else first
    aside = first + 0.5 * (columns - width)
    detectors = [replace(one, width=columns, center=one.center + aside * one.u) for one in scan.detectors]
    return replace(scan, images=scan.images[:, :, first : first + columns], detectors=detectors)


def looked(scan, asked="truncation"):
    return look_at_rays(parse_effects(asked), RayEvidence(scan))


@pytest.mark.parametrize(("columns", "found"), [(64, False), (NEARLY, True), (NARROW, True)])
def test_found_where_the_shadow_reaches_the_ends(columns, found, whole, scans):
    (row,) = looked(scans.noisy(narrowed(whole, columns)), scans.auto_for("truncation")).rows
    assert (row["found"], row["used"]) == (found, found)
    assert row["threshold"] == 5
    assert (row["strength"] > 5) == found
    assert "in " + f"{row['strength']:.0f} % of the projections" in row["reason"]


def field_of_view(scan, truth):
    """(z, y, x) bool: voxels that every view sees."""
    half = 0.5 * scan.detectors[0].width * np.linalg.norm(scan.detectors[0].u)
    radius = scan.source_to_axis_mm * half / np.hypot(scan.source_to_detector_mm, half)
    y, x = (truth.origin_mm[k] + truth.spacing_mm[k] * np.arange(truth.values.shape[2 - k]) for k in (1, 0))
    return np.broadcast_to(np.hypot(x, y[:, None]) < 0.97 * radius, truth.values.shape)


def true_values(scans, volume, fine=3):
    """(z, y, x) mm⁻¹ of the bodies, means over the voxels."""
    total = np.zeros(volume.values.shape)
    steps = (np.arange(fine) + 0.5) / fine - 0.5
    axes = [volume.origin_mm[k] + volume.spacing_mm[k] * np.arange(volume.values.shape[2 - k]) for k in range(3)]
    for shift in np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3) * volume.spacing_mm:
        z, y, x = np.meshgrid(*(axes[k] + shift[k] for k in (2, 1, 0)), indexing="ij")
        for body in scans.BODIES:
            cos, sin = np.cos(body.turn), np.sin(body.turn)
            away = [x - body.center[0], y - body.center[1], z - body.center[2]]
            along = [cos * away[0] + sin * away[1], cos * away[1] - sin * away[0], away[2]]
            total += body.value * (sum((a / b) ** 2 for a, b in zip(along, body.axes, strict=True)) < 1)
    return total / fine**3


def turned(scan, degrees):
    """The scan as its files have it when the detector is said to be turned; each pixel is where it was, nearly."""
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    detectors = [replace(one, u=cos * one.u + sin * one.v, v=cos * one.v - sin * one.u) for one in scan.detectors]
    return replace(scan, detectors=detectors)


@pytest.mark.parametrize(("columns", "degrees"), [(NARROW, 0.0), (36, 0.0), (36, 0.4)])
def test_four_fifths_of_what_it_cost_are_won_back(columns, degrees, whole, scans):
    narrow = turned(narrowed(whole, columns), degrees)
    goes_on = without_effects(narrow, looked(narrow).numbers)
    volumes = [RayEvidence(scans.noisy(scan)).volume for scan in (whole, narrow, goes_on)]
    seen, truth = field_of_view(narrow, volumes[0]), true_values(scans, volumes[0])
    best, worst, won = (psnr(volume.values[seen], truth[seen], 0.05) for volume in volumes)
    assert best - worst > 3
    assert won - worst > 0.8 * (best - worst)


def test_what_was_measured_stays_as_it_was(whole):
    narrow = narrowed(whole, NARROW)
    goes_on = without_effects(narrow, looked(narrow).numbers)
    assert goes_on.images is narrow.images
    assert goes_on.detectors is narrow.detectors
    assert RayEvidence(goes_on).reprojected.shape == narrow.images.shape


def test_what_cut_off_views_add_up_to_is_no_hardened_beam(whole, scans):
    asked = scans.auto_for("truncation", "beam_hardening")
    rows = {row["name"]: row for row in looked(narrowed(whole, NEARLY), asked).rows}
    assert rows["truncation"]["used"] is True
    assert rows["beam_hardening"]["found"] is None
    assert "leaves the detector" in rows["beam_hardening"]["reason"]


@pytest.mark.parametrize("auto", [False, True])
def test_nor_where_nobody_asks_for_truncation(auto, whole, scans):
    asked = scans.auto_for("beam_hardening") if auto else "beam_hardening"
    rows = {row["name"]: row for row in looked(narrowed(whole, NEARLY), asked).rows}
    assert rows["beam_hardening"]["found"] is None
    assert "leaves the detector" in rows["beam_hardening"]["reason"]


def test_where_no_row_is_cut_off_there_is_nothing_to_go_on_with(whole):
    (row,) = looked(whole).rows
    assert row["used"] is False
    assert row["reason"].endswith("There is nothing to take out.")


def test_a_detector_that_is_set_off_sees_the_rest_from_the_other_side(whole):
    (row,) = looked(narrowed(whole, 40, first=24)).rows
    assert (row["found"], row["used"]) == (None, False)
    assert "opposite one" in row["reason"]


def test_a_single_projection_cannot_tell_and_ends_no_search(whole):
    """Of a folder with one projection and a volume, say."""
    one = replace(
        whole, images=whole.images[:1], detectors=whole.detectors[:1], held_out=whole.held_out[:1],
        angles_rad=whole.angles_rad[:1],
    )  # fmt: skip
    for row in looked(one, "auto").rows:
        assert (row["found"], row["used"]) == (None, False)
    assert "too few projections" in looked(one).rows[0]["reason"]


def test_a_short_scan_is_refused(whole):
    kept = whole.angles_rad < np.radians(230)
    some = replace(
        whole, images=whole.images[kept], detectors=[whole.detectors[i] for i in np.flatnonzero(kept)],
        held_out=whole.held_out[kept], angles_rad=whole.angles_rad[kept],
    )  # fmt: skip
    (row,) = looked(narrowed(some, NARROW)).rows
    assert (row["found"], row["used"]) == (None, False)
    assert "short scan" in row["reason"]


def test_half_a_turn_of_a_parallel_beam_goes_on_too(scans, whole):
    angles = np.arange(60) * np.pi / 60
    detectors = CircularScan(64, 64, (0.5, 0.5), 200.0, 300.0, parallel=True).detectors(angles)
    images = np.stack([scans.lines(scans.BODIES, one) for one in detectors]).astype(np.float32)
    scan = replace(whole, images=images, detectors=detectors, held_out=np.zeros(60, bool), angles_rad=angles)
    narrow = narrowed(scan, NARROW)
    full, cut, mended = (
        RayEvidence(one).volume.values[32, 29:35, 29:35].mean()
        for one in (scan, narrow, without_effects(narrow, looked(narrow).numbers))
    )
    assert abs(mended - full) < 0.2 * abs(cut - full)


def test_held_out_views_have_no_say(whole):
    images = np.where(whole.held_out[:, None, None], whole.images.max(), whole.images)
    assert looked(replace(whole, images=images)).rows[0]["strength"] == 0


@pytest.mark.slow
@pytest.mark.parametrize("found", [True, False])
def test_twenty_seeds(found, whole, scans):
    scan = narrowed(whole, NEARLY if found else 64)
    seen = [truncation.detect(RayEvidence(scans.noisy(scan, 2000, seed))) for seed in range(20)]
    assert np.mean([one.found is found for one in seen]) >= 0.95
