"""Pixels of a detector that do not see the X-rays, and what is put in their place."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .findings import CaptureProblem, warning
from .model import Finding

# More dead pixels than this are no defect of a detector but a wrong flat field.
_MOST_DEAD = 0.2
# Fewer views may all have the same piece of metal before a pixel; and what is that wide is metal on the axis.
_FEWEST_VIEWS, _WIDE_PX = 8, 3


def dead_pixels(flat: np.ndarray | float, dark: np.ndarray | float = 0.0) -> np.ndarray:
    """Where F − D is below a thousandth of its median, so that the reading says nothing; shape of F and D together."""
    span = np.asarray(flat, np.float32) - np.asarray(dark, np.float32)
    return span <= max(1e-3 * float(np.median(span)), 0.0)


def silent_pixels(transmission: np.ndarray, lowest: float) -> np.ndarray:
    """Where (H, W) nothing arrives in any view, alone or in lines less than 3 pixels wide; nowhere of fewer than eight
    views, or where a fifth of all pixels are so.

    Args:
        transmission: (M, H, W).
        lowest: of what is no more than this nothing has arrived.
    """
    from scipy.ndimage import binary_opening, binary_propagation

    silent = np.full(transmission.shape[1:], len(transmission) >= _FEWEST_VIEWS)
    for view in transmission:
        if not silent.any():
            return silent
        silent &= view <= lowest
    if silent.mean() > _MOST_DEAD:
        return np.zeros_like(silent)
    square = np.ones((_WIDE_PX, _WIDE_PX), bool)
    wide = binary_propagation(binary_opening(silent, square), np.ones((3, 3), bool), silent)
    return silent & ~wide


def dead_findings(source: Path, flat: np.ndarray | float, dark: np.ndarray | float) -> list[Finding]:
    """Raises CaptureError when most pixels are dead: flat and dark are swapped then, or of another detector."""
    dead = dead_pixels(flat, dark)
    if not dead.any():
        return []
    share = 100 * dead.mean()
    if dead.mean() > _MOST_DEAD:
        raise CaptureProblem(
            source,
            "the flat field is not brighter than the dark image in {share:.2g} % of the pixels",
            "check that flat.npy and dark.npy are not swapped and belong to this scan",
            share=share,
        )
    return [
        warning(
            source,
            "{count} dead pixels ({share:.2g} % of the pixels: the flat field is no brighter than the dark image) were "
            "filled from their neighbors",
            "check flat.npy if the detector has no such defects",
            count=int(dead.sum()),
            share=share,
        )
    ]


def silent_findings(source: Path, silent: np.ndarray) -> list[Finding]:
    """What there is to say of `silent_pixels` (H, W)."""
    if not silent.any():
        return []
    return [
        warning(
            source,
            "{count} pixels saw no X-rays in any projection and were filled from their neighbors",
            "correct the detector's defects when exporting the scan",
            count=int(silent.sum()),
        )
    ]


def filled(images: np.ndarray, dead: np.ndarray) -> np.ndarray:
    """(M, H, W) images, dead pixels replaced by the mean of their living neighbours; NaN where there is none."""
    from scipy.ndimage import uniform_filter

    window, dead = (1, 3, 3), dead.copy()
    values = np.where(dead, 0.0, images).astype(np.float32)
    while True:
        living = uniform_filter((~dead).astype(np.float32), window)
        reached = dead & (living > 0.05)
        if not reached.any():
            return np.where(dead, np.nan, values)
        values[reached] = uniform_filter(values, window)[reached] / living[reached]
        dead &= ~reached
