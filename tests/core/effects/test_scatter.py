"""Scattered X-rays are found in the air beside the object, and taken out again."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from insideout.core.effects import scatter
from insideout.core.effects.choose import without_effects
from insideout.core.effects.rays import RayEvidence


@pytest.fixture
def clean(scans):
    def make(spread=0.0, views=24):
        """Two lines of equal strength whose attenuation is off its mean by `spread` of it."""
        scan = scans.ellipsoid_scan(64, views, 0, supersampled=1)
        images = scan.images.astype(np.float64)
        lines = [np.exp(-(1 + sign * spread) * images) for sign in (1, -1)]
        return replace(scan, images=-np.log(np.mean(lines, axis=0)).astype(np.float32))

    return make


@pytest.fixture
def seen(scans):
    def look(scan, seed=3):
        return scatter.detect(RayEvidence(scans.noisy(scan, seed=seed)))

    return look


def scattered(scan, share, width=0.15):
    images = [by_hand(image, share, width * image.shape[1]) for image in scan.images]
    return replace(scan, images=np.stack(images))


def by_hand(image, share, pixels):
    """Line integrals (height, width) with scattered light blurred by so many pixels."""
    primary = np.exp(-image.astype(np.float64))
    light = gaussian_filter(image * primary, pixels, mode="constant")
    return -np.log(primary + share * light).astype(np.float32)


def shaded(scan, pattern):
    """The scan under a flat field that is off by `pattern` (height, width)."""
    return replace(scan, images=(scan.images - np.log(pattern)).astype(np.float32))


def taken(scan, share):
    """Percent that scatter takes off the thickest twentieth."""
    thick = scan.images > np.percentile(scan.images[scan.images > 0.04], 95)
    return 100 * np.median(1 - scattered(scan, share).images[thick] / scan.images[thick])


@pytest.mark.parametrize(("share", "found"), [(0.0, False), (0.02, False), (0.1, True), (0.3, True)])
def test_found_from_two_percent(share, found, clean, seen):
    finding = seen(scattered(clean(), share))
    assert finding.found is found
    assert finding.strength == pytest.approx(taken(clean(), share), rel=0.25, abs=2 * finding.error)
    if found:
        assert finding.numbers["share"] == pytest.approx(share, rel=0.25)


@pytest.mark.parametrize("width", [0.1, 0.2])
def test_how_far_it_spreads_is_found_too(width, clean, seen):
    assert seen(scattered(clean(), 0.3, width)).numbers["width"] == pytest.approx(width, abs=0.06)


def test_a_beam_that_hardens_does_not_scatter(clean, seen):
    assert seen(clean(spread=0.45)).found is False


@pytest.mark.parametrize("spread", [0.0, 0.4])
def test_taken_out_again(spread, clean, seen):
    without = clean(spread)
    lit = scattered(without, 0.3)
    dark = scatter.corrected(lit, seen(lit).numbers)
    # 20 dB would be a tenth; a fifth leaves 14 dB.
    assert np.std(dark.images - without.images) < 0.2 * np.std(lit.images - without.images)


def test_large_images_are_corrected_by_fewer_pixels_the_same(clean):
    scan = clean(views=4)
    large = replace(
        scan, images=np.repeat(np.repeat(scan.images, 5, axis=1), 5, axis=2)[:, :-2],
        detectors=[replace(one, width=320, height=318, u=one.u / 5, v=one.v / 5) for one in scan.detectors],
    )  # fmt: skip
    lit = replace(large, images=np.stack([by_hand(image, 0.3, 48) for image in large.images]))
    dark = scatter.corrected(lit, {"share": 0.3, "width": 0.15})
    assert np.abs(dark.images - large.images).max() < 0.02 * np.abs(lit.images - large.images).max()


def test_taking_out_can_be_stopped(clean):
    class StoppedError(Exception):
        pass

    ticks = iter(range(3))

    def tick():
        if next(ticks) == 2:
            raise StoppedError

    with pytest.raises(StoppedError):
        without_effects(clean(views=8), {"scatter": {"share": 0.3, "width": 0.15}}, tick)


@pytest.mark.parametrize("fall", [0.03, -0.03])
def test_a_flat_field_that_is_off_is_no_scatter_and_hides_none(fall, clean, seen):
    far = np.hypot(*np.meshgrid(np.linspace(-1, 1, 64), np.linspace(-1, 1, 64)))
    assert seen(shaded(clean(), 1 - fall * far**2)).found is not True
    finding = seen(shaded(scattered(clean(), 0.3), 1 - fall * far**2))
    assert finding.found is True
    assert finding.numbers["share"] == pytest.approx(0.3, rel=0.3)


def test_a_tube_that_fades_is_no_scatter(clean, seen):
    fading = np.linspace(1.0, 0.93, 24)[:, None, None]
    assert seen(shaded(clean(), fading)).found is not True


def test_air_that_is_cut_off_does_not_tell(scans, clean):
    noisy = scans.noisy(scattered(clean(), 0.3))
    finding = scatter.detect(RayEvidence(replace(noisy, images=np.maximum(noisy.images, 0))))
    assert finding.found is None
    assert "cut off" in finding.reason


def test_a_body_that_looks_the_same_from_all_sides_does_not_tell(scans, clean, seen):
    ball = scans.ellipsoid_scan(64, 24, 0, bodies=[scans.Ellipsoid((0, 0, 0), (9, 9, 11), 0.0, 0.05)], supersampled=1)
    finding = seen(scattered(ball, 0.3))
    assert finding.found is None
    assert "too uncertain" in finding.reason


def test_no_air_does_not_tell(clean):
    scan = clean()
    narrow = replace(scan, images=scan.images[:, 20:44, 20:44], detectors=[
        replace(one, width=24, height=24) for one in scan.detectors
    ])  # fmt: skip
    finding = scatter.detect(RayEvidence(narrow))
    assert finding.found is None
    assert "air" in finding.reason


@pytest.fixture
def beside(scans):
    def make(things, views=50):
        """An ellipsoid that is wide from two sides, and other things at its flat ones."""
        wide = scans.Ellipsoid((0, 0, 0), (11, 4, 9), 0.0, 0.117)
        return scans.ellipsoid_scan(64, views, 0, bodies=[wide, *things], supersampled=1)

    return make


@pytest.fixture
def at_flat_sides(scans):
    def make(away, axes, through):
        """Two ellipsoids that take `through` off a ray through their middle along y."""
        return [scans.Ellipsoid((0, sign * away, 0), axes, 0.0, 0.5 * through / axes[1]) for sign in (1, -1)]

    return make


@pytest.mark.parametrize(
    "things", [(10.5, (2, 2, 13), 0.016), (10.5, (2, 2, 13), 0.024), (10.5, (2, 2, 13), 0.03), (8, (9, 3, 12), 0.011)]
)
@pytest.mark.parametrize("views", [24, 50])
def test_posts_and_foam_that_count_as_air_are_no_scatter(things, views, beside, at_flat_sides, seen):
    finding = seen(beside(at_flat_sides(*things), views))
    assert finding.found is None
    assert finding.strength > finding.threshold
    assert "not as smooth" in finding.reason


@pytest.mark.parametrize(("local", "rows"), [(True, 20), (True, 200), (False, 20), (False, 200)])
def test_what_is_local_shows_on_low_and_wide_detectors_too(local, rows):
    """Of fewer rows than a cell is wide: cells are as low as it takes for some to lie one above the other."""
    rng = np.random.default_rng(0)
    changes = rng.normal(0, 0.01, (24, rows, 1000))
    explained = 0.002 * rng.standard_normal((24, 1, 1)) * np.ones_like(changes)
    changes += explained
    if local:
        changes[:, :, 300:420] += 0.01 * rng.standard_normal((24, 1, 1))
    assert bool(scatter._local(changes, explained)) is local


@pytest.mark.parametrize("share", [0.05, 0.1, 0.3])
def test_beside_nothing_the_same_body_scatters(share, beside, seen):
    finding = seen(scattered(beside([]), share))
    assert finding.found is True
    assert finding.numbers["share"] == pytest.approx(share, rel=0.15)


def test_scatter_that_no_gaussian_spreads_is_scatter(beside, seen):
    scan, images = beside([]), []
    for image in scan.images:
        primary = np.exp(-image)
        light = sum(gaussian_filter(image * primary, pixels, mode="constant") for pixels in (5, 19))
        images.append(-np.log(primary + 0.15 * light))
    assert seen(replace(scan, images=np.stack(images))).found is True


def test_noise_that_the_detector_blurs_is_not_local(scans, clean):
    noisy = scans.noisy(scattered(clean(), 0.15))
    blurred = -np.log(gaussian_filter(np.exp(-noisy.images), (0, 0.8, 0.8)))
    finding = scatter.detect(RayEvidence(replace(noisy, images=blurred)))
    assert finding.found is True


@pytest.mark.slow
@pytest.mark.parametrize("through", [0.016, 0.03])
def test_twenty_seeds_of_posts(through, beside, at_flat_sides, seen):
    scan = beside(at_flat_sides(10.5, (2, 2, 13), through))
    assert np.mean([seen(scan, seed).found is not True for seed in range(20)]) >= 0.95


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.15])
def test_twenty_seeds(share, clean, seen):
    right = [seen(scattered(clean(), share), seed).found is (share > 0) for seed in range(20)]
    assert np.mean(right) >= 0.95


def test_what_is_drawn_is_lit_as_what_was_corrected(clean):
    numbers = {"share": 0.2, "width": 0.15}
    lit = clean(views=1)
    dark = scatter.corrected(lit, numbers)
    image = scatter.drawn(dark.images[0], 0, dark, numbers)
    assert np.abs(dark.images[0] - lit.images[0]).max() > 0.02
    assert np.abs(image - lit.images[0]).max() < 0.002


def test_of_line_integrals_in_another_unit_it_cannot_be_told(clean):
    scan = clean()
    finding = scatter.detect(RayEvidence(replace(scan, images=1000 * scan.images)))
    assert (finding.found, finding.strength) == (None, None)
    assert "another unit" in finding.reason


def test_black_pixels_stay_finite_without_scatter(clean):
    """Behind p = 104 light is no number in single precision, behind 746 in double."""
    scan = clean()
    scan.images[2, 30, 30:33] = 60.0, 120.0, 900.0
    corrected = scatter.corrected(scan, {"share": 0.1, "width": 0.15}).images
    assert np.isfinite(corrected).all()
    # A fiftieth of what arrives is not scattered at least.
    np.testing.assert_allclose(corrected[2, 30, 30:32], np.array([60.0, 120.0]) + np.log(50), rtol=1e-5)
    assert np.isfinite(scatter.drawn(scan.images[2], 2, scan, {"share": 0.1, "width": 0.15})).all()
