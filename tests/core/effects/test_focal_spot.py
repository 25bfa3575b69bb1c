"""A wide focal spot is seen in edges that are wider near to the source, and what it blurs is sharpened."""

import subprocess
import sys
import textwrap
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from insideout.core.capture.detectors import CircularScan
from insideout.core.capture.model import Projections
from insideout.core.effects import focal_spot
from insideout.core.effects.choose import look_at_rays, without_effects
from insideout.core.effects.look.edge_widths import view_edges
from insideout.core.effects.rays import RayEvidence
from insideout.core.effects.request import parse_effects
from insideout.core.errors import Cancelled
from insideout.core.evaluate.metrics import psnr
from insideout.core.fdk_process import fdk, project
from insideout.core.progress import Reporter
from insideout.core.volume import Volume

SIZE = 64


def spot_scan(scans, sigma_px):
    """The ellipsoids from a spot whose half-shadow on the axis deviates by so much, by two points each way."""
    clean = scans.ellipsoid_scan(SIZE)
    if sigma_px == 0:
        return clean
    images = []
    for detector in clean.detectors:
        shown = sigma_px / (scans.DSD / scans.DSO - 1)
        arrived = []
        for x, y in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
            source = np.asarray(detector.source) + shown * (x * np.asarray(detector.u) + y * np.asarray(detector.v))
            arrived.append(np.exp(-scans.lines(scans.BODIES, replace(detector, source=source))))
        images.append(-np.log(np.mean(arrived, axis=0)))
    return replace(clean, images=np.stack(images).astype(np.float32))


@pytest.fixture(scope="module")
def clean(scans):
    return spot_scan(scans, 0.0)


@pytest.fixture(scope="module")
def wide(scans):
    return spot_scan(scans, 1.0)


def looked(scan):
    return focal_spot.detect(RayEvidence(scan))


def truth(scans):
    """Attenuation on the scan's own grid, voxels the mean of 2 x 2 x 2 places."""
    fine = (np.arange(2 * SIZE) + 0.5) / (2 * SIZE) * scans.BOX - scans.BOX / 2
    z, y, x = np.meshgrid(fine, fine, fine, indexing="ij")
    values = np.zeros_like(x)
    for body in scans.BODIES:
        cos, sin = np.cos(body.turn), np.sin(body.turn)
        away = x - body.center[0], y - body.center[1], z - body.center[2]
        turned = cos * away[0] + sin * away[1], cos * away[1] - sin * away[0], away[2]
        values += body.value * (sum((part / axis) ** 2 for part, axis in zip(turned, body.axes, strict=True)) < 1)
    return values.reshape(SIZE, 2, SIZE, 2, SIZE, 2).mean(axis=(1, 3, 5)).astype(np.float32)


@pytest.mark.parametrize("sigma", [0.5, 1.0, 1.5])
def test_widths_of_steps_and_of_round_outlines_are_told(sigma):
    fine = np.arange(960) / 10 + 0.05
    step = np.where(fine > 48.3, 1.0, 0.0)
    outline = np.sqrt(np.maximum(30.0**2 - (fine - 48.3) ** 2, 0.0)) / 30
    for profile in (step, outline):
        blurred = gaussian_filter(profile, 10 * sigma).reshape(96, 10).mean(axis=1)
        found = view_edges(np.broadcast_to(blurred, (96, 96)), 1.0)
        assert len(found.width2) > 80
        # A pixel is as wide as 1/12 px² by itself.
        assert np.median(found.width2) == pytest.approx(sigma**2 + 1 / 12, abs=0.15 + 0.1 * sigma**2)
        assert np.abs(found.across[:, 1]).min() > 0.99


def test_a_clean_scan_has_none(clean, scans):
    finding = looked(scans.noisy(clean))
    assert finding.found is False
    assert finding.strength < 0.4
    assert "does not matter" in finding.reason


def test_a_wide_spot_is_found_and_measured(wide, scans):
    finding = looked(scans.noisy(wide))
    assert finding.found is True
    assert finding.strength == pytest.approx(1.0, abs=0.25)
    pitch = np.linalg.norm(wide.detectors[0].u)
    assert finding.numbers["sigma_mm"] == pytest.approx(finding.strength * pitch)
    assert "focal spot" in finding.reason


def test_a_smooth_object_cannot_tell(clean, scans):
    """Half a millimetre of softness everywhere is seen as a pixel and a half: no wider near to the source than M."""
    values = gaussian_filter(np.repeat(np.repeat(np.repeat(truth(scans), 2, 0), 2, 1), 2, 2), 2.0)
    spacing = np.full(3, scans.BOX / (2 * SIZE))
    volume = Volume(values.astype(np.float32), spacing, -scans.BOX / 2 + spacing / 2)
    soft = replace(clean, images=project(volume, clean.detectors))
    finding = looked(scans.noisy(soft))
    assert finding.found is None
    assert "may be smooth" in finding.reason


