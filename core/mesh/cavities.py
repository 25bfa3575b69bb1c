"""Hollows that are closed all around, and how large they are. Numpy alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..volume import Volume
from .walls import AROUND, Walls, find_walls

# Less than a block of this many voxels along each side is mostly edge.
_SMALLEST_VOXELS = 4**3


@dataclass(frozen=True, eq=False)
class Cavity:
    """A closed hollow.

    Attributes:
        volume_mm3: its air, without what lies loose in it.
        center_mm: (3,) centroid of that air in the volume's frame.
    """

    volume_mm3: float
    center_mm: np.ndarray


def find_cavities(
    volume: Volume, level_mm_inv: float, smallest_mm3: float | None = None, walls: Walls | None = None
) -> list[Cavity]:
    """The closed hollows of a volume, the largest first.

    A voxel near a wall is empty by the part that its value lacks of the wall's own. So edges may be blurred: a sum over
    them stays what it was, where a level would shift a curved one. A wall of less than five standard deviations of the
    blur does not show how dense it is, and hollows come out too small: 4 % in a ball whose wall has 4.5 around a hollow
    of radius 5.

    Args:
        level_mm_inv: what attenuates less is air.
        smallest_mm3: smaller hollows are left out; 64 voxels if None.
        walls: of this volume, level and smallest size, where they are known.

    Raises:
        SettingError: the level is not above what air has.
    """
    smallest = smallest_voxels(volume, smallest_mm3)
    if walls is None:
        walls = find_walls(volume, level_mm_inv, 0.5 * smallest)
    if walls.hollows == 0:
        return []
    of_hollow = walls.owner > AROUND
    which = walls.owner[of_hollow] - AROUND - 1
    empty = 1 - walls.filled(volume.values)[of_hollow]
    voxels = np.bincount(which, empty, minlength=walls.hollows)
    places = np.nonzero(of_hollow)[::-1]
    moments = np.stack([np.bincount(which, empty * place, minlength=walls.hollows) for place in places], axis=1)
    spacing = np.asarray(volume.spacing_mm, np.float64)
    cavities = [
        Cavity(float(count * np.prod(spacing)), np.asarray(volume.origin_mm, np.float64) + moment / count * spacing)
        for count, moment in zip(voxels, moments, strict=True)
        if count >= smallest
    ]
    return sorted(cavities, key=lambda cavity: -cavity.volume_mm3)


def smallest_voxels(volume: Volume, smallest_mm3: float | None) -> float:
    """How many voxels the smallest hollow that counts has; 64 if None."""
    voxel_mm3 = float(np.prod(np.asarray(volume.spacing_mm, np.float64)))
    return float(_SMALLEST_VOXELS) if smallest_mm3 is None else max(smallest_mm3 / voxel_mm3, 1e-9)
