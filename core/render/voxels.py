"""A GaussianSet as a voxel volume, for meshes and for smoothness in training."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import SettingError
from ..gaussians import GaussianSet
from ..volume import Volume
from .radiograph import CUTOFF_SIGMAS, xray_density

if TYPE_CHECKING:
    import torch

# Of a voxel along its shortest side; and how many parts of voxels are in memory at once.
_MOST_PARTS = 3
# A splat is averaged in parts of voxels no larger than its smallest scale over this. In a model of the Shepp-Logan head
# (58,000 splats, 128³ voxels) that errs as much as three parts for every splat, in a fifth of the time; a half, in an
# eighth less, errs by four times as much.
_REACH = 0.8
_AT_ONCE = 32_000_000


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


def voxel_averages(gaussians: GaussianSet, grid: Volume, tick: Callable[[], None] | None = None) -> Volume:
    """The attenuation averaged over each voxel of a grid, clones left out.

    A volume tells what its voxels hold on average, `voxelize` what lies at their centres: a wall thinner than a voxel
    is brighter there than its voxel, or missing. Splats keep their mass and are widened by the variance of a voxel
    (side²/12). For those too thin for that, voxels are first cut into nearly cubic parts, up to three along their
    shortest side: among sheets a tenth of a voxel thin the error is 0.1 % of the largest value (rms), that of values
    at voxel centres 15 %. Every splat has as many parts as it needs: a fat one in 27 times as many takes 27 times as
    long, and most are fat.

    Args:
        gaussians: numpy arrays.
        grid: whose voxels; its values are not looked at.
        tick: called now and then; may raise to stop.
    """
    values = np.zeros(grid.values.shape, np.float32)
    needed = _parts(gaussians, float(np.min(grid.spacing_mm)))
    for along_shortest in np.unique(needed[needed > 0]):
        _add_averages(values, gaussians.select(needed == along_shortest), grid, int(along_shortest), tick)
    return Volume(values, grid.spacing_mm, grid.origin_mm)


def _add_averages(
    values: np.ndarray, gaussians: GaussianSet, grid: Volume, along_shortest: int, tick: Callable[[], None] | None
) -> None:
    """Adds those of splats to (nz, ny, nx) values, from voxels in so many parts along their shortest side."""
    spacing, (nz, ny, nx) = np.asarray(grid.spacing_mm, np.float64), values.shape
    px, py, pz = parts = _that_fit(along_shortest, spacing, ny * nx)
    part_mm = spacing / parts
    scales = gaussians.scales.astype(np.float64)
    wider = np.sqrt(scales**2 + np.mean(part_mm) ** 2 / 12)
    density = gaussians.density * np.prod(scales / wider, axis=1)
    widened = replace(gaussians, scales=wider.astype(np.float32), density=density.astype(np.float32))
    slab = max(1, _AT_ONCE // int(ny * nx * parts.prod()))
    for first in range(0, nz, slab):
        if tick is not None:
            tick()
        count = min(slab, nz - first)
        corner = grid.origin_mm + (part_mm - spacing) / 2 + np.array([0, 0, first * spacing[2]])
        fine = voxelize(widened, corner, part_mm, (count * pz, ny * py, nx * px)).values
        averaged = fine.reshape(count, pz, ny, py, nx, px).mean(axis=(1, 3, 5), dtype=np.float64)
        values[first : first + count] += averaged


class LastAverages:
    """`voxel_averages` that knows the last of them: a run's model is averaged for its files, and again for its figures,
    in which splats that do not attenuate are beside it."""

    def __init__(self) -> None:
        self._of: list[np.ndarray] = []
        self._volume: Volume | None = None

    def __call__(self, gaussians: GaussianSet, grid: Volume, tick: Callable[[], None] | None = None) -> Volume:
        """See `voxel_averages`."""
        of = _what_counts(gaussians, grid)
        if self._volume is None or not _alike(of, self._of):
            self._of, self._volume = of, voxel_averages(gaussians, grid, tick)
        return self._volume


def _what_counts(gaussians: GaussianSet, grid: Volume) -> list[np.ndarray]:
    """What averages hang on."""
    density = np.asarray(xray_density(gaussians))
    fields = (gaussians.means, gaussians.quats, gaussians.scales, density)
    placed = np.array(grid.values.shape), np.asarray(grid.spacing_mm), np.asarray(grid.origin_mm)
    return [*placed, *(np.asarray(field)[density > 0] for field in fields)]


def _alike(one: list[np.ndarray], other: list[np.ndarray]) -> bool:
    """But for what files do to a set: they keep logarithms of scales and unit quaternions, which come back a millionth
    off."""
    pairs = zip(one, other, strict=True)
    return all(a.shape == b.shape and np.allclose(a, b, rtol=1e-5, atol=1e-7) for a, b in pairs)


def _that_fit(along_shortest: int, spacing: np.ndarray, voxels: int) -> np.ndarray:
    """Nearly cubic parts (3,) of a voxel, so many along its shortest side or as many fewer as make a slice of so many
    voxels fit into memory; where one is too many, too, thicker ones along the longest."""
    parts = np.round(along_shortest * spacing / spacing.min()).astype(int)
    while voxels * int(parts.prod()) > _AT_ONCE and along_shortest > 1:
        along_shortest -= 1
        parts = np.round(along_shortest * spacing / spacing.min()).astype(int)
    while voxels * int(parts.prod()) > _AT_ONCE and parts.max() > 1:
        parts[parts.argmax()] -= 1
    return parts


def _parts(gaussians: GaussianSet, side_mm: float) -> np.ndarray:
    """(N,) along a voxel's shortest side, so that a splat's smallest scale is `_REACH` of a part once it is widened, 0
    for splats that do not attenuate."""
    thin = gaussians.scales.min(axis=1).astype(np.float64)
    parts = np.ceil(side_mm / np.maximum(thin, 1e-9) * np.sqrt(_REACH**2 - 1 / 12))
    return np.where(np.asarray(xray_density(gaussians)) > 0, np.clip(parts, 1, _MOST_PARTS), 0).astype(int)


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
        raise SettingError("spacing_mm is {spacing}; give a voxel size above 0 mm.", spacing=spacing_mm)
    if not (shape > 0).all():
        raise SettingError("shape_zyx is {shape}; give at least one voxel along every axis.", shape=shape_zyx)
    return origin, spacing, shape