def test_a_detector_that_smears_cannot_tell(clean, scans):
    smeared = -np.log(gaussian_filter(np.exp(-clean.images), (0, 1.0, 1.0)))
    finding = looked(scans.noisy(replace(clean, images=smeared)))
    assert finding.found is None
    assert finding.strength == pytest.approx(1.0, abs=0.25)
    assert finding.numbers["sigma_mm"] > 0


def test_what_a_gaussian_blurred_is_sharpened(clean):
    sigma = 0.8
    blurred = replace(clean, images=-np.log(gaussian_filter(np.exp(-clean.images), (0, sigma, sigma))))
    pitch = float(np.linalg.norm(clean.detectors[0].u))
    sharp = focal_spot.corrected(blurred, {"sigma_mm": sigma * pitch})
    before, after = (np.sqrt(np.mean((each.images - clean.images) ** 2)) for each in (blurred, sharp))
    assert after < 0.5 * before
    assert sharp.images.dtype == blurred.images.dtype


def plates_scan(scans, pixel_mm, boxes, sigma_mm):
    """16 views of boxes (low, high) by pixels that may be oblong, blurred by as much in all directions."""
    width, height = (round(32 / side) for side in pixel_mm)
    angles = 0.1 + np.arange(16) * np.pi / 8
    detectors, images = CircularScan(width, height, pixel_mm, scans.DSO, scans.DSD).detectors(angles), []
    for detector in detectors:
        origins, ways = scans.finer(detector, 2).rays()
        inside = 0.0
        for box in boxes:
            ends = np.sort([(np.array(corner) - origins) / ways for corner in box], axis=0)
            inside += np.maximum(ends[1].min(axis=-1) - ends[0].max(axis=-1), 0)
        arrived = np.exp(-0.05 * inside).reshape(height, 2, width, 2).mean(axis=(1, 3))
        images.append(-np.log(gaussian_filter(arrived, (sigma_mm / pixel_mm[1], sigma_mm / pixel_mm[0]))))
    return Projections(
        images=np.stack(images).astype(np.float32), detectors=detectors, held_out=np.zeros(16, bool),
        angles_rad=angles, box_mm=10.5 * np.array([[-1.0] * 3, [1.0] * 3]), voxels=(64, 64, 64),
        source_to_axis_mm=scans.DSO, source_to_detector_mm=scans.DSD,
    )  # fmt: skip


LYING = [((-8, -7, z - 1), (8, 7, z + 1)) for z in (-6, -2, 2, 6)]
STANDING = [((x - 1, y - 1, -8), (x + 1, y + 1, 8)) for x in (-6, 0, 6) for y in (-5, 5)]


@pytest.mark.parametrize("boxes", [LYING, STANDING], ids=["lying", "standing"])
@pytest.mark.parametrize("pixel_mm", [(0.4, 0.4), (0.2, 0.4), (0.4, 0.2)])
def test_a_blur_is_as_wide_by_pixels_that_are_not_square(pixel_mm, boxes, scans):
    """Of edges that nearly all lie, or stand: each is told in pixels of its own direction."""
    scan = plates_scan(scans, pixel_mm, boxes, 0.3)
    finding = looked(scans.noisy(scan))
    assert finding.numbers["sigma_mm"] == pytest.approx(0.33, abs=0.06)
    # Sharpened and blurred again it is what it was.
    sharp = focal_spot.corrected(scan, finding.numbers)
    assert np.abs(focal_spot.drawn(sharp.images[0], 0, sharp, finding.numbers) - scan.images[0]).max() < 0.1


def test_pixels_that_are_not_finite_stay_so_and_spoil_no_others(clean):
    images = clean.images[:2].copy()
    images[0, 5, 7] = np.nan
    broken = replace(
        clean,
        images=images,
        detectors=clean.detectors[:2],
        held_out=clean.held_out[:2],
        angles_rad=clean.angles_rad[:2],
    )
    sharp = focal_spot.corrected(broken, {"sigma_mm": 0.5}).images
    assert np.isnan(sharp[0, 5, 7])
    assert np.isfinite(sharp).sum() == sharp.size - 1
    whole = focal_spot.corrected(replace(broken, images=clean.images[:2]), {"sigma_mm": 0.5}).images
    np.testing.assert_allclose(np.nan_to_num(sharp[0]), np.where(np.isnan(sharp[0]), 0, whole[0]), atol=0.05)


