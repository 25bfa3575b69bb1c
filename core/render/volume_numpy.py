"""A GaussianSet as a voxel volume with numpy alone, for processes without torch and Numba (Blender's)."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import replace

import numpy as np

from ..errors import SettingError
from ..gaussians import GaussianSet, Modality
from ..steps import run_through
from ..volume import Volume
from .patches_numpy import add_in_steps

FEWEST_VOXELS, MOST_VOXELS = 8, 512
_AUTOMATIC_VOXELS = (48, 192)
# Beyond 4 standard deviations lies 1e-3 of a splat.
CUTOFF_SIGMAS = 4.0
_BOX_SIGMAS = 3.0
# Of the whole integral, what may belong to splats that reach out of the box on one side.
_STRAY = 1e-5


def attenuating(gaussians: GaussianSet) -> GaussianSet:
    """The splats of a numpy set that X-rays see and whose numbers are finite; clones are none of them.

    Raises:
        SettingError: there are none.
    """
    seen = (gaussians.density > 0) & (gaussians.modality != int(Modality.CLONE))
    for values in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.density[:, None]):
        seen &= np.isfinite(values).all(axis=1)
    seen &= (gaussians.scales > 0).all(axis=1)
    if not seen.any():
        raise SettingError("The model has no splats with density; choose one that was made from X-rays.")
    return gaussians.select(seen)


def sample_volume(
    gaussians: GaussianSet,
    voxels: int = 0,
    tick: Callable[[float], None] | None = None,
    cutoff_sigmas: float = CUTOFF_SIGMAS,
) -> Volume:
    """The attenuation averaged over the cubic voxels of a grid around all of a model but stray splats.

    Splats keep their integral and are widened by a voxel's variance, side²/12, as `core.render.voxels` does it: a
    point sample then is the average over a voxel, and the sum over voxels that of the splats.

    Args:
        gaussians: numpy arrays, mm.
        voxels: along the longest side; 0: as large as splats are, for a finer grid would show no more.
        tick: called with the part that is done, 0..1, now and then.
        cutoff_sigmas: how far a splat is sampled, at least, along each axis.

    Raises:
        SettingError: no splat has density, or a number of voxels out of range.
    """
    return run_through(sample_in_steps(gaussians, voxels, cutoff_sigmas), tick)


def sample_in_steps(
    gaussians: GaussianSet, voxels: int = 0, cutoff_sigmas: float = CUTOFF_SIGMAS
) -> Generator[float, None, Volume]:
    """As `sample_volume`, with breaks that tell the part that is done."""
    if voxels != 0 and not FEWEST_VOXELS <= voxels <= MOST_VOXELS:
        raise SettingError(
            "The grid has {voxels} voxels along a side; give {fewest} to {most}, or 0.",
            voxels=voxels,
            fewest=FEWEST_VOXELS,
            most=MOST_VOXELS,
        )
    seen = attenuating(gaussians)
    low, high = _box(seen)
    longest = float((high - low).max())
    side = longest / (voxels or np.clip(longest / _typical_scale(seen), *_AUTOMATIC_VOXELS))
    shape = np.maximum(np.ceil((high - low) / side - 1e-6).astype(int), 1)
    origin = 0.5 * (low + high) - 0.5 * (shape - 1) * side
    values = np.zeros(tuple(int(count) for count in shape[::-1]), np.float32)
    yield from add_in_steps(values, _widened(seen, side), origin, side, cutoff_sigmas)
    return Volume(values, np.full(3, side), origin)


def _box(gaussians: GaussianSet) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corner around three standard deviations of all splats but a hundred-thousandth of their
    integral on each side: one that floats far away would make voxels large."""
    reach = _BOX_SIGMAS * np.sqrt(np.einsum("nii->ni", gaussians.covariances().astype(np.float64)))
    weights = _integrals(gaussians)
    low = [-_quantile(ends, weights, 1 - _STRAY) for ends in (reach - gaussians.means).T]
    high = [_quantile(ends, weights, 1 - _STRAY) for ends in (reach + gaussians.means).T]
    return np.array(low), np.array(high)


def _typical_scale(gaussians: GaussianSet) -> float:
    """Standard deviation that half of the model's mass stays under, mm; of a splat the geometric mean of its three."""
    scales = np.cbrt(np.prod(gaussians.scales.astype(np.float64), axis=1))
    return _quantile(scales, _integrals(gaussians), 0.5)


def _integrals(gaussians: GaussianSet) -> np.ndarray:
    """(N,) each splat's share of the whole integral."""
    integrals = gaussians.integrals()
    return integrals / integrals.sum()


def _quantile(values: np.ndarray, weights: np.ndarray, part: float) -> float:
    """The smallest value up to which there is this part of the weights, whose sum is 1."""
    order = np.argsort(values)
    place = np.searchsorted(np.cumsum(weights[order]), part)
    return float(values[order[min(int(place), len(order) - 1)]])


def _widened(gaussians: GaussianSet, side_mm: float) -> GaussianSet:
    scales = gaussians.scales.astype(np.float64)
    wider = np.sqrt(scales**2 + side_mm**2 / 12)
    density = gaussians.density * np.prod(scales / wider, axis=1)
    return replace(gaussians, scales=wider.astype(np.float32), density=density.astype(np.float32))
