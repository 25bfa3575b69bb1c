"""Counting noise is found where it limits the figures, with the photons that were counted; fits get to know of it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from insideout.core.capture.model import Capture
from insideout.core.effects import noise
from insideout.core.effects.choose import look_at_rays
from insideout.core.effects.rays import RayEvidence
from insideout.core.effects.request import parse_effects
from insideout.core.evaluate.heldout import projection_peak
from insideout.core.evaluate.metrics import psnr
from insideout.core.render.voxels import voxelize
from insideout.core.run_folder import RunFolder
from insideout.core.stages.context import StageContext
from insideout.core.stages.initialize import InitializeSettings, run
from insideout.core.stages.surface import PRESETS
from insideout.core.stages.surface.stage import density_unit
from insideout.core.stages.surface.xray import XrayTrainer


@pytest.fixture(scope="module")
def clean(scans):
    """As capture files have it, in float16."""
    scan = scans.ellipsoid_scan(64, 24, 6, supersampled=1)
    return replace(scan, images=scan.images.astype(np.float16).astype(np.float32))


def looked(scan):
    return noise.detect(RayEvidence(scan))


def behind_thick_parts(scan, photons, peak):
    """Percent of the peak that photons make of the 90th percentile of the shadow."""
    thick = np.percentile(scan.images[scan.images > 0.1 * np.percentile(scan.images, 99)], 90)
    return 100 * np.sqrt(np.exp(thick) / photons) / peak


@pytest.mark.parametrize(("photons", "found"), [(1_000_000, False), (60_000, False), (1500, True)])
def test_found_from_a_hundredth_of_the_peak(photons, found, clean, scans):
    scan = scans.noisy(clean, photons)
    finding = looked(scan)
    assert finding.found is found
    assert finding.strength == pytest.approx(behind_thick_parts(clean, photons, scan.images.max()), rel=0.06)


@pytest.mark.parametrize("photons", [5000, 140_000])
@pytest.mark.parametrize("views", [4, 5, 8])
def test_few_views_tell_as_much_noise_as_many(views, photons, scans):
    """Taking away what a pixel has in all of them leaves the less of the noise the fewer they are: of four, 72 %."""
    exact = scans.ellipsoid_scan(96, views, 0)
    scan = scans.noisy(exact, photons)
    finding = looked(scan)
    assert finding.found is (photons == 5000)
    assert finding.strength == pytest.approx(behind_thick_parts(exact, photons, scan.images.max()), rel=0.1)


@pytest.mark.parametrize("views", range(2, noise._MOST_VIEWS + 1))
def test_white_noise_stays_as_large_without_gains(views):
    """Whatever pixels have in all views, and though an edge passes in one of ten: a mean would have its share of it."""
    rng = np.random.default_rng(views)
    white = rng.standard_normal((views, 100, 300), np.float32)
    gains = 100 * rng.standard_normal((100, 300), np.float32)
    assert deviation(noise._without_gains(white + gains)) == pytest.approx(1, rel=0.015)
    edges = views // 10
    white[:edges] += 30
    assert deviation(noise._without_gains(white)[edges:]) == pytest.approx(1, rel=0.04)


def deviation(values):
    return 1.4826 * np.median(np.abs(values))


def test_of_line_integrals_in_another_unit_it_cannot_be_told(clean):
    """The light behind them is no number: noise that grows with it cannot be fitted."""
    finding = looked(replace(clean, images=1000 * clean.images))
    assert (finding.found, finding.strength) == (None, None)
    assert "another unit" in finding.reason


def test_a_clean_scan_is_silent(clean, scans):
    finding = looked(clean)
    assert finding.found is False
    assert finding.strength < 0.03
    edges = scans.ellipsoid_scan(64, 24, 0, supersampled=1, bodies=(*scans.BODIES, scans.FOOT))
    assert looked(edges).strength < 0.3


def test_says_how_many_photons_and_how_good_a_model_can_be(clean, scans):
    scan = scans.noisy(clean, 5000)
    reason = looked(scan).reason
    photons = float(reason.split("as of ")[1].split(" photons")[0].replace(",", ""))
    assert photons == pytest.approx(5000, rel=0.1)
    held_out = np.flatnonzero(clean.held_out)
    best = np.mean([psnr(clean.images[index], scan.images[index], projection_peak(scan)) for index in held_out])
    assert float(reason.split("under about ")[1].split(" dB")[0]) == pytest.approx(best, abs=1.0)
    # From so many photons on it would hardly matter.
    enough = float(reason.split("From ")[1].split(" on")[0].replace(",", ""))
    assert looked(scans.noisy(clean, 2 * enough)).strength < 0.3


def test_metal_that_nothing_gets_through_does_not_lower_what_figures_can_reach(clean, scans):
    """A pin in one view at p = 20, the most that the detector tells: eᵖ is more noise than all other pixels have."""
    scan = scans.noisy(clean, 500)
    images = scan.images.copy()
    images[0, 5:10, 5:10] = 20.0
    reason = looked(replace(scan, images=images)).reason
    most_db = float(reason.split("under about ")[1].split(" dB")[0])
    best = np.mean([psnr(*pair, 20.0) for pair in zip(clean.images[1:], scan.images[1:], strict=True)])
    assert most_db == pytest.approx(best, abs=1.0)


def test_metal_behind_which_all_pixels_read_the_same_hides_no_noise(clean, scans):
    """A tenth of the detector in all views; with it the law would have no noise anywhere."""
    images = scans.noisy(clean, 500).images.copy()
    images[:, 24:40, 24:48] = 8.0
    assert looked(replace(clean, images=images)).strength > 0.5


def test_noise_that_does_not_grow_is_of_no_photons(clean):
    even = np.random.default_rng(0).normal(0, 0.02, clean.images.shape).astype(np.float32)
    finding = looked(replace(clean, images=clean.images + even))
    assert finding.found is True
    assert "photons" not in finding.reason
    assert finding.strength == pytest.approx(2 / (clean.images + even).max(), rel=0.08)


def test_pixels_that_answer_unevenly_are_no_noise(clean, scans):
    gains = np.random.default_rng(0).normal(0, 0.03, clean.images.shape[1:]).astype(np.float32)
    assert looked(replace(clean, images=clean.images + gains)).strength < 0.3
    scan = scans.noisy(clean, 5000)
    assert looked(replace(scan, images=scan.images + gains)).strength == pytest.approx(looked(scan).strength, rel=0.05)


@pytest.mark.parametrize("photons", [20_000, 60_000])
def test_grain_of_the_object_is_no_noise(photons, clean, scans):
    """Half as large again as the noise behind it: the mask sees both, in more than half of the bins."""
    grain = np.random.default_rng(0).normal(0, 1.5 * np.sqrt(np.exp(0.6) / photons), clean.images.shape)
    grain[clean.images < 0.5] = 0
    finding = looked(scans.noisy(replace(clean, images=clean.images + grain.astype(np.float32)), photons))
    assert finding.strength == pytest.approx(behind_thick_parts(clean, photons, clean.images.max()), rel=0.06)


def test_smooth_images_have_none(clean, scans):
    scan = scans.noisy(clean, 1500)
    smooth = gaussian_filter(scan.images, (0, 2, 2))
    assert looked(replace(scan, images=smooth)).strength < 0.3


def test_held_out_views_have_no_say(clean, scans):
    scan = scans.noisy(clean, 5000)
    worse = np.where(scan.held_out[:, None, None], scan.images[::-1] ** 2, scan.images)
    assert looked(replace(scan, images=worse)).strength == looked(scan).strength


def test_pixels_that_are_not_finite_are_left_out(clean, scans):
    images = scans.noisy(clean, 5000).images
    images[:, 30, 30] = np.inf
    assert looked(replace(clean, images=images)).found is True


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda scan: replace(scan, held_out=np.arange(len(scan.images)) > 2), "3 projections are too few"),
        (lambda scan: replace(scan, images=np.zeros_like(scan.images)), "empty"),
        (lambda scan: replace(scan, images=scan.images[:, 28:36, 28:36]), "too few pixels"),
        (lambda scan: replace(scan, images=scan.images[:, 30:34]), "64 x 4 pixels, too small"),
        (lambda scan: replace(scan, images=scan.images[:, :, 30:31]), "1 x 64 pixels, too small"),
    ],
)
def test_what_cannot_tell(change, says, clean):
    finding = looked(change(clean))
    assert finding.found is None
    assert says in finding.reason


@pytest.mark.parametrize("by_name", [False, True])
def test_a_fit_gets_to_know_what_is_known_of_pixels(by_name, clean, scans):
    asked, scan = "noise" if by_name else scans.auto_for("noise"), scans.noisy(clean, 5000)
    choice = look_at_rays(parse_effects(asked), RayEvidence(scan))
    (row,) = choice.rows
    assert row["found"] is True
    assert row["used"] is True
    assert choice.without.images is scan.images
    assert 1 / choice.without.noise.per_photon == pytest.approx(5000, rel=0.1)
    # Edges in a bin of few pixels add to the largest.
    thickest = np.exp(np.percentile(clean.images, 99)) / 5000
    assert 0.8 * thickest < choice.without.noise.most < 4 * thickest
    # A thing that is known is so in coarse views, too.
    assert choice.without.in_blocks(2).noise == choice.without.noise.of_means(4)


def test_where_it_does_not_matter_it_is_used_only_if_asked_for(clean, scans):
    scan = scans.noisy(clean, 1_000_000)
    automatic, asked = (
        look_at_rays(parse_effects(request), RayEvidence(scan)) for request in (scans.auto_for("noise"), "noise")
    )
    assert automatic.without is scan
    assert automatic.rows[0]["used"] is False
    assert asked.rows[0]["used"] is True


@pytest.mark.parametrize(("photons", "of_thin"), [(1000, True), (1_000_000, False)])
def test_three_thousandths_count_as_known_and_a_third_of_what_thin_parts_have(photons, of_thin, clean, scans):
    scan = scans.noisy(clean, photons)
    known = noise.corrected(scan, looked(scan).numbers).noise
    shadow = clean.images[clean.images > 0.1 * np.percentile(clean.images, 99)]
    third = np.sqrt(np.exp(np.percentile(shadow, 10)) / photons) / 3
    assert known.known == pytest.approx(third if of_thin else 0.003 * scan.images.max(), rel=0.15)


@pytest.mark.slow
@pytest.mark.parametrize(("photons", "found"), [(60_000, False), (10_000, True)])
def test_twenty_seeds(photons, found, clean, scans):
    right = [looked(scans.noisy(clean, photons, seed)).found is found for seed in range(20)]
    assert np.mean(right) >= 0.95


@pytest.mark.slow
@pytest.mark.parametrize(("denser", "photons"), [(3.0, 1000), (8.5, 10_000)])
def test_four_fifths_of_what_noise_costs_the_volume_come_back(denser, photons, scans, tmp_path):
    """X-rays alone, p up to 3.5, or up to 9.9: there half a photon a pixel is left."""
    bodies = [replace(body, value=denser * body.value) for body in scans.BODIES]
    exact, truth = scans.ellipsoid_scan(64, 60, 6, bodies=bodies), scans.true_volume(64, bodies)
    noisy = scans.noisy(exact, photons)
    settings = PRESETS["draft"].xray
    settings = replace(settings, strategy=replace(settings.strategy, most=20_000))

    def quality(given, effects):
        folder = tmp_path / effects / str(given is exact)
        capture = Capture(folder / "capture", projections=given, digest="noise")
        context = StageContext(capture, RunFolder(folder / "run"), request=parse_effects(effects))
        run(context, InitializeSettings(start="coarse", coarse_splats=2500))
        projections, volume = context.projections, context.run.volume()
        start, unit = context.run.read_set("initialize", "xray"), density_unit(context.run)
        trainer = XrayTrainer(start, projections, float(np.mean(volume.spacing_mm)), unit, settings, 0, "cpu")
        for step in range(settings.iterations):
            trainer.step(step)
        made = voxelize(trainer.parameters.to_set(), volume.origin_mm, volume.spacing_mm, truth.shape)
        return psnr(made.values, truth, truth.max())

    best, worst, won = (quality(*each) for each in ((exact, "none"), (noisy, "none"), (noisy, "noise")))
    assert best - worst > 5
    assert won - worst > 0.8 * (best - worst)
