"""X-ray projections of a phantom: exact path lengths through its materials, then what the beam and detector make of it.

Scatter follows the idea of Ohnesorge, Flohr and Klingenbeck-Regn (European Radiology 9, 1999): a pixel's rays scatter
in proportion to p · e⁻ᵖ, what they lose times what is left, and a broad kernel spreads that over the detector.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.ndimage import gaussian_filter

from ..views import Detector
from .part_tables import PartTables
from .spectrum import Spectrum

_KERNEL_SHARE = 0.15


def path_lengths(tables: PartTables, detector: Detector) -> np.ndarray:
    """(materials, height, width) mm of each material between the source and the pixel centres."""
    origins, directions = (part.reshape(-1, 3) for part in detector.rays())
    return tables.lengths(origins, directions).reshape(-1, detector.height, detector.width)


def project(
    tables: PartTables,
    detectors: Sequence[Detector],
    spectrum: Spectrum,
    step: Callable[[int], None] | None = None,
) -> np.ndarray:
    """Noise-free line integrals through pixel centres, -ln of the share of the signal that arrives.

    Args:
        detectors: M of one size, in the world frame.
        step: called with the number of projections done so far.

    Returns:
        (M, height, width) float32, no unit.
    """
    images = np.zeros((len(detectors), detectors[0].height, detectors[0].width), np.float32)
    for index, detector in enumerate(detectors):
        images[index] = spectrum.line_integrals(tables.materials, path_lengths(tables, detector))
        if step is not None:
            step(index + 1)
    return images


def add_scatter(line_integrals: np.ndarray, share: float) -> np.ndarray:
    """Line integrals (M, height, width) that a smooth background of scattered rays makes smaller.

    Args:
        share: how much of what rays lose and could still get out reaches the detector; its kernel is a Gaussian with
            a standard deviation of 15 % of the detector's longer side. Nothing scatters from beyond the detector.
    """
    depth = np.asarray(line_integrals, np.float64)
    primary = np.exp(-depth)
    width = _KERNEL_SHARE * max(depth.shape[1:])
    scattered = gaussian_filter(depth * primary, (0, width, width), mode="constant")
    return -np.log(primary + share * scattered).astype(np.float32)


def count_photons(line_integrals: np.ndarray, photons: float, rng: np.random.Generator) -> np.ndarray:
    """Line integrals as a counting detector measures them: Poisson with `photons` per pixel in air.

    Noise makes values in air slightly negative at times; they are left so, because clipping would bias them.
    """
    counts = rng.poisson(photons * np.exp(-np.asarray(line_integrals, np.float64)))
    return -np.log(np.maximum(counts, 1) / photons).astype(np.float32)
