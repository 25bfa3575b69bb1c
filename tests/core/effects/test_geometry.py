"""Detectors that are not where the files say: found to hundredths of a pixel, and left alone where they are right."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import shift as shifted
from skimage.registration import phase_cross_correlation

from insideout.core.effects import geometry
from insideout.core.effects.choose import look_at_rays, without_effects
from insideout.core.effects.look.reproject import moved
from insideout.core.effects.rays import RayEvidence
from insideout.core.effects.request import parse_effects
from insideout.core.errors import Cancelled
from insideout.core.evaluate.metrics import psnr
from insideout.core.progress import Reporter

VIEWS = 66


def true_detectors(offset_px=(0.0, 0.0), tilt_degrees=0.0, jitter_px=0.0, seed=0):
    """(detector, index) -> the detector as it stands."""
    shakes = jitter_px * np.random.default_rng(seed).standard_normal((VIEWS, 2))

    def true(detector, index):
        shift = (np.array(offset_px) + shakes[index]) * np.linalg.norm(detector.u)
        return moved([detector], shift[None], np.radians([tilt_degrees]))[0]

    return true, shakes


@pytest.fixture(scope="module")
def evidence_of(scans):
    """Evidence with these flaws, and how far each detector shakes, in pixels."""

    def make(photons=20_000, seed=0, **flaws):
        true, shakes = true_detectors(seed=seed, **flaws)
        return RayEvidence(scans.noisy(scans.ellipsoid_scan(true=true), photons, seed)), shakes

    return make


def pixels(projections, mm):
    return mm / np.linalg.norm(projections.detectors[0].u)


def away_from_true(volume, truth):
    """PSNR of a volume laid on another: where the object stands is a matter of the frame."""
    way = phase_cross_correlation(truth, volume, upsample_factor=50)[0]
    inner = np.s_[3:-3, 3:-3, 3:-3]
    return psnr(shifted(volume, way, order=3)[inner], truth[inner], 0.05)


def test_a_scan_as_its_files_say_is_left_alone(evidence_of, scans):
    evidence, _ = evidence_of()
    choice = look_at_rays(parse_effects(scans.auto_for("geometry")), evidence)
    (row,) = choice.rows
    assert row["found"] is False
    assert row["used"] is False
    assert row["strength"] < 0.05
    assert "does not matter" in row["reason"]
    assert without_effects(evidence.projections, choice.numbers) is evidence.projections


@pytest.mark.parametrize("photons", [20_000, 2000])
def test_offset_turn_and_shaking_are_measured_together(photons, evidence_of):
    evidence, shakes = evidence_of(photons, offset_px=(1.3, 0.0), tilt_degrees=0.4, jitter_px=0.3)
    found = geometry.detect(evidence)
    assert found.found is True
    assert "beside its place" in found.reason
    shift = pixels(evidence.projections, found.numbers["shift_mm"])
    assert shift[:, 0].mean() == pytest.approx(1.3 + shakes[:, 0].mean(), abs=0.05)
    assert np.degrees(found.numbers["tilt_rad"][0]) == pytest.approx(0.4, abs=0.06)
    # Along the columns a mean is the frame's.
    left = shift[:, 1] - (shakes[:, 1] - shakes[:60, 1].mean())
    assert left.std() < 0.05
    assert np.std(shift[:, 0] - shakes[:, 0]) < 0.12


def test_what_it_cost_is_won_back(evidence_of, scans):
    """Four fifths of the decibels of the FDK."""
    truth = RayEvidence(scans.ellipsoid_scan()).volume.values
    clean, _ = evidence_of()
    bad, _ = evidence_of(offset_px=(1.3, 0.4), tilt_degrees=0.4, jitter_px=0.3)
    found = geometry.detect(bad)
    mended = bad.after(geometry.corrected(bad.projections, found.numbers))
    best, worst, won = (away_from_true(one.volume.values, truth) for one in (clean, bad, mended))
    assert best - worst > 10
    assert won - worst > 0.8 * (best - worst)


@pytest.mark.parametrize("flaws", [{"offset_px": (0.12, 0.0)}, {"tilt_degrees": 0.15}, {"jitter_px": 0.1}])
def test_half_of_what_matters_is_none(flaws, evidence_of):
    evidence, _ = evidence_of(**flaws)
    assert geometry.detect(evidence).found is False


@pytest.mark.parametrize("flaws", [{"offset_px": (-0.5, 0.0)}, {"tilt_degrees": 1.0}, {"jitter_px": 0.4}])
def test_twice_what_matters_is_found(flaws, evidence_of):
    evidence, _ = evidence_of(**flaws)
    assert geometry.detect(evidence).found is True


def test_held_out_views_have_numbers_of_their_own_and_make_no_volume(evidence_of):
    evidence, shakes = evidence_of(jitter_px=0.4)
    held_out = evidence.projections.held_out
    shift = pixels(evidence.projections, geometry.detect(evidence).numbers["shift_mm"])
    assert np.abs((shift - shakes)[held_out][:, 1]).max() < 0.15
    other = evidence.projections.images.copy()
    other[held_out] = 0.0
    assert np.array_equal(
        RayEvidence(replace(evidence.projections, images=other)).volume.values, evidence.volume.values
    )


def test_numbers_found_in_blocks_of_pixels_hold_for_the_pixels(scans):
    true, _ = true_detectors(offset_px=(2.6, 0.0))
    projections = scans.noisy(scans.ellipsoid_scan(size=192, views=24, heldout=2, true=true, supersampled=1))
    evidence = RayEvidence(projections)
    assert evidence.block == 2
    assert evidence.views.images.shape[1:] == (96, 96)
    shift = pixels(projections, geometry.detect(evidence).numbers["shift_mm"])
    assert shift[:, 0].mean() == pytest.approx(2.6, abs=0.05)


@pytest.mark.parametrize("first", [0, 45], ids=["from 0 degrees", "from 270 degrees, through 0"])
def test_half_a_turn_cannot_tell(scans, first):
    whole = scans.ellipsoid_scan(views=60, heldout=0)
    used = np.sort((first + np.arange(30)) % 60)
    half = replace(
        whole, images=whole.images[used], detectors=[whole.detectors[i] for i in used], held_out=whole.held_out[used],
        angles_rad=whole.angles_rad[used],
    )  # fmt: skip
    found = geometry.detect(RayEvidence(half))
    assert found.found is None
    assert "180 degrees" in found.reason


def test_a_turn_of_which_every_eighth_view_is_held_out_is_a_whole_one(scans):
    scan = scans.ellipsoid_scan(views=33, heldout=0)
    held_out = np.arange(33) % 8 == 0
    assert geometry.detect(RayEvidence(replace(scan, held_out=held_out))).found is False


def test_too_few_views_cannot_tell(scans):
    evidence = RayEvidence(scans.ellipsoid_scan(views=12, heldout=0))
    found = geometry.detect(evidence)
    assert found.found is None
    assert "12 projections are too few" in found.reason
    choice = look_at_rays(parse_effects("geometry"), evidence)
    assert choice.rows[0]["used"] is False
    assert choice.rows[0]["reason"].endswith(" It is not used: it could not be measured.")
    assert without_effects(evidence.projections, choice.numbers) is evidence.projections


def test_a_user_may_ask_for_it_all_the_same(evidence_of):
    choice = look_at_rays(parse_effects("geometry"), evidence_of(offset_px=(0.15, 0.0))[0])
    (row,) = choice.rows
    assert row["found"] is False
    assert row["used"]
    assert row["chosen_by"] == "user"
    assert row["reason"].endswith("because you asked for it.")


def test_what_is_within_its_error_is_not_applied(evidence_of):
    evidence, _ = evidence_of(offset_px=(0.6, 0.0))
    numbers = geometry.detect(evidence).numbers
    assert np.ptp(numbers["shift_mm"], axis=0) == pytest.approx(0, abs=1e-12)
    assert not numbers["tilt_rad"].any()


def test_nothing_certain_is_nothing_to_take_out(evidence_of):
    (row,) = look_at_rays(parse_effects("geometry"), evidence_of()[0]).rows
    assert row["used"] is False
    assert row["reason"].endswith("There is nothing to take out.")


def test_pixels_that_are_not_square_turn_as_much(scans, monkeypatch):
    """Halved rows: a turn moves a pixel's width along the rows by half as many of its heights."""
    true, _ = true_detectors(tilt_degrees=1.0)
    fine = scans.ellipsoid_scan(size=96, views=32, heldout=0, true=true, supersampled=1)
    images = fine.images.reshape(32, 48, 2, 96).mean(axis=2)
    detectors = [replace(one, height=48, v=2 * np.asarray(one.v)) for one in fine.detectors]
    scan = scans.noisy(replace(fine, images=images, detectors=detectors), photons=100_000)
    tilt = geometry.detect(RayEvidence(scan)).numbers["tilt_rad"]
    assert np.degrees(tilt[0]) == pytest.approx(1.0, abs=0.1)


