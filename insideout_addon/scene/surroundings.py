"""How dense a model is around each splat: tells material from splats that float in air. Numpy alone, no bpy."""

from __future__ import annotations

import numpy as np

from ...core.gaussians import GaussianSet

_MOST_CELLS = 96


def surrounding_density(gaussians: GaussianSet) -> np.ndarray:
    """Mean attenuation (N,) in mm⁻¹ of the cells around each centre, all splats together.

    A splat's integral ρ·(2π)^(3/2)·σ₁σ₂σ₃ is put into the cell of its centre and spread over the 27 cells around;
    cells are twice the median scale wide, wider where the model would take more than 96 of them along a side. Splats
    whose numbers are not finite are nowhere: 0 around them, and nothing of them around others.
    """
    integrals, around = gaussians.integrals(), np.zeros(len(gaussians), np.float32)
    known = np.isfinite(gaussians.means.sum(axis=1) + gaussians.scales.sum(axis=1) + integrals)
    if known.all() and len(known):
        return _surrounding(gaussians, integrals)
    if known.any():
        around[known] = _surrounding(gaussians.select(known), integrals[known])
    return around


def _surrounding(gaussians: GaussianSet, integrals: np.ndarray) -> np.ndarray:
    means = gaussians.means.astype(np.float64)
    low, high = np.percentile(means, [0.1, 99.9], axis=0)
    extent = float((high - low).max())
    cell = max(2.0 * float(np.median(gaussians.scales)), extent / _MOST_CELLS, 1e-9)
    index = np.clip((means - low) / cell, 0, _MOST_CELLS - 1).astype(np.int64) + 1
    side = _MOST_CELLS + 2
    flat = (index[:, 0] * side + index[:, 1]) * side + index[:, 2]
    grid = np.bincount(flat, integrals, minlength=side**3).reshape(side, side, side)
    for axis in range(3):
        grid = (np.roll(grid, 1, axis) + grid + np.roll(grid, -1, axis)) / 3
    return (grid.ravel()[flat] / cell**3).astype(np.float32)


def floating_threshold(surroundings: np.ndarray, xray: np.ndarray) -> float:
    """Below this surrounding density, mm⁻¹, an X-ray splat floats in air: a fifth of the dense parts'.

    Args:
        surroundings: (N,) from `surrounding_density`.
        xray: (N,) bool, the splats that count.
    """
    if not np.any(xray):
        return 0.0
    return 0.2 * float(np.percentile(surroundings[xray], 75))
