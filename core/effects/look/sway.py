"""How much wider the edges of a photo are in one direction than in the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .focus import Sharpness, depths, fitted

# After what is the same at all depths, a slope and a bend: along and across two pairs of axes.
_AXES = slice(3, 5)


@dataclass(frozen=True, eq=False)
class Sways:
    """How squares of widths differ between directions, a photo a row.

    Attributes:
        tensor: (N, 2) px²: edges across a direction φ (rad, from right to down) have a square of the width of so much
            as a constant + tensor · (cos 2φ, sin 2φ). What moves evenly by d along φ has d² / 24 · (cos 2φ, sin 2φ);
            not numbers where there are too few edges.
        error: (N,) of one of the two.
        level: (N,) px², the median square of a width in all directions.
    """

    tensor: np.ndarray
    error: np.ndarray
    level: np.ndarray


def sways(found: Sharpness, photos: int, fewest: int) -> Sways:
    """Robust least squares of squared widths: of each thing one, and of each photo five numbers.

    What is soft itself is so in all photos, and a lens blurs in all directions alike, so that both are fitted beside.

    Args:
        photos: how many there are.
        fewest: edges that a photo needs.
    """
    apart = depths(found, photos, fewest)
    if apart is None:
        unknown = np.full(photos, np.nan)
        return Sways(np.full((photos, 2), np.nan), unknown, unknown)
    even = np.ones_like(apart.away)
    turned = np.cos(2 * found.direction), np.sin(2 * found.direction)
    numbers, errors = fitted(np.stack([even, apart.away, apart.away**2, *turned], axis=1), found, photos)
    numbers[~apart.enough], errors[~apart.enough] = np.nan, np.nan
    error = np.sqrt((errors[:, _AXES] ** 2).mean(axis=1))
    level = np.full(photos, np.nan)
    for place in np.flatnonzero(apart.enough):
        level[place] = np.median(found.width2[found.photo == place])
    return Sways(numbers[:, _AXES], error, level)
