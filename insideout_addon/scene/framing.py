"""Where the object is in a cloud of splats: photos alone also give splats of the background. Numpy alone, no bpy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.gaussians import GaussianSet

# An object reaches twice the median distance of its splats: a ball's is 0.8 of its radius, a rod's half of it.
_REACH = 2.5
_MOST_ROUNDS = 20
# mm⁻¹; air has 2e-5.
_NO_DENSITY = 1e-6
# More would not move a median.
_MOST_SAMPLES = 50_000
# With less of its opacity in one place a model is no object before a background, and nothing of it is left out.
_LEAST_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class Body:
    """The object as a ball.

    Attributes:
        center: (3,) in the set's unit.
        radius: splats that reach farther from the centre are background.
    """

    center: np.ndarray
    radius: float


def has_density(gaussians: GaussianSet) -> bool:
    """Whether X-rays have seen any of the splats; training leaves 1e-9 mm⁻¹ where none did."""
    return bool((gaussians.density > _NO_DENSITY).any())


def find_body(gaussians: GaussianSet) -> Body | None:
    """The object in splats that no X-ray has seen, or None where all of them count.

    Centre and radius are the opacity-weighted median of the centres and 2.5 times that of their distances from it,
    over and over among the splats found so far. With density in the set the X-rays tell what the object is.
    """
    if len(gaussians) == 0 or has_density(gaussians):
        return None
    means, weights = gaussians.means.astype(np.float64), gaussians.opacities.astype(np.float64)
    sane = np.flatnonzero(np.isfinite(means).all(axis=1) & (weights > 0))
    sample = sane[:: len(sane) // _MOST_SAMPLES + 1]
    means, weights = means[sample], weights[sample]
    inside = np.ones(len(means), bool)
    for _ in range(_MOST_ROUNDS):
        if weights[inside].sum() < _LEAST_SHARE * weights.sum() or not inside.any():
            return None
        center = np.array([_weighted_median(means[inside, axis], weights[inside]) for axis in range(3)])
        distance = np.linalg.norm(means - center, axis=1)
        radius = _REACH * _weighted_median(distance[inside], weights[inside])
        found = distance <= radius
        if np.array_equal(found, inside):
            break
        inside = found
    return None if inside.all() and len(sane) == len(gaussians) else Body(center, float(radius))


def reach(gaussians: GaussianSet, center: np.ndarray) -> np.ndarray:
    """(N,) how far from `center` each splat reaches with two standard deviations of its longest axis."""
    return np.linalg.norm(gaussians.means - center, axis=1) + 2 * gaussians.scales.max(axis=1)


def without_background(gaussians: GaussianSet) -> GaussianSet:
    """The splats of the object alone."""
    body = find_body(gaussians)
    return gaussians if body is None else gaussians.select(reach(gaussians, body.center) <= body.radius)


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(total, 0.5 * total[-1])]])
