"""Rows go on as a cylinder would, and in air as air."""

import numpy as np
import pytest

from insideout.core.capture.detectors import CircularScan
from insideout.core.continuation import continued

WIDTH = 60


def scanned(rows):
    """(1, height, WIDTH) images and their detector."""
    images = np.asarray(rows, np.float32)[None]
    return CircularScan(WIDTH, images.shape[1], (0.5, 0.5), 200.0, 300.0).detectors(np.zeros(1)), images


def cylinder(radius, width=WIDTH):
    """(width,) line integrals in a parallel beam of a cylinder about the middle that takes 1 a pixel's width."""
    place = np.arange(width) + 0.5 - 0.5 * width
    return 2 * np.sqrt(np.maximum(radius**2 - place**2, 0))


def test_a_cylinder_goes_on_as_one():
    # Rays through all of the detector's width of it: its attenuation is the one that is assumed.
    radius = 36.0
    images = 0.5 * WIDTH / radius * cylinder(radius)
    _, wide = continued(*scanned([images, images]), 0.5)
    exact = 0.5 * WIDTH / radius * cylinder(radius, 2 * WIDTH)
    assert wide[0, 0] == pytest.approx(exact, abs=0.12 * exact[WIDTH // 2])
    assert np.all(np.diff(wide[0, 0, WIDTH:]) <= 0)


def test_the_measured_part_stays_and_the_middle_too():
    detectors, images = scanned(np.random.default_rng(0).uniform(0, 2, (3, WIDTH)))
    wider, wide = continued(detectors, images, 0.25)
    assert wide.shape == (1, 3, 90)
    assert np.array_equal(wide[:, :, 15:75], images)
    assert (wider[0].width, wider[0].height) == (90, 3)
    assert np.array_equal(wider[0].center, detectors[0].center)


def test_air_goes_on_as_air_and_a_rising_row_level_at_first():
    rows = np.stack([0.05 * cylinder(20.0), np.linspace(1.0, 2.0, WIDTH)])
    _, wide = continued(*scanned(rows), 0.5)
    assert not wide[0, 0, :30].any()
    assert not wide[0, 0, 90:].any()
    assert wide[0, 1, 90] == pytest.approx(2.0, abs=0.02)
    assert wide[0, 1, 29] == pytest.approx(1.0, abs=0.05)
    assert wide[0, 1].max() <= 2.0 + 1e-6


@pytest.mark.parametrize("rows", [np.zeros((2, WIDTH)), -np.ones((2, WIDTH)), np.full((2, WIDTH), np.nan)])
def test_nothing_goes_on_as_nothing(rows):
    _, wide = continued(*scanned(rows), 0.5)
    assert not wide[:, :, :30].any()
    assert not wide[:, :, 90:].any()
