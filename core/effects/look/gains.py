"""What multiplies the brightness of whole photos, from things that several of them show."""

from __future__ import annotations

import numpy as np

_ROUNDS = 20
# Residuals smaller than this share of the mean one get no more weight: a perfect fit would be weighed without end.
_LEAST = 0.1
# Residuals so many times the mean one are highlights and wrong matches.
_OUTLIER = 4.0
# Of the largest eigenvalue; rounding leaves 1e-13 of what is 0.
_NIL = 1e-9


def photo_levels(
    photo: np.ndarray, thing: np.ndarray, values: np.ndarray, photos: int
) -> tuple[np.ndarray, np.ndarray]:
    """Levels a of photos for which, with levels b of things, a + b has the least absolute deviations from the values.

    Tukey's median polish lessens the same in turns, but hardly moves what changes slowly around an object whose things
    are seen by neighbouring photos alone. Here the things are eliminated and all photos solved for at once, in rounds
    of reweighted least squares.

    Args:
        photo, thing: (E,) whose value each is.
        values: (E,) finite.
        photos: how many there are.

    Returns:
        (photos,) levels with mean 0 over the photos that share things with others, and their standard errors; of the
        rest 0, and infinite.
    """
    thing = np.unique(thing, return_inverse=True)[1]
    shared = np.bincount(thing)[thing] > 1
    photo, thing, values = photo[shared], np.unique(thing[shared], return_inverse=True)[1], values[shared]
    levels: np.ndarray = np.zeros(photos)
    seen = np.bincount(photo, minlength=photos) > 0
    if not len(values):
        return levels, np.full(photos, np.inf)
    weights = np.ones(len(values))
    covariance = _inverse(photo, thing, weights, photos)
    left = values
    for _ in range(_ROUNDS):
        total = np.bincount(thing, weights)
        mean = np.bincount(thing, weights * values) / total
        right = np.bincount(photo, weights * (values - mean[thing]), photos)
        levels = _inverse(photo, thing, weights, photos) @ right
        apart = values - levels[photo]
        left = np.abs(apart - (np.bincount(thing, weights * apart) / total)[thing])
        weights = 1 / np.maximum(left, max(_LEAST * float(left.mean()), 1e-9))
    # Of normal residuals with a few that are not; as many of them as there are levels are nil.
    free = max(len(values) - len(total) - int(seen.sum()), 1)
    spread = np.sqrt(np.pi / 2) * float(np.minimum(left, _OUTLIER * left.mean()).sum()) / free
    errors = spread * np.sqrt(np.pi / 2 * np.diag(covariance).clip(0))
    return np.where(seen, levels - levels[seen].mean(), 0.0), np.where(seen, errors, np.inf)


def _inverse(photo: np.ndarray, thing: np.ndarray, weights: np.ndarray, photos: int) -> np.ndarray:
    """(photos, photos) of the normal equations without the things' levels; what all photos have in common stays 0."""
    shape = photos, int(thing.max()) + 1
    table = np.bincount(photo * shape[1] + thing, weights, shape[0] * shape[1]).reshape(shape)
    normal = np.diag(table.sum(axis=1)) - (table / table.sum(axis=0)) @ table.T
    return np.linalg.pinv(normal, rcond=_NIL, hermitian=True)
