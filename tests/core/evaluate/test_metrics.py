"""PSNR, SSIM and PIQE: known values, and what flat images give."""

from __future__ import annotations

import numpy as np
import pypiqe
import pytest
from scipy import ndimage

from insideout.core.evaluate.metrics import PSNR_LIMIT_DB, piqe, psnr, ssim


@pytest.fixture
def image():
    random = np.random.default_rng(0)
    smooth = ndimage.gaussian_filter(random.normal(size=(70, 83)), 2)
    return (smooth - smooth.min()) / np.ptp(smooth)


def test_an_error_of_a_tenth_of_the_peak_is_twenty_decibels(image):
    assert psnr(image + 0.1, image) == pytest.approx(20.0)
    assert psnr(5 * image + 0.5, 5 * image, peak=5.0) == pytest.approx(20.0)


def test_equal_images_have_a_finite_psnr(image):
    assert psnr(image, image) == PSNR_LIMIT_DB


@pytest.mark.parametrize("spoilt", [np.nan, np.inf])
def test_an_image_with_a_pixel_that_is_no_number_is_the_worst_there_is(image, spoilt):
    """A broken render must not look like a perfect one."""
    broken = image.copy()
    broken[3, 4] = spoilt
    assert psnr(broken, image) == -np.inf


def test_psnr_refuses_other_shapes_and_peaks(image):
    with pytest.raises(ValueError, match="shapes"):
        psnr(image, image[1:])
    with pytest.raises(ValueError, match="peak"):
        psnr(image, image, peak=0.0)


def test_ssim_is_one_for_equal_images_and_falls_with_noise(image):
    noisy = image + np.random.default_rng(1).normal(0, 0.1, image.shape)
    assert ssim(image, image) == pytest.approx(1.0)
    assert 0.0 < ssim(noisy, image) < 0.8
    assert ssim(noisy * 7, image * 7, data_range=7.0) == pytest.approx(ssim(noisy, image))
    color = np.repeat(image[..., None], 3, axis=2)
    assert ssim(color, color) == pytest.approx(1.0)


def test_ssim_of_a_flat_reference_is_masked_not_one(image):
    flat = np.full_like(image, 0.3)
    assert ssim(flat, flat) is None
    assert ssim(image, flat) is None
    assert ssim(image[:8, :8], image[:8, :8]) is None


@pytest.mark.parametrize("noise", [0.0, 0.05, 0.2])
def test_piqe_is_what_pypiqe_gives_when_the_window_is_the_images_own(image, noise):
    noisy = np.clip(image + np.random.default_rng(2).normal(0, noise, image.shape), 0, 1)
    eight_bit = np.round(255 * noisy).astype(np.uint8)
    eight_bit[0, 0] = 255
    assert piqe(eight_bit, 0, 255) == pytest.approx(pypiqe.piqe(eight_bit)[0], abs=1e-6)


def test_piqe_of_a_flat_image_is_one_hundred():
    assert piqe(np.zeros((64, 64)), 0, 1) == 100.0
    assert piqe(np.full((40, 50), 0.7), 0, 1) == 100.0


def test_the_noise_of_an_empty_slice_is_not_stretched_to_full_scale():
    faint = 0.001 * np.random.default_rng(3).random((64, 64))
    assert piqe(faint, 0, 1) == 100.0
