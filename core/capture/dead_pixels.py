"""Pixels of a detector that do not see the X-rays, and what is put in their place."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from .findings import CaptureProblem, warning
from .model import Finding

# More dead pixels than this are no defect of a detector but a wrong flat field.
_MOST_DEAD = 0.2
# Fewer views may all have the same piece of metal before a pixel; and what is that wide is metal on the axis.
_FEWEST_VIEWS, _WIDE_PX = 8, 3
# Of air's light, a pixel that gets no more than this is dead.
_LEAST_LIGHT = 1e-3
# So many times the line integral of the deepest ray is more than metal would have in all views alike.
_FAR_ABOVE = 1.5


def dead_pixels(flat: np.ndarray | float, dark: np.ndarray | float = 0.0) -> np.ndarray:
    """Where F − D is below a thousandth of its median, so that the reading says nothing; shape of F and D together."""
    span = np.asarray(flat, np.float32) - np.asarray(dark, np.float32)
    return span <= max(_LEAST_LIGHT * float(np.median(span)), 0.0)


def silent_pixels(views: Iterable[np.ndarray], lowest: np.ndarray | float) -> np.ndarray:
    """Where (H, W) nothing arrives in any view, alone or in lines less than 3 pixels wide; nowhere of fewer than eight
    views, or where a fifth of all pixels are so.

    Args:
        views: (H, W) each, transmissions or readings; no more are asked for than it takes to know that there are none.
        lowest: of what is no more than this nothing has arrived; a number or (H, W).
    """
    silent, count = np.array(True), 0
    for view in views:
        silent = silent & (view <= lowest)
        count += 1
        if not silent.any():
            return silent
    return _of_the_detector(silent, count)


def stuck_pixels(views: Iterable[np.ndarray]) -> np.ndarray:
    """As `silent_pixels`, of line integrals: where nothing arrives, they were cut off at the largest value of all.

    All views have to have that very value there, and nothing else may come near it: it may be metal, else.

    Args:
        views: (H, W) each, line integrals.
    """
    stuck, most, rest, count = np.array(False), np.inf, -np.inf, 0
    for view in views:
        here = view == view.max()
        if count == 0:
            stuck, most = here, float(view.max())
        rest = max(rest, float(view[~here].max(initial=-np.inf)))
        count += 1
        far_above = most >= max(-np.log(_LEAST_LIGHT), _FAR_ABOVE * rest)
        if float(view.max()) != most or (here != stuck).any() or not far_above:
            return np.zeros_like(stuck)
    return _of_the_detector(stuck, count)


def _of_the_detector(pixels: np.ndarray, views: int) -> np.ndarray:
    """Those that are no metal of pixels (H, W) that are so in all of so many views."""
    from scipy.ndimage import binary_opening, binary_propagation

    if views < _FEWEST_VIEWS or pixels.mean() > _MOST_DEAD:
        return np.zeros_like(pixels)
    square = np.ones((_WIDE_PX, _WIDE_PX), bool)
    wide = binary_propagation(binary_opening(pixels, square), np.ones((3, 3), bool), pixels)
    return np.asarray(pixels & ~wide)


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
    """What there is to say of `silent_pixels` and `stuck_pixels` (H, W)."""
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
