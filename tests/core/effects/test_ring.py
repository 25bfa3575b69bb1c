"""Pixels that answer unevenly are seen in what is odd in the mean view, whatever the object."""

from dataclasses import replace

import numpy as np
import pytest

from insideout.core.effects import ring
from insideout.core.effects.choose import look_at_rays, without_effects
from insideout.core.effects.look.reproject import moved
from insideout.core.effects.rays import RayEvidence
from insideout.core.effects.request import parse_effects
from insideout.core.errors import Cancelled
from insideout.core.progress import Reporter


@pytest.fixture(scope="module")
def clean(scans):
    return scans.ellipsoid_scan(supersampled=1)


def uneven(scan, share, seed=0):
    """The scan by pixels whose gains deviate by so much."""
    gains = 1 + share * np.random.default_rng(seed).standard_normal(scan.images.shape[1:])
    return replace(scan, images=(scan.images - np.log(gains)).astype(np.float32))


def looked(scan):
    return ring.detect(RayEvidence(scan))


@pytest.mark.parametrize(("share", "found"), [(0.0, False), (0.0005, False), (0.005, True), (0.02, True)])
def test_found_from_a_thousandth_of_the_peak(share, found, clean, scans):
    scan = scans.noisy(uneven(clean, share))
    finding = looked(scan)
    assert finding.found is found
    assert finding.strength == pytest.approx(100 * share / scan.images.max(), rel=0.12, abs=0.06)
    assert finding.error < 0.06 + 0.06 * finding.strength


def test_a_body_of_revolution_has_no_rings(scans):
    """Shells about the axis: their outlines are circles of an FDK, and the same in all views."""
    shells = [
        scans.Ellipsoid((0, 0, 0), (radius, radius, 1.1 * radius), 0.0, value)
        for radius, value in ((12, 0.2), (11, -0.2), (9, 0.2), (8, -0.2), (5, 0.1))
    ]
    doll = scans.ellipsoid_scan(bodies=shells, heldout=0, supersampled=1)
    assert looked(scans.noisy(doll)).found is False
    assert looked(scans.noisy(uneven(doll, 0.01))).found is True


def test_metal_is_no_ring(scans):
    pin = scans.Ellipsoid((9, 0, 0), (0.6, 0.6, 8), 0.0, 1.5)
    assert looked(scans.noisy(scans.ellipsoid_scan(bodies=(*scans.BODIES, pin), supersampled=1))).found is False


@pytest.mark.parametrize("offset_px", [0.2, 1.3])
def test_a_detector_off_its_place_is_no_ring(offset_px, scans):
    def true(detector, index):
        shift = np.array([[offset_px + 0.3 * np.sin(index), 0.4]]) * np.linalg.norm(detector.u)
        return moved([detector], shift, np.radians([0.4]))[0]

    assert looked(scans.noisy(scans.ellipsoid_scan(true=true, supersampled=1))).found is False


def test_an_object_that_sinks_and_slides_is_no_ring(scans):
    def true(detector, index):
        way = 0.02 * index * np.array([0.6, 0.5, 0.6])
        return replace(detector, source=detector.source - way, center=detector.center - way)

    assert looked(scans.noisy(scans.ellipsoid_scan(true=true, heldout=0, supersampled=1))).found is False


def test_a_beam_that_hardens_and_a_shaded_flat_field_are_no_rings(clean, scans):
    soft = -np.log(0.5 * np.exp(-1.4 * clean.images) + 0.5 * np.exp(-0.6 * clean.images))
    assert looked(scans.noisy(replace(clean, images=soft.astype(np.float32)))).found is False
    shade = 0.03 * np.linspace(-1, 1, 64) ** 2 + 0.05 * np.linspace(-1, 1, 64)
    assert looked(scans.noisy(replace(clean, images=clean.images + shade.astype(np.float32)))).found is False


def test_mirror_images_are_beside_the_axis_not_the_middle(clean, scans):
    cut = replace(
        clean, images=clean.images[:, :, :56],
        detectors=[replace(one, width=56, center=one.center - 4 * np.asarray(one.u)) for one in clean.detectors],
    )  # fmt: skip
    assert looked(scans.noisy(cut)).found is False
    assert looked(scans.noisy(uneven(cut, 0.01))).found is True


def test_noise_is_not_mistaken(clean, scans):
    finding = looked(scans.noisy(clean, photons=300))
    assert finding.found is not True
    # Where errors are larger than the threshold, nobody can say that there are none either.
    for seed in range(3):
        drowned = looked(scans.noisy(uneven(clean, 0.01, seed), photons=30))
        assert drowned.error > drowned.threshold
        assert drowned.found is not False


def test_held_out_views_have_no_say(clean):
    worse = np.where(clean.held_out[:, None, None], clean.images[::-1] ** 2, clean.images)
    assert looked(replace(clean, images=worse)).strength == looked(clean).strength


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda scan: replace(scan, held_out=np.arange(len(scan.images)) > 9), "10 projections are too few"),
        (lambda scan: replace(scan, detectors=[scan.detectors[i // 2] for i in range(66)]), "degrees"),
        (
            lambda scan: replace(scan, detectors=[replace(d, center=d.center + 28 * d.u) for d in scan.detectors]),
            "mirror image",
        ),
    ],
)
def test_what_cannot_tell(change, says, clean):
    finding = looked(change(clean))
    assert finding.found is None
    assert says in finding.reason


@pytest.mark.parametrize("by_name", [False, True])
def test_what_is_used_where_it_is_found_is_how_large_offsets_are(by_name, clean, scans):
    asked = "ring" if by_name else scans.auto_for("ring")
    scan = uneven(clean, 0.01)
    choice = look_at_rays(parse_effects(asked), RayEvidence(scan))
    (row,) = choice.rows
    assert (row["found"], row["used"]) == (True, True)
    assert choice.numbers["ring"]["deviation"] == pytest.approx(0.01, rel=0.1)
    # As long as no fit has told them.
    assert without_effects(scan, choice.numbers) is scan


def test_on_a_clean_scan_nothing_is_used_whoever_asks(clean, scans):
    choice = look_at_rays(parse_effects("ring"), RayEvidence(scans.noisy(clean)))
    (row,) = choice.rows
    assert (row["found"], row["used"]) == (False, False)
    assert row["reason"].endswith("There is nothing to take out.")
    assert choice.numbers == {}


def test_offsets_are_taken_off_all_views(clean):
    offsets = np.random.default_rng(0).normal(0, 0.01, clean.images.shape[1:]).astype(np.float32)
    without = without_effects(replace(clean, images=clean.images + offsets), {"ring": {"offsets": offsets}})
    assert np.allclose(without.images, clean.images, atol=1e-6)
    assert without.detectors is clean.detectors


def test_looking_can_be_cancelled(clean):
    with pytest.raises(Cancelled):
        ring.detect(RayEvidence(clean, reporter=Reporter(is_cancelled=lambda: True)))


@pytest.mark.parametrize("share", [0.0, 0.004])
def test_twenty_seeds(share, clean, scans):
    seen = [looked(scans.noisy(uneven(clean, share, seed), 20_000, seed)) for seed in range(20)]
    assert np.mean([one.found is (share > 0) for one in seen]) >= 0.95
