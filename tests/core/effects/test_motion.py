"""An object that moves during the scan: told from a detector that is off, and taken out."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import shift as shifted
from scipy.spatial.transform import Rotation
from skimage.registration import phase_cross_correlation

from insideout.core.capture.model import Projections
from insideout.core.effects import geometry, motion
from insideout.core.effects.choose import look_at_rays, without_effects
from insideout.core.effects.look.reproject import moved
from insideout.core.effects.look.settling import _Search
from insideout.core.effects.look.trajectory import Motion, acquired
from insideout.core.effects.rays import RayEvidence
from insideout.core.effects.request import parse_effects
from insideout.core.errors import Cancelled
from insideout.core.evaluate.metrics import psnr
from insideout.core.phantoms.flaws import plan_flaws, project_truly, true_detectors
from insideout.core.phantoms.make import PHANTOMS
from insideout.core.phantoms.part_tables import PartTables
from insideout.core.phantoms.scanner import scan_geometry, voxels
from insideout.core.phantoms.settings import CaptureSettings
from insideout.core.phantoms.spectrum import monochromatic
from insideout.core.phantoms.truth import truth_volume
from insideout.core.progress import Reporter

VIEWS, HELD, SIZE, REACH = 40, 4, 48, 10.0


def path_of(projections, px, slip=0.0, seed=0):
    """It slides and turns by so many pixels, what is 10 mm off as far as the middle, and slips `slip` of the way at
    three fifths; 0 on average over the training views."""
    time = np.mod(projections.angles_rad, 2 * np.pi) / (2 * np.pi)
    share = (1 - slip) * (0.5 - 0.5 * np.cos(np.pi * time)) + slip * (time > 0.6)
    share = share - share[~projections.held_out].mean()
    way, axis = (each / np.linalg.norm(each) for each in np.random.default_rng(seed).standard_normal((2, 3)))
    far = px * projections.pixel_mm * share[:, None]
    return Motion(far * way, far * axis / REACH, np.zeros(3))


@pytest.fixture(scope="module")
def scanned(scans):
    """A scan with counting noise of an object that moves `px` pixels, by a detector that is off and shakes."""

    def make(px=0.0, slip=0.0, photons=20_000, seed=0, offset_px=0.0, tilt_degrees=0.0, jitter_px=0.0):
        plain = scans.ellipsoid_scan(size=SIZE, views=VIEWS, heldout=HELD, supersampled=1)
        path = path_of(plain, px, slip, seed)
        shake = jitter_px * np.random.default_rng(seed).standard_normal((VIEWS + HELD, 2))

        def true(detector, index):
            shift = (shake[index] + [offset_px, 0.0]) * np.linalg.norm(detector.u)
            off = moved([detector], shift[None], np.radians([tilt_degrees]))
            return path.at(np.array([index])).seen_by(off)[0]

        scan = scans.ellipsoid_scan(size=SIZE, views=VIEWS, heldout=HELD, supersampled=2, true=true)
        return scans.noisy(scan, photons, seed), path

    return make


@pytest.fixture(scope="module")
def slid(scanned):
    """A scan of an object that slides, turns and slips by three pixels, its path, and what was found."""
    scan, path = scanned(3.0, slip=0.4)
    return scan, path, motion.detect(RayEvidence(scan))


def away_from(volume, truth, peak=0.05):
    """PSNR of a volume laid on another: where the object stood is a matter of the frame."""
    way = phase_cross_correlation(truth, volume, upsample_factor=50, normalization=None)[0]
    inner = np.s_[3:-3, 3:-3, 3:-3]
    return psnr(shifted(volume, way, order=3)[inner], truth[inner], peak)


def test_an_object_that_stands_still_is_left_alone(scanned, scans):
    evidence = RayEvidence(scanned()[0])
    choice = look_at_rays(parse_effects(scans.auto_for("motion")), evidence)
    (row,) = choice.rows
    assert row["found"] is False
    assert row["used"] is False
    assert row["strength"] < 0.35
    assert "does not matter" in row["reason"]
    assert without_effects(evidence.projections, choice.numbers) is evidence.projections


def test_a_slide_a_turn_and_a_slip_are_found_together(slid):
    scan, path, found = slid
    assert found.found is True
    assert 1.5 < found.strength < 4.5
    assert "at once" in found.reason
    # What a view shows of it, in pixels at 8 mm from the middle; a shift of the whole path is the frame's.
    points = 8.0 * np.vstack([np.eye(3), -np.eye(3)])
    told = Motion(*(found.numbers[name] for name in ("shift_mm", "turn_rad", "middle_mm")))
    steps = [np.cross(one.turn_rad[:, None], points) + one.shift_mm[:, None] for one in (told, path)]
    held = scan.held_out
    for views in (~held, held):
        beside = (steps[0] - steps[1])[views] / scan.pixel_mm
        assert np.sqrt((beside**2).mean()) < 0.35 * np.sqrt((steps[1][views] ** 2).mean()) / scan.pixel_mm
    np.testing.assert_allclose(told.shift_mm[~held].mean(axis=0), 0, atol=1e-9)


def test_what_it_cost_is_won_back(slid, scanned, scans):
    """Four fifths of the decibels of the FDK, and a detector in its place is not taken to be off afterwards."""
    scan, _, found = slid
    truth, mended = scans.true_volume(SIZE), motion.corrected(scan, found.numbers)
    best, worst, won = (away_from(RayEvidence(one).volume.values, truth) for one in (scanned()[0], scan, mended))
    assert best - worst > 3
    assert won - worst > 0.8 * (best - worst)
    assert geometry.detect(RayEvidence(mended)).found is False


@pytest.mark.parametrize(
    "flaws", [{"offset_px": 1.3}, {"tilt_degrees": 1.0}, {"offset_px": 1.0, "tilt_degrees": 0.4, "jitter_px": 0.3}]
)
def test_a_detector_that_is_off_or_shakes_is_no_motion(flaws, scanned):
    scan, _ = scanned(**flaws)
    assert motion.detect(RayEvidence(scan)).found is not True
    assert geometry.detect(RayEvidence(scan)).found is True


def test_both_are_told_apart_in_one_scan(scanned, scans):
    scan, _ = scanned(3.0, jitter_px=0.4)
    rows = {
        row["name"]: row
        for row in look_at_rays(parse_effects(scans.auto_for("motion", "geometry")), RayEvidence(scan)).rows
    }
    assert rows["motion"]["found"] is True
    assert rows["geometry"]["found"] is True
    assert rows["geometry"]["strength"] == pytest.approx(0.4, abs=0.12)


def test_rings_and_a_hardened_beam_are_no_motion(scanned):
    scan, _ = scanned()
    uneven = 0.01 * np.random.default_rng(0).standard_normal(scan.images.shape[1:])
    soft = -np.log(0.5 * np.exp(-1.4 * scan.images) + 0.5 * np.exp(-0.6 * scan.images))
    for images in (scan.images + uneven, soft):
        assert motion.detect(RayEvidence(replace(scan, images=images.astype(np.float32)))).found is not True


def test_held_out_views_have_no_say(slid):
    scan, _, found = slid
    images = scan.images.copy()
    images[scan.held_out] = 0.0
    other = motion.detect(RayEvidence(replace(scan, images=images)))
    np.testing.assert_array_equal(other.numbers["shift_mm"], found.numbers["shift_mm"])


def test_what_cannot_tell_says_why(scans):
    scan = scans.ellipsoid_scan(size=24, views=24, heldout=0, supersampled=1)

    def some(used):
        used = np.asarray(used)
        parts = {"images": scan.images[used], "angles_rad": scan.angles_rad[used], "held_out": scan.held_out[used]}
        return replace(scan, detectors=[scan.detectors[index] for index in used], **parts)

    cases = {
        "do not follow each other": some(np.random.default_rng(0).permutation(24)),
        "12 projections are too few": some(range(0, 24, 2)),
        "too narrow": replace(scan, beyond=0.5),
    }
    fine = scans.ellipsoid_scan(size=24, views=40, heldout=0, supersampled=1)
    half = np.arange(20)
    cases["180 degrees"] = replace(
        fine, images=fine.images[half], angles_rad=fine.angles_rad[half], held_out=fine.held_out[half],
        detectors=fine.detectors[:20],
    )  # fmt: skip
    for reason, projections in cases.items():
        found = motion.detect(RayEvidence(projections))
        assert found.found is None
        assert reason in found.reason
    parallel = replace(scan, detectors=[replace(one, parallel=True) for one in scan.detectors])
    assert "parallel" in motion.detect(RayEvidence(parallel)).reason


def test_a_search_in_blocks_of_pixels_ends_as_early_as_one_in_pixels(scans, monkeypatch):
    """A twentieth of a pixel is nothing that blocks of twelve could show: it would never settle."""
    scan, steps = scans.ellipsoid_scan(size=24, views=24, heldout=0, supersampled=1), []
    for block in (1, 2):
        monkeypatch.setattr(RayEvidence, "block", block)
        search = _Search(RayEvidence(scan), acquired(scan))
        numbers = search.nothing()
        slid = len(numbers[:-2]) // 6
        numbers[:slid] = np.linspace(-1.0, 1.0, slid)
        steps.append(search.seen_px(numbers, search.volume(search.nothing())))
    assert steps[1] == pytest.approx(0.5 * steps[0], rel=0.1)


def narrowed(scan, first, last):
    """The scan as a detector has it that begins and ends at these columns."""
    aside = 0.5 * (first + last - scan.images.shape[2])
    detectors = [replace(one, width=last - first, center=one.center + aside * one.u) for one in scan.detectors]
    return replace(scan, images=scan.images[:, :, first:last], detectors=detectors)


def test_an_object_cut_off_at_both_sides_cannot_tell_whoever_takes_truncation_out(scans):
    narrow = narrowed(scans.ellipsoid_scan(size=48, views=24, heldout=0, supersampled=1), 14, 34)
    for asked in ("motion", scans.auto_for("motion"), scans.auto_for("motion", "truncation")):
        row = next(
            row for row in look_at_rays(parse_effects(asked), RayEvidence(narrow)).rows if row["name"] == "motion"
        )
        assert (row["found"], row["used"]) == (None, False)
        assert "too narrow" in row["reason"]


def test_a_detector_that_is_set_off_to_see_more_is_not_too_narrow(scans):
    """Opposite views have the rest, and the FDK weighs them."""
    half = narrowed(scans.ellipsoid_scan(size=48, views=24, heldout=0, supersampled=1), 18, 48)
    evidence = RayEvidence(half)
    assert evidence.cut_off > 0.05
    assert "too narrow" not in motion.detect(evidence).reason


def test_a_small_object_is_judged_by_points_of_its_own(scans):
    """A ball a tenth as wide as the box fills a two-thousandth of it."""
    ball = scans.Ellipsoid((3, 1, -2), (1.6, 1.6, 1.6), 0.0, 0.2)
    scan = scans.ellipsoid_scan(size=48, views=24, heldout=0, bodies=[ball], supersampled=1)
    search = _Search(RayEvidence(scan), acquired(scan))
    volume = search.volume(search.nothing())
    assert (volume.values > 0).mean() < 0.005
    far = np.zeros((24, 6))
    far[:, 5] = search._reach
    # A radian about the axis moves what is near to it little.
    turned = search._seen(far, volume)
    assert np.linalg.norm(turned, axis=-1).max() * scan.pixel_mm < 8.0


@pytest.mark.parametrize("height", [1, 4])
def test_a_detector_of_few_rows_cannot_tell(height, scans):
    """Of a view of six rows nothing is left once its borders are cut off."""
    scan = scans.ellipsoid_scan(size=24, views=24, heldout=0, supersampled=1)
    first = 12 - height // 2
    detectors = [replace(one, height=height) for one in scan.detectors]
    evidence = RayEvidence(replace(scan, images=scan.images[:, first : first + height], detectors=detectors))
    for effect in (motion, geometry):
        found = effect.detect(evidence)
        assert (found.found, found.strength) == (None, None)
        assert f"24 x {height} pixels are too small" in found.reason


def test_looking_can_be_cancelled(scans):
    evidence = RayEvidence(
        scans.ellipsoid_scan(size=24, views=24, heldout=0, supersampled=1), Reporter(is_cancelled=lambda: True)
    )
    with pytest.raises(Cancelled):
        motion.detect(evidence)


def test_held_out_views_at_the_end_were_taken_when_their_angle_passed(scans):
    scan = scans.ellipsoid_scan(size=24, views=24, heldout=5, supersampled=1)
    times = acquired(scan)
    assert times[0] == 0
    assert times[23] == 1
    turn = 2 * np.pi * 23 / 24
    np.testing.assert_allclose(times, np.minimum(scan.angles_rad / turn, 1.0), atol=1e-12)
    backwards = replace(scan, angles_rad=-scan.angles_rad)
    np.testing.assert_allclose(acquired(backwards), times, atol=1e-12)


@pytest.mark.parametrize(("views", "held", "turn"), [(50, 50, np.pi), (50, 50, 2 * np.pi), (75, 25, 2 * np.pi)])
@pytest.mark.parametrize("way", [1, -1])
def test_many_held_out_views_at_the_end_are_no_second_turn(views, held, turn, way, scans):
    """Of NAF and R²-Gaussian: sorted random angles, the first of which often are a small step on from the last view."""
    scan = scans.ellipsoid_scan(size=4, views=views, heldout=held, supersampled=1)
    training = np.arange(views) * turn / views
    for seed in range(20):
        kept_back = np.sort(np.random.default_rng(seed).uniform(0, turn, held))
        angles = np.append(training, kept_back)
        times = acquired(replace(scan, angles_rad=way * angles))
        np.testing.assert_allclose(times, np.minimum(angles / training[-1], 1.0), atol=1e-12)


def test_held_out_views_at_the_end_that_the_scan_goes_on_with_were_taken_last(scans):
    scan = scans.ellipsoid_scan(size=4, views=20, heldout=4, supersampled=1)
    angles = np.arange(24) * 2 * np.pi / 24
    np.testing.assert_allclose(acquired(replace(scan, angles_rad=angles))[19:], 1.0)


@pytest.mark.parametrize("more_deg", [0.0, 5.0])
def test_a_turn_with_both_ends_or_a_little_more_is_one_turn(scans, more_deg):
    """Of 24 steps each; whether 2π is below 2π hangs on rounding."""
    scan = scans.ellipsoid_scan(size=24, views=25, heldout=5, supersampled=1)
    end, kept_back = 2 * np.pi + np.radians(more_deg), np.array([0.5, 2.0, 3.0, 4.0, 6.0])
    for first in np.linspace(0.0, 3.0, 7):
        angles = np.append(first + np.linspace(0.0, end, 25), first + kept_back)
        times = acquired(replace(scan, angles_rad=angles))
        np.testing.assert_allclose(times[:25], np.linspace(0, 1, 25), atol=1e-12)
        np.testing.assert_allclose(times[25:], kept_back / end, atol=1e-12)


@pytest.mark.parametrize(("step_deg", "why"), [(30.0, "more than one turn"), (137.5, "do not follow each other")])
def test_the_reason_why_it_is_not_known_when_views_were_taken(scans, step_deg, why):
    scan = scans.ellipsoid_scan(size=24, views=24, heldout=4, supersampled=1)
    angles = np.append(np.radians(step_deg) * np.arange(24), np.radians([40.0, 80.0, 200.0, 300.0]))
    finding = motion.detect(RayEvidence(replace(scan, angles_rad=angles)))
    assert finding.found is None
    assert why in finding.reason


def test_times_follow_angles_that_go_one_way(scans):
    scan = scans.ellipsoid_scan(size=24, views=24, heldout=0, supersampled=1)
    twice = np.arange(24) * np.radians(30.0)
    every = replace(scan, angles_rad=np.mod(twice + 5.0, 2 * np.pi), held_out=np.arange(24) % 8 == 3)
    np.testing.assert_allclose(acquired(every), np.linspace(0, 1, 24), atol=1e-12)
    golden = replace(scan, angles_rad=np.mod(np.arange(24) * np.radians(137.5), 2 * np.pi))
    assert acquired(golden) is None
    # In which of two turns was a view taken that stands at the end?
    assert acquired(replace(every, held_out=np.arange(24) >= 20, angles_rad=np.append(twice[:20], twice[3:7]))) is None


def test_a_scanner_moved_against_the_object_sees_the_same(scans):
    scan = scans.ellipsoid_scan(size=24, views=3, heldout=0, supersampled=1)
    path = Motion(np.array([[1.0, 2.0, -1.0]] * 3), np.array([[0.1, -0.2, 0.3]] * 3), np.array([1.0, 0.0, 2.0]))
    for still, seen in zip(scan.detectors, path.seen_by(scan.detectors), strict=True):
        origins, directions = seen.rays()
        # A point of the object goes along: it meets the same pixel of the scanner that stands.
        point = origins[3, 5] + 190.0 * directions[3, 5]
        turned = Rotation.from_rotvec(path.turn_rad[0]).apply(point - path.middle_mm)
        turned += path.middle_mm + path.shift_mm[0]
        start, along = (part[3, 5] for part in still.rays())
        assert np.linalg.norm(np.cross(turned - start, along)) < 1e-9


@pytest.mark.slow
def test_twenty_scans_with_it_and_twenty_without(scanned):
    for seed in range(20):
        assert motion.detect(RayEvidence(scanned(seed=seed)[0])).found is False
        scan, _ = scanned(1.5, slip=0.4 * (seed % 2), seed=seed)
        assert motion.detect(RayEvidence(scan)).found is True


@pytest.mark.slow
def test_a_terracotta_that_slides_tips_and_slips(scans):
    """50 views 72 pixels high, 3 px: 24.6 dB of the true volume under a Hann window become 27.3; clean 27.5."""
    phantom = PHANTOMS["terracotta"]()
    tables, scan = PartTables.bake(phantom, 0.6), scan_geometry(phantom, 60, 72)
    angles, grid = np.arange(50) * 2 * np.pi / 50, voxels(phantom, 1.5)
    half = 0.75 * np.array(grid)
    settings = CaptureSettings(projections=50, detector_width=60, detector_height=72, drift_px=3.0)

    def taken(*effects):
        flaws = plan_flaws(replace(settings, effects=effects), scan, angles, np.random.default_rng(0))
        beam = monochromatic(phantom.energy_kev)
        plain = Projections(
            project_truly(tables, true_detectors(scan, angles, flaws), beam, flaws), scan.detectors(angles),
            np.zeros(50, bool), angles, np.stack([-half, half]), grid, scan.source_to_axis_mm,
            scan.source_to_detector_mm,
        )  # fmt: skip
        return scans.noisy(plain)

    truth = truth_volume(phantom, tables, 1.5).values
    clean, moving = taken(), taken("motion")
    assert motion.detect(RayEvidence(clean)).found is False
    found = motion.detect(RayEvidence(moving))
    assert found.found is True
    scanned = clean, moving, motion.corrected(moving, found.numbers)
    best, worst, won = (away_from(RayEvidence(one).volume.values, truth, truth.max()) for one in scanned)
    assert best - worst > 2
    assert won - worst > 0.8 * (best - worst)
