"""Noise in space that painters give surfaces their texture with."""

from __future__ import annotations

import numpy as np


def waves(points: np.ndarray, wave_number: float, seed: int, count: int = 14) -> np.ndarray:
    """(N,) irregular smooth noise of variance one: plane waves in random directions.

    Args:
        wave_number: radians per mm, about.
    """
    rng = np.random.default_rng(seed)
    directions = rng.standard_normal((count, 3))
    directions *= (wave_number * rng.uniform(0.6, 1.5, count) / np.linalg.norm(directions, axis=1))[:, None]
    phases = points @ directions.T.astype(np.float32) + rng.uniform(0, 2 * np.pi, count).astype(np.float32)
    return np.sin(phases).sum(1) * np.float32(np.sqrt(2 / count))
