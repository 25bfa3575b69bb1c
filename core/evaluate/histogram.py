"""Normal orientation histograms and spherical occupancy (paper, "Mesh Reconstruction")."""

from __future__ import annotations

import numpy as np


def fibonacci_sphere(count: int) -> np.ndarray:
    """(count, 3) unit vectors spread evenly over the sphere (Fibonacci lattice).

    For any count: 42 points form an icosphere, but 242 do not, so both are Fibonacci points here.
    """
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    angle = np.pi * (1 + np.sqrt(5)) * index
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def normal_histogram(normals: np.ndarray, bins: int, weights: np.ndarray | None = None) -> np.ndarray:
    """Share of the normals nearest to each of `bins` Fibonacci directions, (bins,), sum 1.

    Args:
        normals: (N, 3); those without a length or not finite are left out.
        bins: 42 or 242 in the paper.
        weights: (N,), such as the triangles' areas.

    Raises:
        ValueError: no usable normal.
    """
    normals = np.asarray(normals, np.float64)
    weights = np.ones(len(normals)) if weights is None else np.asarray(weights, np.float64)
    length = np.linalg.norm(normals, axis=1)
    good = np.isfinite(length) & (length > 1e-12) & (weights > 0)
    if not good.any():
        raise ValueError("normal_histogram: no normal has a direction")
    directions = fibonacci_sphere(bins)
    nearest = np.concatenate(
        [(part @ directions.T).argmax(axis=1) for part in np.array_split(normals[good], 1 + good.sum() // 50_000)]
    )
    counts = np.bincount(nearest, weights[good], minlength=bins)
    return counts / counts.sum()


def spherical_occupancy(histogram: np.ndarray) -> float:
    """Share of directions that any normal takes, 0..1."""
    return float((np.asarray(histogram) > 0).mean())


def total_variation(first: np.ndarray, second: np.ndarray) -> float:
    """The distance of two histograms of one bin count, half the sum of absolute differences: 0 (equal) to 1
    (disjoint)."""
    return 0.5 * float(np.abs(np.asarray(first, np.float64) - np.asarray(second, np.float64)).sum())
