"""How uneven a set's attenuation is, measured where it is cheap: in one block of voxels at a random place."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from ..gaussians import GaussianSet
from ..render.voxels import voxelize_block
from .losses import total_variation

EDGE = 0.1
"""Share of the density unit from which presets let a difference between neighbouring voxels be an edge."""


def block_variation(
    gaussians: GaussianSet,
    box_mm: np.ndarray,
    voxel_mm: float,
    side: int,
    cutoff_sigmas: float,
    rng: np.random.Generator,
    edge: float | None = None,
) -> Tensor:
    """Roughness in mm⁻¹ of a cube of voxels somewhere in the box, a scalar: total variation (R2-Gaussian, arXiv
    2405.20693), or what lets edges be.

    Args:
        gaussians: torch set in mm.
        box_mm: (2, 3) lowest and highest corner.
        side: of the cube, in voxels; in a smaller box it starts at the lowest corner.
        cutoff_sigmas: where a splat ends.
        rng: where the cube lies.
        edge: mm⁻¹, see `losses.total_variation`.
    """
    room = np.maximum(box_mm[1] - box_mm[0] - side * voxel_mm, 0)
    origin = box_mm[0] + rng.random(3) * room + 0.5 * voxel_mm
    block = voxelize_block(gaussians, origin, voxel_mm, (side, side, side), cutoff_sigmas)
    return total_variation(block, edge)
