"""What a model is at one place: density, colour, and the splat that is nearest. Numpy alone, no bpy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...core.errors import SettingError
from ...core.gaussians import GaussianSet, Modality
from ...core.rotations import normalize_quats, quats_to_matrices
from ...core.spherical_harmonics import sh_to_rgb

# With less opacity at a place, all splats together, it shows no colour of its own.
_LEAST_OPACITY, _OPAQUE = 0.05, 0.5
# Less density than this part of the largest splat's, or than single precision holds, is what is left far outside: none.
_LEAST_DENSITY = 1e-9


@dataclass(frozen=True)
class Probe:
    """Lengths in mm, in the model's frame.

    Attributes:
        point_mm: (3,) where.
        density: mm⁻¹, the sum of all splats; 0 where next to nothing of any is left.
        color: (3,) sRGB 0..1, the mean of the splats there, weighted by their opacity at the place; where there are
            none that of the nearest opaque splat; None where nothing is opaque.
        color_is_here: whether it is the place's own.
        nearest: index of the splat with the nearest centre.
        modality: what that splat came from.
        center_mm, scales_mm: (3,) its centre and standard deviations.
        distance_mm: from the place to its centre.
    """

    point_mm: tuple[float, float, float]
    density: float
    color: tuple[float, float, float] | None
    color_is_here: bool
    nearest: int
    modality: Modality
    center_mm: tuple[float, float, float]
    scales_mm: tuple[float, float, float]
    distance_mm: float


def probe(gaussians: GaussianSet, point_mm: Sequence[float]) -> Probe:
    """Looks at one place; splats with a number that is not finite are passed over.

    Args:
        gaussians: N splats with their colours, mm.
        point_mm: (3,).

    Raises:
        SettingError: the model is empty, or the place no place.
    """
    point = np.asarray(point_mm, np.float64)
    if not np.isfinite(point).all():
        raise SettingError(
            "The place {place} to look at is no place; give three numbers in mm.", place=tuple(point.tolist())
        )
    apart = point - gaussians.means.astype(np.float64)
    sane = np.isfinite(apart).all(axis=1) & np.isfinite(gaussians.scales).all(axis=1)
    if not sane.any():
        raise SettingError("The model has no splats to look at; import another one.")
    distance = np.where(sane, np.linalg.norm(apart, axis=1), np.inf)
    falloff = np.where(sane, _falloff(gaussians, apart), 0.0)
    counted = (gaussians.modality != Modality.CLONE) & np.isfinite(gaussians.density)
    nearest = int(distance.argmin())
    color, is_here = _color(gaussians, falloff, distance)
    return Probe(
        point_mm=_triple(point),
        density=_density(falloff[counted], gaussians.density[counted].astype(np.float64)),
        color=color,
        color_is_here=is_here,
        nearest=nearest,
        modality=Modality(int(gaussians.modality[nearest])),
        center_mm=_triple(gaussians.means[nearest]),
        scales_mm=_triple(gaussians.scales[nearest]),
        distance_mm=float(distance[nearest]),
    )


def _falloff(gaussians: GaussianSet, apart: np.ndarray) -> np.ndarray:
    """(N,) exp(−½ m²) of each splat, m its Mahalanobis distance from the place."""
    axes = quats_to_matrices(normalize_quats(gaussians.quats.astype(np.float64)))
    own = np.einsum("nij,ni->nj", axes, np.nan_to_num(apart)) / np.maximum(gaussians.scales.astype(np.float64), 1e-12)
    return np.exp(-0.5 * np.minimum((own * own).sum(axis=1), 1400.0))


def _density(falloff: np.ndarray, densities: np.ndarray) -> float:
    total = float(falloff @ densities)
    least = max(_LEAST_DENSITY * float(np.abs(densities).max(initial=0.0)), float(np.finfo(np.float32).tiny))
    return total if abs(total) >= least else 0.0


def _color(
    gaussians: GaussianSet, falloff: np.ndarray, distance: np.ndarray
) -> tuple[tuple[float, float, float] | None, bool]:
    weights = np.nan_to_num(gaussians.opacities.astype(np.float64)) * falloff
    seen = weights > 1e-9
    if weights.sum() >= _LEAST_OPACITY:
        mean = np.average(_rgb(gaussians, seen), axis=0, weights=weights[seen])
        return _triple(mean), True
    opaque = np.flatnonzero(gaussians.opacities >= _OPAQUE)
    if not len(opaque) or not np.isfinite(distance[opaque]).any():
        return None, False
    best = opaque[distance[opaque].argmin()]
    return _triple(_rgb(gaussians, slice(best, best + 1))[0]), False


def _rgb(gaussians: GaussianSet, which: np.ndarray | slice) -> np.ndarray:
    return sh_to_rgb(gaussians.sh[which, 0].astype(np.float64))


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
