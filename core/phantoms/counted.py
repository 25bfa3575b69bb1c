"""What a phantom weighs: points within it, counted by the part that holds them."""

from __future__ import annotations

import numpy as np

from ..mesh.cavities import Cavity
from ..mesh.mass import MassProperties
from ..mesh.weight import Weight
from .model import Phantom
from .part_tables import PartTables
from .scanner import voxels


def counted_weight(phantom: Phantom, tables: PartTables, spacing_mm: float, seed: int = 0) -> Weight:
    """Mass, balance, and the volumes of all parts of air, as though each were a hollow of its own.

    It is the phantom as it is X-rayed, its surfaces as straight as between nodes of their tables. A random point stands
    for each cube of a grid, so that no flat face lies along it: for objects of 100 mm and half a millimetre the mass is
    sure to some hundredths of a percent.

    Args:
        spacing_mm: side of a cube.
    """
    rng = np.random.default_rng(seed)
    nx, ny, nz = voxels(phantom, spacing_mm)
    x, y, z = (spacing_mm * (np.arange(count) - 0.5 * (count - 1)) for count in (nx, ny, nz))
    # The last is for what no part holds.
    number, first = np.zeros(len(phantom.parts) + 1), np.zeros((len(phantom.parts) + 1, 3))
    densities = np.array(
        [0.0 if part.material is None else part.material.density_g_cm3 for part in phantom.parts] + [0]
    )
    second = np.zeros((3, 3))
    for height in z:
        middles = np.stack(np.broadcast_arrays(x[None, :], y[:, None], height), axis=-1).reshape(-1, 3)
        points = middles + spacing_mm * rng.uniform(-0.5, 0.5, middles.shape)
        inside = tables.inside(points)
        holder = np.where(inside.any(axis=0), len(inside) - 1 - inside[::-1].argmax(axis=0), len(inside))
        number += np.bincount(holder, minlength=len(number))
        for axis in range(3):
            first[:, axis] += np.bincount(holder, points[:, axis], minlength=len(number))
        second += (densities[holder, None] * points).T @ points
    cube_mm3 = spacing_mm**3
    mass = float(densities @ number)
    center = densities @ first / mass
    second = 1e-3 * cube_mm3 * (second - mass * np.outer(center, center))
    properties = MassProperties(1e-3 * cube_mm3 * mass, center, np.trace(second) * np.eye(3) - second)
    hollows = [
        Cavity(cube_mm3 * count, moment / max(count, 1))
        for part, count, moment in zip(phantom.parts, number, first, strict=False)
        if part.material is None
    ]
    return Weight(properties, tuple(sorted(hollows, key=lambda cavity: -cavity.volume_mm3)), "counted")
