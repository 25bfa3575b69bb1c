"""Beam hardening is found in what views add up to, in one material and in two, and taken out again."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from insideout.core.effects import beam_hardening
from insideout.core.effects.rays import RayEvidence
from insideout.core.phantoms.skull import BONE, STEEL
from insideout.core.phantoms.spectrum import monochromatic, tube_spectrum
from insideout.core.volume import Volume


@pytest.fixture(scope="module")
def hardened(scans):
    # From the side three times as much as from the front.
    plate = (scans.Ellipsoid((0, 0, 0), (14, 5, 13), 0.4, 0.05), scans.Ellipsoid((5, 2, 3), (3, 3, 5), 0.4, -0.05))

    def make(spread, foot=False, views=60):
        """A scan by two lines of equal strength, whose attenuation is off its mean by `spread` of it; a foot of another
        material by as much and a half."""
        scan = scans.ellipsoid_scan(64, views, 0, plate)
        body = np.stack([sum(part.value * part.chords(one) for part in plate) for one in scan.detectors])
        metal = np.stack([scans.FOOT.value * scans.FOOT.chords(one) for one in scan.detectors]) if foot else 0 * body
        lines = [np.exp(-(1 + sign * spread) * body - (1 + 1.5 * sign * spread) * metal) for sign in (1, -1)]
        return replace(scan, images=-np.log(np.mean(lines, axis=0)).astype(np.float32))

    return make


@pytest.fixture(scope="module")
def pinned(scans):
    """Makes a scan of a bone plate with a steel pin in it by a beam of 80 keV, or by a tube of 80 keV on average."""
    plate = scans.Ellipsoid((0, 0, 0), (14, 5, 13), 0.4, 1.0)
    pin = scans.Ellipsoid((3, 0.5, 0), (1.5, 1.5, 8), 0.0, 1.0)

    def make(tube):
        scan = scans.ellipsoid_scan(64, 60, 0, (plate,), supersampled=1)
        metal = np.stack([pin.chords(one) for one in scan.detectors])
        bone = np.stack([plate.chords(one) for one in scan.detectors]) - metal
        beam = tube_spectrum(80.0) if tube else monochromatic(80.0)
        return scans.noisy(replace(scan, images=beam.line_integrals((BONE, STEEL), np.stack([bone, metal]))))

    return make


def droop(soft, single):
    """Percent that the 95th percentile of the shadow falls short of the single line's."""
    shadow = single.images > 0.1 * np.percentile(single.images, 99)
    thick = np.percentile(single.images[shadow], 95)
    near = np.abs(single.images - thick) < 0.02 * thick
    return 100 * (1 - np.mean(soft.images[near] / single.images[near]))


@pytest.mark.parametrize(("spread", "found"), [(0.0, False), (0.13, None), (0.26, None), (0.45, True)])
def test_found_where_totals_and_images_show_it(spread, found, hardened, scans):
    scan = hardened(spread)
    finding = beam_hardening.detect(RayEvidence(scans.noisy(scan)))
    assert finding.found is found
    assert finding.strength == pytest.approx(droop(scan, hardened(0.0)), abs=0.8, rel=0.15)


@pytest.mark.slow
@pytest.mark.parametrize(("spread", "found"), [(0.0, False), (0.45, True)])
def test_right_on_nearly_all_seeds(spread, found, hardened, scans):
    scan = hardened(spread)
    seen = [beam_hardening.detect(RayEvidence(scans.noisy(scan, seed=seed))) for seed in range(20)]
    assert np.mean([one.found is found for one in seen]) >= 0.95


def test_found_in_two_materials(hardened, scans):
    assert beam_hardening.detect(RayEvidence(scans.noisy(hardened(0.0, foot=True)))).found is False
    finding = beam_hardening.detect(RayEvidence(scans.noisy(hardened(0.4, foot=True))))
    assert finding.found
    assert "thin ones" in finding.reason


def test_taken_out_of_the_volume(hardened):
    single, soft = RayEvidence(hardened(0.0)), RayEvidence(hardened(0.4))
    finding = beam_hardening.detect(soft)
    straight = RayEvidence(beam_hardening.corrected(soft.projections, finding.numbers))
    # Densities have no scale of their own: each is compared at that which fits best.
    lost, left = (apart(one.volume.values, single.volume.values) for one in (soft, straight))
    assert left < 0.2 * lost


def test_metal_bends_more_than_bone(pinned):
    single, soft = RayEvidence(pinned(tube=False)), RayEvidence(pinned(tube=True))
    finding = beam_hardening.detect(soft)
    assert finding.found
    assert "taken for metal" in finding.reason
    assert beam_hardening.detect(single).found is not True
    one_curve = {name: value for name, value in finding.numbers.items() if name != "thicker"}
    lost, left, by_one = (
        apart(one.volume.values, single.volume.values)
        for one in (soft, *(straightened(soft, numbers) for numbers in (finding.numbers, one_curve)))
    )
    assert left < 0.3 * lost
    assert by_one > 0.5 * lost


def test_one_material_has_one_curve(hardened):
    finding = beam_hardening.detect(RayEvidence(hardened(0.45)))
    assert finding.found
    assert set(finding.numbers) == {"curvature", "scale", "until"}
    assert "metal" not in finding.reason


