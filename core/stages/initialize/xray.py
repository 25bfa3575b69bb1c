"""First volume and first radiative splats from projections or a volume."""

from __future__ import annotations

import numpy as np

from ...capture.model import Projections
from ...errors import SettingError
from ...fdk_process import fdk
from ...gaussians import GaussianSet, Modality
from ...progress import Reporter
from ...threshold import large_attenuation
from ...volume import Volume
from .photos import neighbour_distance

_AIR = 0.05
_SQRT_2PI_CUBED = float((2 * np.pi) ** 1.5)


def first_volume(given: Volume | None, projections: Projections | None, reporter: Reporter, window: str) -> Volume:
    """The user's volume, else the FDK of the projections that are not held out, negative values cut."""
    if given is not None:
        return given
    if projections is None:
        raise AssertionError("called for captures with X-rays only")
    volume = fdk(projections, window=window, reporter=reporter)
    return Volume(np.maximum(volume.values, 0.0), volume.spacing_mm, volume.origin_mm)


def first_splats(
    volume: Volume,
    start: str,
    count: int,
    stride: int,
    seed: int,
    cell_share: float = 0.5,
    density_factor: float | None = None,
) -> GaussianSet:
    """Radiative splats whose total attenuation is that of the volume, unless `density_factor` is given.

    Args:
        start: "acui" for the centres of cells of `stride` voxels over the whole cuboid (X-Gaussian's angle cuboid
            uniform initialization), "fdk" for random voxels above 5 % of the larger attenuations (R2-Gaussian), or
            "coarse" for about `count` cells that fill the cuboid, nearly cubes, with their mean attenuation.
        count: how many random voxels or cells.
        stride: see `start`.
        seed: of the random voxels.
        cell_share: standard deviation of the splats of "acui" and "coarse" as a share of their cells.
        density_factor: densities are the volume's times this, whatever their total.

    Raises:
        SettingError: `start` is neither.
    """
    density = None
    if start == "acui":
        points = _grid(volume, stride)
        scales = np.broadcast_to(cell_share * stride * np.asarray(volume.spacing_mm, np.float64), points.shape)
    elif start == "coarse":
        points, sides, density = _cells(volume, count)
        scales = cell_share * sides
    elif start == "fdk":
        points = _material(volume, count, seed)
        scales = np.broadcast_to(neighbour_distance(points)[:, None], points.shape)
    else:
        raise SettingError("start '{start}': there is no such start; choose coarse, fdk or acui.", start=start)
    density = np.maximum(volume.sample(points) if density is None else density, 1e-6)
    if density_factor is not None:
        return _as_splats(points, scales, density * np.float32(density_factor))
    mass = float(np.maximum(volume.values, 0).sum(dtype=np.float64) * np.prod(volume.spacing_mm))
    splats = float((density * scales.prod(axis=1)).sum() * _SQRT_2PI_CUBED)
    return _as_splats(points, scales, density * (mass / splats if splats > 0 else 1.0))


def _as_splats(points: np.ndarray, scales: np.ndarray, density: np.ndarray) -> GaussianSet:
    return GaussianSet.create(points, scales.astype(np.float32), opacities=0.1, density=density, modality=Modality.XRAY)


def _grid(volume: Volume, stride: int) -> np.ndarray:
    low, high = volume.box_mm
    axes = [
        # A box thinner than half a cell has one cell all the same.
        np.arange(min(low[a] + 0.5 * side, 0.5 * (low[a] + high[a])), high[a], side)
        for a, side in enumerate(stride * np.asarray(volume.spacing_mm, np.float64))
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _cells(volume: Volume, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres and sides (N, 3) in mm of about `count` cells of whole voxels that fill the box, and their means (N,)."""
    low, high = volume.box_mm
    spacing = np.asarray(volume.spacing_mm, np.float64)
    voxels = np.array(volume.values.shape[::-1])
    along = np.clip(np.rint((high - low) / np.cbrt((high - low).prod() / count)).astype(int), 1, voxels)
    borders = [np.rint(np.linspace(0, n, cells + 1)).astype(int) for n, cells in zip(voxels, along, strict=True)]
    sums = volume.values
    for axis, edges in zip((2, 1, 0), borders, strict=True):
        sums = np.add.reduceat(sums, edges[:-1], axis=axis, dtype=np.float64)
    widths = [np.diff(edges) for edges in borders]
    means = sums.transpose(2, 1, 0) / np.einsum("i,j,k->ijk", *widths)
    middles = [low[a] + 0.5 * spacing[a] * (edges[:-1] + edges[1:]) for a, edges in enumerate(borders)]
    centres, counts = (np.stack(np.meshgrid(*of, indexing="ij"), axis=-1).reshape(-1, 3) for of in (middles, widths))
    return centres, counts * spacing, means.ravel()


def _material(volume: Volume, count: int, seed: int) -> np.ndarray:
    """Centres of random voxels with material, spread evenly inside each voxel."""
    rng = np.random.default_rng([seed, 13])
    filled = np.flatnonzero(volume.values.ravel() > max(_AIR * large_attenuation(volume.values), 1e-9))
    if len(filled) == 0:
        filled = np.arange(volume.values.size)
    chosen = rng.choice(filled, min(count, len(filled)), replace=False)
    index = np.stack(np.unravel_index(np.sort(chosen), volume.values.shape), axis=-1)[:, ::-1]
    return volume.origin_mm + (index + rng.uniform(-0.5, 0.5, index.shape)) * volume.spacing_mm
