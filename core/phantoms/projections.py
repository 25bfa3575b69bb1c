"""X-ray projections of a phantom: exact chord lengths through its parts, then counting noise."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from ..views import Detector
from .distance_grid import DistanceGrid
from .model import Phantom


def project(
    phantom: Phantom,
    detectors: Sequence[Detector],
    grid_mm: float = 0.5,
    step: Callable[[int], None] | None = None,
) -> np.ndarray:
    """Noise-free line integrals through pixel centres.

    Args:
        detectors: M of one size, in the world frame.
        grid_mm: spacing of the tables that the parts' distances are baked into; features should be larger.
        step: called with the number of projections done so far.

    Returns:
        (M, height, width) float32, no unit.
    """
    size = np.array(phantom.size_mm)
    grids = [(DistanceGrid.bake(part.distance, size, grid_mm), part.attenuation) for part in phantom.parts]
    images = np.zeros((len(detectors), detectors[0].height, detectors[0].width), np.float32)
    for index, (origins, directions) in enumerate(_all_rays(detectors)):
        total = np.zeros(len(origins))
        for grid, attenuation in grids:
            total += attenuation * grid.chords(origins, directions)
        images[index] = np.maximum(total, 0.0).reshape(images.shape[1:])
        if step is not None:
            step(index + 1)
    return images


def count_photons(line_integrals: np.ndarray, photons: float, rng: np.random.Generator) -> np.ndarray:
    """Line integrals as a counting detector measures them: Poisson with `photons` per pixel in air.

    Noise makes values in air slightly negative at times; they are left so, because clipping would bias them.
    """
    counts = rng.poisson(photons * np.exp(-np.asarray(line_integrals, np.float64)))
    return -np.log(np.maximum(counts, 1) / photons).astype(np.float32)


def _all_rays(detectors: Sequence[Detector]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    for detector in detectors:
        origins, directions = detector.rays()
        yield origins.reshape(-1, 3), directions.reshape(-1, 3)
