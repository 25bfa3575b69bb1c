"""Seeded k-means for points, safe for K up to the number of points and for identical points."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree


def kmeans(points: np.ndarray, count: int, seed: int, iterations: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """Lloyd's iterations from randomly picked distinct points.

    A cluster that runs empty is set on the point that lies furthest from its centroid. Identical points share a
    cluster, so that there are at most as many clusters as distinct points.

    Args:
        points: (N, 3).
        count: K ≥ 1.

    Returns:
        Centroids (K', 3) with K' ≤ K, and the cluster of each point (N,).

    Raises:
        ValueError: no points, or K < 1.
    """
    if len(points) == 0 or count < 1:
        raise ValueError(f"k-means needs points and at least one cluster, not {len(points)} points and K = {count}")
    points = np.asarray(points, np.float64)
    distinct, which = np.unique(points, axis=0, return_inverse=True)
    if count >= len(distinct):
        return distinct, which.reshape(-1)
    random = np.random.default_rng(seed)
    centroids = distinct[random.choice(len(distinct), count, replace=False)]
    for _ in range(iterations):
        distance, labels = cKDTree(centroids).query(points)
        sizes = np.bincount(labels, minlength=count)
        sums = np.stack([np.bincount(labels, points[:, axis], minlength=count) for axis in range(3)], axis=1)
        empty = np.flatnonzero(sizes == 0)
        centroids = sums / np.maximum(sizes, 1)[:, None]
        if len(empty):
            furthest = np.argsort(-distance, kind="stable")[: len(empty)]
            centroids[empty] = points[furthest]
    labels = cKDTree(centroids).query(points)[1]
    used, labels = np.unique(labels, return_inverse=True)
    return centroids[used], labels.reshape(-1)