def test_a_small_object_is_no_metal_beside_all_the_air(scans):
    """A bone of 0.8 % of the box: hardly a percent of its voxels is denser than noise."""
    bone = scans.Ellipsoid((0, 0, 0), (7, 2, 4.5), 0.4, 1.0)
    scan = scans.ellipsoid_scan(128, 60, 0, (bone,), supersampled=1)
    thickness = np.stack([bone.chords(detector) for detector in scan.detectors]) * 3
    images = tube_spectrum(60.0).line_integrals((BONE,), thickness[None])
    finding = beam_hardening.detect(RayEvidence(scans.noisy(replace(scan, images=images))))
    assert finding.found
    assert set(finding.numbers) == {"curvature", "scale", "until"}


@pytest.mark.parametrize("radius", [2, 4, 6])
def test_metal_is_denser_than_the_middle_of_the_object_however_much_of_it_there_is(radius):
    """A ball of plastic around one of steel, in 0.02 to 0.4 % of the box."""
    away = np.linalg.norm(np.indices((60, 60, 60)) - 29.5, axis=0)
    values = np.where(away < 15, 0.02, 0.0) + np.random.default_rng(0).normal(0, 0.002, away.shape)
    values[away < radius] = 0.5
    projected = []

    def project(volume, detectors):
        projected.append(volume.values)
        return np.ones((1, 2, 2))

    evidence = SimpleNamespace(
        volume=Volume(values.astype(np.float32), np.ones(3), np.zeros(3)),
        views=SimpleNamespace(detectors=[]),
        project=project,
    )
    assert beam_hardening._metal(evidence, np.ones((1, 2, 2))) is not None
    np.testing.assert_array_equal(projected[0] > 0, away < radius)


def straightened(evidence, numbers):
    return RayEvidence(beam_hardening.corrected(evidence.projections, numbers))


def apart(values, truth):
    return np.sqrt(np.mean((values * np.sum(values * truth) / np.sum(values**2) - truth) ** 2))


def test_rays_of_the_median_keep_what_they_have(hardened):
    soft = RayEvidence(hardened(0.4))
    straight = beam_hardening.corrected(soft.projections, beam_hardening.detect(soft).numbers).images
    images = soft.projections.images
    shadow = images > 0.1 * np.percentile(images, 99)
    middle = shadow & (np.abs(images - np.median(images[shadow])) < 0.01)
    assert straight[middle] == pytest.approx(images[middle], rel=0.01)
    order = np.argsort(images[shadow])
    assert np.all(np.diff(straight[shadow][order]) >= 0)


def test_a_starved_pixel_goes_on_straight(hardened):
    scan = hardened(0.0)
    images = scan.images.copy()
    images[0, 0, :2] = 6.9, 13.8
    numbers = {"curvature": 0.1, "scale": 0.9, "until": 2.0}
    bent = beam_hardening.corrected(replace(scan, images=images), numbers).images[0, 0, :2]
    # The slope at 2 is 0.9 (1 + 2 · 0.1 · 2).
    assert bent[1] - bent[0] == pytest.approx(6.9 * 0.9 * 1.4, rel=1e-5)


def test_thick_parts_that_attenuate_more_are_no_certain_no(hardened, scans):
    harder = hardened(0.0)
    harder = replace(harder, images=harder.images + np.float32(0.12) * harder.images**2)
    finding = beam_hardening.detect(RayEvidence(scans.noisy(harder)))
    assert finding.found is None
    assert "no beam does that" in finding.reason


def test_held_out_views_have_no_say(hardened):
    scan = hardened(0.4)
    held_out = np.arange(len(scan.images)) % 5 == 0
    images = np.where(held_out[:, None, None], 0.0, scan.images).astype(np.float32)
    strengths = [
        beam_hardening.detect(RayEvidence(replace(scan, images=some, held_out=held_out))).strength
        for some in (scan.images, images)
    ]
    assert strengths[0] == strengths[1]


def test_few_views_do_not_tell(hardened):
    finding = beam_hardening.detect(RayEvidence(hardened(0.4, views=12)))
    assert finding.found is None
    assert "12 projections" in finding.reason


def test_what_is_drawn_is_what_was_straightened(scans):
    scan = scans.noisy(scans.ellipsoid_scan(32, 2, 0, supersampled=1))
    # Thick rays are beyond where the curve goes straight on, and noise is below 0.
    numbers = {"curvature": 0.3, "scale": 0.9, "until": 0.6 * float(scan.images.max())}
    assert scan.images.min() < 0
    straight = beam_hardening.corrected(scan, numbers)
    assert np.abs(beam_hardening.drawn(straight.images[0], 0, straight, numbers) - scan.images[0]).max() < 1e-4


@pytest.mark.parametrize("block", [1, 3])
def test_metal_is_drawn_as_it_was_straightened(block, scans):
    scan = scans.noisy(scans.ellipsoid_scan(32, 2, 0, bodies=(*scans.BODIES, scans.FOOT), supersampled=1))
    thicker = scan.in_blocks(block).images.clip(0).astype(np.float16)
    numbers = {"curvature": 0.3, "scale": 0.9, "until": 0.6 * float(scan.images.max()), "thicker": thicker}
    straight = beam_hardening.corrected(scan, numbers)
    drawn = [beam_hardening.drawn(image, view, straight, numbers) for view, image in enumerate(straight.images)]
    assert np.abs(np.stack(drawn) - scan.images).max() < 1e-4
