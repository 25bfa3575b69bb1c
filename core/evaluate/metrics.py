"""Image figures: PSNR, SSIM, PIQE."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

# PSNR of two equal images is infinite, which JSON cannot hold; this is reported instead.
PSNR_LIMIT_DB = 100.0
_BLOCK = 16


def psnr(image: np.ndarray, reference: np.ndarray, peak: float = 1.0) -> float:
    """Peak signal-to-noise ratio in dB, at most 100; −inf when a pixel is not finite.

    Args:
        image, reference: arrays of one shape.
        peak: the value counted as full scale; the same for every method that is compared.

    Raises:
        ValueError: shapes differ, or a peak that is not positive.
    """
    image, reference = np.asarray(image, np.float64), np.asarray(reference, np.float64)
    if image.shape != reference.shape:
        raise ValueError(f"psnr: the images have shapes {image.shape} and {reference.shape}")
    if not peak > 0:
        raise ValueError(f"psnr: the peak must be positive, not {peak}")
    error = float(np.mean((image - reference) ** 2))
    if not np.isfinite(error):
        return float("-inf")
    if error == 0:
        return PSNR_LIMIT_DB
    return float(min(10.0 * np.log10(peak * peak / error), PSNR_LIMIT_DB))


def ssim(image: np.ndarray, reference: np.ndarray, data_range: float = 1.0) -> float | None:
    """Structural similarity (Wang et al. 2004) with an 11-pixel Gaussian window, σ = 1.5; the mean over the image.

    Two flat images agree trivially (SSIM → 1) and say nothing, so a flat reference gives None. So does an image
    smaller than the window.

    Args:
        image, reference: (H, W) or (H, W, 3).
        data_range: full scale, as in `psnr`.
    """
    from skimage.metrics import structural_similarity

    image, reference = np.asarray(image, np.float64), np.asarray(reference, np.float64)
    if np.ptp(reference) <= 1e-6 * data_range or min(reference.shape[:2]) < 11:
        return None
    return float(
        structural_similarity(
            image,
            reference,
            data_range=data_range,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
            channel_axis=-1 if reference.ndim == 3 else None,
        )
    )


def piqe(image: np.ndarray, low: float, high: float) -> float:
    """PIQE (Venkatanath et al. 2015), no reference, 0 best to 100 worst; a flat image scores 100 by definition.

    The same figure as the package `pypiqe` (and MATLAB) gives, except that the grey window is fixed: those stretch
    each image to its own maximum, which amplifies the noise of slices that are nearly empty.

    Args:
        image: (H, W).
        low, high: the window that becomes 0..255; one for all images that are compared.
    """
    scaled = np.clip((np.asarray(image, np.float64) - low) / max(high - low, 1e-30), 0.0, 1.0)
    levels = np.round(255.0 * scaled)
    levels = np.pad(levels, [(0, -size % _BLOCK) for size in levels.shape], mode="symmetric")

    def blurred(values: np.ndarray) -> np.ndarray:
        return ndimage.gaussian_filter(values, 7 / 6, mode="nearest", radius=3)

    mean = blurred(levels)
    deviation = np.sqrt(np.abs(blurred(levels * levels) - mean * mean))
    normalized = (levels - mean) / (deviation + 1)
    rows, columns = (size // _BLOCK for size in levels.shape)
    blocks = normalized.reshape(rows, _BLOCK, columns, _BLOCK).swapaxes(1, 2).reshape(-1, _BLOCK, _BLOCK)
    variance = blocks.var(axis=(1, 2), ddof=1)
    active = variance > 0.1
    blocks, variance = blocks[active], variance[active]
    distortion = np.where(_has_flat_edge(blocks), 1 - variance, 0.0) + np.where(_is_noisy(blocks), variance, 0.0)
    return float(np.clip(100.0 * (distortion.sum() + 1) / (1 + active.sum()), 0.0, 100.0))


def _has_flat_edge(blocks: np.ndarray) -> np.ndarray:
    """Which blocks (B, 16, 16) have an edge with six neighbouring pixels of standard deviation under 0.1."""
    edges = np.stack([blocks[:, 0], blocks[:, -1], blocks[:, :, 0], blocks[:, :, -1]], axis=1)
    segments = np.lib.stride_tricks.sliding_window_view(edges, 6, axis=2)
    return (segments.std(axis=-1, ddof=1) < 0.1).any(axis=(1, 2))


def _is_noisy(blocks: np.ndarray) -> np.ndarray:
    """Which blocks have σ > 2β, β comparing the two middle columns with the rest."""
    deviation = blocks.std(axis=(1, 2), ddof=1)
    center = blocks[:, :, 7:9].std(axis=(1, 2), ddof=1)
    # MATLAB's code deletes the 8th column and then the 9th of what remains, which is the 10th: kept for comparison.
    around = np.delete(blocks, [7, 9], axis=2).std(axis=(1, 2), ddof=1)
    ratio = np.where(around > 0, center / np.maximum(around, 1e-30), 0.0)
    beta = np.abs(deviation - ratio) / np.maximum(np.maximum(deviation, ratio), 1e-30)
    return deviation > 2 * beta