def test_held_out_views_have_no_say(clean):
    worse = np.where(clean.held_out[:, None, None], clean.images[::-1] ** 2, clean.images)
    assert looked(replace(clean, images=worse)).strength == looked(clean).strength


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda scan: replace(scan, held_out=np.arange(len(scan.images)) > 9), "pairs of opposite views are too few"),
        (lambda scan: replace(scan, images=0 * scan.images), "edges are too few"),
        (lambda scan: replace(scan, detectors=[replace(d, parallel=True) for d in scan.detectors]), "parallel beam"),
    ],
)
def test_what_cannot_tell(change, says, clean):
    finding = looked(change(clean))
    assert finding.found is None
    assert says in finding.reason


def test_asked_for_by_name_it_is_taken_out_where_the_object_may_be_smooth(clean, scans):
    smeared = replace(clean, images=-np.log(gaussian_filter(np.exp(-clean.images), (0, 1.0, 1.0))))
    for asked, used in ((scans.auto_for("focal_spot"), False), ("focal_spot", True)):
        choice = look_at_rays(parse_effects(asked), RayEvidence(smeared))
        (row,) = choice.rows
        assert (row["found"], row["used"]) == (None, used)
        assert (without_effects(smeared, choice.numbers) is smeared) is not used


def test_looking_can_be_cancelled(clean):
    with pytest.raises(Cancelled):
        focal_spot.detect(RayEvidence(clean, reporter=Reporter(is_cancelled=lambda: True)))


def test_who_does_not_ask_for_it_loads_nothing_of_it(clean):
    """In a process of its own, where no other test has loaded it."""
    code = """
        import sys
        from insideout.core.effects.choose import look_at_rays, without_effects
        from insideout.core.effects.request import parse_effects
        import insideout.core.stages.surface, insideout.core.stages.initialize
        assert not parse_effects("auto,-focal_spot").wants("focal_spot")
        sys.exit(any("focal_spot" in name or "edge_widths" in name for name in sys.modules))
    """
    assert subprocess.run([sys.executable, "-c", textwrap.dedent(code)], check=False).returncode == 0
    assert without_effects(clean, {}) is clean


@pytest.mark.slow
@pytest.mark.parametrize("found", [False, True])
def test_twenty_seeds(found, clean, wide, scans):
    scan = wide if found else clean
    right = [looked(scans.noisy(scan, 50_000, seed)).found is found for seed in range(20)]
    assert np.mean(right) >= 0.95


@pytest.mark.slow
def test_an_fdk_wins_back_most_of_what_a_spot_of_half_a_pixel_costs(clean, scans):
    values = truth(scans)

    def quality(scan):
        return psnr(fdk(scan, window="hann").values, values, float(values.max()))

    blurred = scans.noisy(spot_scan(scans, 0.5))
    sharp = focal_spot.corrected(blurred, {"sigma_mm": 0.5 * float(np.linalg.norm(clean.detectors[0].u))})
    best, worst = quality(scans.noisy(clean)), quality(blurred)
    assert best - worst > 1
    assert quality(sharp) - worst > 0.6 * (best - worst)


def test_what_is_drawn_is_as_blurred_as_what_was_sharpened(clean):
    numbers = {"sigma_mm": 0.7 * float(np.linalg.norm(clean.detectors[0].u))}
    wide = [focal_spot.drawn(image, view, clean, numbers) for view, image in enumerate(clean.images)]
    blurred = replace(clean, images=np.stack(wide))
    sharp = focal_spot.corrected(blurred, numbers)
    again = focal_spot.drawn(sharp.images[0], 0, sharp, numbers)
    edges = np.abs(blurred.images[0] - clean.images[0]).max()
    assert np.abs(again - blurred.images[0]).max() < 0.1 * edges


def test_of_line_integrals_in_another_unit_it_cannot_be_told(wide):
    """Asked for by name, too: all that is dark would become equally dark."""
    scan = replace(wide, images=1000 * wide.images)
    finding = looked(scan)
    assert (finding.found, finding.strength, finding.numbers) == (None, None, {})
    assert "another unit" in finding.reason
    choice = look_at_rays(parse_effects("focal_spot"), RayEvidence(scan))
    assert without_effects(scan, choice.numbers) is scan


def test_black_pixels_stay_as_black_and_finite(clean):
    """Behind p = 746 light is no number in double precision; behind 27 no scanner counts any."""
    few = replace(clean, images=clean.images[:3])
    scan = replace(few, images=few.images.copy())
    numbers = {"sigma_mm": 0.7 * float(np.linalg.norm(scan.detectors[0].u))}
    scan.images[2, 24:40, 24:40], scan.images[2, 30:33, 30:33] = 60.0, 900.0
    sharp = focal_spot.corrected(scan, numbers).images
    assert np.isfinite(sharp).all()
    assert sharp[2, 28:36, 28:36].min() > 50
    beside = np.abs(focal_spot.corrected(few, numbers).images - sharp)[2]
    beside[14:50, 14:50] = 0
    assert beside.max() < 1e-3
    assert np.isfinite(focal_spot.drawn(scan.images[2], 2, scan, numbers)).all()
