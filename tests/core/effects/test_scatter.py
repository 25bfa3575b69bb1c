"""Scattered X-rays are found in the air beside the object, and taken out again."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from insideout.core.effects import scatter
from insideout.core.effects.rays import RayEvidence

_spec = importlib.util.spec_from_file_location("effects_scans", Path(__file__).with_name("scans.py"))
scans = importlib.util.module_from_spec(_spec)
sys.modules[_spec.name] = scans
_spec.loader.exec_module(scans)


def clean(spread=0.0, views=24):
    """Two lines of equal strength whose attenuation is off its mean by `spread` of it."""
    scan = scans.ellipsoid_scan(64, views, 0, supersampled=1)
    images = scan.images.astype(np.float64)
    lines = [np.exp(-(1 + sign * spread) * images) for sign in (1, -1)]
    return replace(scan, images=-np.log(np.mean(lines, axis=0)).astype(np.float32))


def scattered(scan, share, width=0.15):
    primary = np.exp(-scan.images.astype(np.float64))
    light = gaussian_filter(scan.images * primary, (0, 64 * width, 64 * width), mode="constant")
    return replace(scan, images=-np.log(primary + share * light).astype(np.float32))


def seen(scan, seed=3):
    return scatter.detect(RayEvidence(scans.noisy(scan, seed=seed)))


def taken(scan, share):
    """Percent that scatter takes off the thickest twentieth."""
    thick = scan.images > np.percentile(scan.images[scan.images > 0.04], 95)
    return 100 * np.median(1 - scattered(scan, share).images[thick] / scan.images[thick])


@pytest.mark.parametrize(("share", "found"), [(0.0, False), (0.02, False), (0.1, True), (0.3, True)])
def test_found_from_two_percent(share, found):
    finding = seen(scattered(clean(), share))
    assert finding.found is found
    assert finding.strength == pytest.approx(taken(clean(), share), rel=0.25, abs=0.5)
    if found:
        assert finding.numbers["share"] == pytest.approx(share, rel=0.25)


@pytest.mark.parametrize("width", [0.1, 0.2])
def test_how_far_it_spreads_is_found_too(width):
    assert seen(scattered(clean(), 0.3, width)).numbers["width"] == pytest.approx(width, abs=0.06)


def test_a_beam_that_hardens_does_not_scatter():
    assert seen(clean(spread=0.45)).found is False


@pytest.mark.parametrize("spread", [0.0, 0.4])
def test_taken_out_again(spread):
    without = clean(spread)
    lit = scattered(without, 0.3)
    dark = scatter.corrected(lit, seen(lit).numbers)
    # 20 dB would be a tenth; a fifth leaves 14 dB.
    assert np.std(dark.images - without.images) < 0.2 * np.std(lit.images - without.images)


def test_what_is_spread_over_coarse_pixels_is_the_same():
    primary = np.exp(-np.repeat(np.repeat(clean(views=4).images, 5, axis=1), 5, axis=2).astype(np.float64))
    fine = gaussian_filter(-np.log(primary) * primary, (0, 48, 48), mode="constant")
    assert np.abs(scatter._spread(primary, 0.15) - fine).max() < 0.02 * fine.max()


def test_no_air_does_not_tell():
    scan = clean()
    narrow = replace(scan, images=scan.images[:, 20:44, 20:44], detectors=[
        replace(one, width=24, height=24) for one in scan.detectors
    ])  # fmt: skip
    finding = scatter.detect(RayEvidence(narrow))
    assert finding.found is None
    assert "air" in finding.reason


@pytest.mark.slow
def test_twenty_seeds():
    right = [seen(scattered(clean(), share), seed).found is (share > 0) for seed in range(20) for share in (0.0, 0.15)]
    assert np.mean(right) >= 0.95
