"""A GaussianSet as a voxel volume, for meshes and for total variation in training."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import SettingError
from ..gaussians import GaussianSet
from ..volume import Volume
from .radiograph import CUTOFF_SIGMAS, xray_density

if TYPE_CHECKING:
    import torch

_PARTS = 3
_SLAB = 32


def voxelize(
    gaussians: GaussianSet,
    origin_mm: np.ndarray,
    spacing_mm: np.ndarray | float,
    shape_zyx: tuple[int, int, int],
    cutoff_sigmas: float = CUTOFF_SIGMAS,
) -> Volume:
    """Σ ρ·exp(−½(x−μ)ᵀΣ⁻¹(x−μ)) at voxel centres, clones left out.

    Args:
        gaussians: numpy arrays.
        origin_mm: (3,) x, y, z of the centre of voxel [0, 0, 0].
        spacing_mm: (3,) voxel size along x, y, z, or one number.
        shape_zyx: voxels along z, y, x.
        cutoff_sigmas: a splat ends at this distance from its centre: 8e-7 of its peak at the default 5.3, 1e-2 at
            R2-Gaussian's 3, which takes a fifth of the time.

    Raises:
        SettingError: a spacing or a number of voxels that is not positive.
    """
    from .kernels.cpu.bands import list_bands
    from .kernels.cpu.voxels import project, rasterize

    origin, spacing, shape = _grid(origin_mm, spacing_mm, shape_zyx)
    splats = [
        np.ascontiguousarray(value, np.float64)
        for value in (gaussians.means, gaussians.quats, gaussians.scales, xray_density(gaussians))
    ]
    k2 = float(cutoff_sigmas) ** 2
    table, centers, boxes = project(*splats, origin, spacing, shape, k2, False)
    bands = list_bands(np.ascontiguousarray(boxes[:, [0, 1, 4, 5]]), shape[2])
    values = rasterize(table, centers, boxes, *bands, k2, shape)
    return Volume(np.ascontiguousarray(values[:, :, : shape[0]]), spacing, origin)


def voxel_averages(gaussians: GaussianSet, grid: Volume) -> Volume:
    """The attenuation averaged over each voxel of a grid, clones left out.

    A volume tells what its voxels hold on average, `voxelize` what lies at their centres: a wall thinner than a voxel
    is brighter there than its voxel, or missing. Voxels are cut into nearly cubic parts, three or more along each axis;
    splats keep their mass and are widened by a part's variance (side²/12), then taken at the parts' centres. Within
    1 % of the peak for sheets as thin as a hundredth of a voxel.

    Args:
        gaussians: numpy arrays.
        grid: whose voxels; its values are not looked at.
    """
    shape, spacing = np.array(grid.values.shape), np.asarray(grid.spacing_mm, np.float64)
    parts = np.round(_PARTS * spacing / spacing.min()).astype(int)
    part_mm = spacing / parts
    scales = gaussians.scales.astype(np.float64)
    wider = np.sqrt(scales**2 + np.mean(part_mm) ** 2 / 12)
    density = gaussians.density * np.prod(scales / wider, axis=1).reshape(gaussians.density.shape)
    widened = replace(
        gaussians,
        scales=wider.astype(gaussians.scales.dtype),
        density=density.astype(gaussians.density.dtype),
    )
    nz, ny, nx = (int(n) for n in shape)
    px, py, pz = (int(n) for n in parts)
    values = np.empty(grid.values.shape, np.float32)
    # By slabs, or a large grid's parts would not fit into memory.
    for first in range(0, nz, _SLAB):
        last = min(first + _SLAB, nz)
        corner = grid.origin_mm + (part_mm - spacing) / 2 + np.array([0, 0, first * spacing[2]])
        fine = voxelize(widened, corner, part_mm, ((last - first) * pz, ny * py, nx * px)).values
        values[first:last] = fine.reshape(last - first, pz, ny, py, nx, px).mean(axis=(1, 3, 5), dtype=np.float64)
    return Volume(values, grid.spacing_mm, grid.origin_mm)


def voxelize_block(
    gaussians: GaussianSet,
    origin_mm: np.ndarray,
    spacing_mm: np.ndarray | float,
    shape_zyx: tuple[int, int, int] = (32, 32, 32),
    cutoff_sigmas: float = CUTOFF_SIGMAS,
) -> torch.Tensor:
    """As `voxelize`, differentiable with respect to means, quats, scales and density.

    R2-Gaussian (arXiv 2405.20693) takes the total variation of such a block at a random place in every iteration.

    Args:
        gaussians: torch tensors on the CPU.

    Returns:
        (nz, ny, nx) in the dtype of the means, mm⁻¹.

    Raises:
        SettingError: a spacing or a number of voxels that is not positive.
    """
    from .kernels.cpu.voxels_autograd import differentiable_voxels

    grid = _grid(origin_mm, spacing_mm, shape_zyx)
    return differentiable_voxels(
        gaussians.means, gaussians.quats, gaussians.scales, xray_density(gaussians), *grid, cutoff_sigmas
    )


def _grid(origin_mm: Any, spacing_mm: Any, shape_zyx: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Origin, spacing and number of voxels, each (3,) in the order x, y, z."""
    origin = np.array(origin_mm, np.float64).reshape(3)
    spacing = np.array(np.broadcast_to(np.asarray(spacing_mm, np.float64), (3,)))
    shape = np.array(shape_zyx[::-1], np.int64)
    if not (spacing > 0).all():
        raise SettingError(f"spacing_mm is {spacing_mm}; give a voxel size above 0 mm.")
    if not (shape > 0).all():
        raise SettingError(f"shape_zyx is {shape_zyx}; give at least one voxel along every axis.")
    return origin, spacing, shape