def test_large_detectors_are_told_of_no_less_than_their_blocks_can_show(evidence_of, monkeypatch):
    evidence, _ = evidence_of(offset_px=(0.6, 0.0))
    monkeypatch.setattr(RayEvidence, "block", 13)
    monkeypatch.setattr(RayEvidence, "views", evidence.projections)
    found = geometry.detect(evidence)
    assert found.found is False
    assert found.threshold == pytest.approx(1.3)


def test_places_that_do_not_make_views_agree_better_are_not_believed(evidence_of, monkeypatch):
    evidence, _ = evidence_of(offset_px=(0.6, 0.0))
    register = geometry.register
    monkeypatch.setattr(geometry, "register", lambda evidence: replace(register(evidence), gain=-0.1))
    found = geometry.detect(evidence)
    assert found.found is None
    assert "agree no better" in found.reason


def test_places_that_never_settle_are_not_believed(evidence_of, monkeypatch):
    evidence, _ = evidence_of(offset_px=(0.6, 0.0))
    register = geometry.register
    monkeypatch.setattr(geometry, "register", lambda evidence: replace(register(evidence), settled=False))
    found = geometry.detect(evidence)
    assert found.found is None
    assert "change with every look" in found.reason


def test_looking_can_be_cancelled(evidence_of):
    evidence = replace(evidence_of()[0], reporter=Reporter(is_cancelled=lambda: True))
    with pytest.raises(Cancelled):
        geometry.detect(evidence)


@pytest.mark.slow
def test_twenty_scans_with_it_and_twenty_without(evidence_of):
    for seed in range(20):
        assert geometry.detect(evidence_of(seed=seed, photons=5000)[0]).found is False
        flaws = {"offset_px": (0.6 * (-1) ** seed, 0.3), "tilt_degrees": 0.4, "jitter_px": 0.3}
        assert geometry.detect(evidence_of(seed=seed, photons=5000, **flaws)[0]).found is True
