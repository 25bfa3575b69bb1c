"""Mass, centre of mass and inertia from a volume or from Gaussians. Numpy alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..errors import SettingError
from ..gaussians import GaussianSet, Modality
from ..volume import Volume

DensityMap = Callable[[np.ndarray], np.ndarray]
"""Attenuation in mm⁻¹ -> mass density in g/cm³."""

_CM3_PER_MM3 = 1e-3


@dataclass(frozen=True, eq=False)
class MassProperties:
    """What a rigid body needs.

    Attributes:
        mass_g: grams.
        center_mm: (3,) centre of mass, world frame.
        inertia_g_mm2: (3, 3) inertia tensor about the centre of mass, along the world's axes.
    """

    mass_g: float
    center_mm: np.ndarray
    inertia_g_mm2: np.ndarray

    @property
    def principal_moments(self) -> np.ndarray:
        """(3,) ascending, g·mm²."""
        return np.linalg.eigvalsh(self.inertia_g_mm2)


def mass_properties(
    volume: Volume, density_map: DensityMap | float, level_mm_inv: float | None = None
) -> MassProperties:
    """Sums over the voxels.

    Args:
        density_map: g/cm³ for attenuations in mm⁻¹, or one factor in g/cm³ per mm⁻¹.
        level_mm_inv: voxels below count as air; without it every voxel counts, noise in air too.

    Raises:
        SettingError: the total mass is not positive, or the map's result is not finite.
    """
    values = np.asarray(volume.values, np.float64)
    density = density_map(values) if callable(density_map) else values * float(density_map)
    if level_mm_inv is not None:
        density = np.where(values >= level_mm_inv, density, 0.0)
    spacing = np.asarray(volume.spacing_mm, np.float64)
    weights = density * (float(np.prod(spacing)) * _CM3_PER_MM3)
    mass = _checked_mass(float(weights.sum()))
    axes = [volume.origin_mm[k] + spacing[k] * np.arange(values.shape[2 - k]) for k in range(3)]
    sums = [weights.sum(axis=(0, 1)), weights.sum(axis=(0, 2)), weights.sum(axis=(1, 2))]
    center = np.array([sums[k] @ axes[k] for k in range(3)]) / mass
    x, y, z = (axes[k] - center[k] for k in range(3))
    second = np.diag([sums[0] @ x**2, sums[1] @ y**2, sums[2] @ z**2])
    second[0, 1] = second[1, 0] = y @ weights.sum(axis=0) @ x
    second[0, 2] = second[2, 0] = z @ weights.sum(axis=1) @ x
    second[1, 2] = second[2, 1] = z @ weights.sum(axis=2) @ y
    # A voxel is a small box and not a point.
    second += mass * np.diag(spacing**2) / 12
    return MassProperties(mass, center, _inertia(second))


def gaussian_mass_properties(gaussians: GaussianSet, g_cm3_per_mm_inv: float) -> MassProperties:
    """Exact integrals over the splats that attenuate (clones do not), for a linear density map.

    A Gaussian's mass is ρ·(2π)^{3/2}·s₁s₂s₃ and its second moment about its centre is its covariance.

    Args:
        gaussians: numpy, mm.
        g_cm3_per_mm_inv: g/cm³ per mm⁻¹.

    Raises:
        SettingError: the total mass is not positive.
    """
    part = gaussians.select(gaussians.modality != Modality.CLONE)
    weights = part.integrals() * g_cm3_per_mm_inv * _CM3_PER_MM3
    mass = _checked_mass(float(weights.sum()))
    center = weights @ part.means / mass
    offset = part.means - center
    second = np.einsum("n,ni,nj->ij", weights, offset, offset)
    second += np.einsum("n,nij->ij", weights, part.covariances().astype(np.float64))
    return MassProperties(mass, center, _inertia(second))


def _inertia(second: np.ndarray) -> np.ndarray:
    return np.trace(second) * np.eye(3) - second


def _checked_mass(mass: float) -> float:
    if not (np.isfinite(mass) and mass > 0):
        raise SettingError(
            "the mass comes out as {mass:g} g; choose a calibration, or a density map, that gives the model's "
            "attenuations some g/cm³.",
            mass=mass,
        )
    return mass
