"""How heavy a model and its parts are: each splat's mass is its exact integral. Numpy alone, no bpy."""

from __future__ import annotations

from collections.abc import Generator

import numpy as np

from ...core.capture.volumes import MU_WATER_PER_MM
from ...core.errors import SettingError
from ...core.gaussians import GaussianSet, Modality
from ...core.mesh.density_map import WATER_G_CM3, DensityCurve
from ...core.render.volume_numpy import sample_in_steps

# Water's, as Weigh has it by default.
G_CM3_PER_MM_INV = WATER_G_CM3 / MU_WATER_PER_MM
_CM3_PER_MM3 = 1e-3
_LEAST_MM_INV = 1e-9


def splat_masses(
    gaussians: GaussianSet, g_cm3_per_mm_inv: float | np.ndarray, total_g: float | None = None
) -> np.ndarray:
    """(N,) grams: ρ·(2π)^{3/2}·s₁s₂s₃ for a mass density that is in proportion to the attenuation; 0 of clones,
    and of splats whose place or size is no number.

    Args:
        gaussians: numpy, mm.
        g_cm3_per_mm_inv: g/cm³ per mm⁻¹, one number or (N,), as of different materials.
        total_g: what they weigh together, where that is known.

    Raises:
        SettingError: nothing has any mass, or the given mass or factor is none.
    """
    if not (np.isfinite(g_cm3_per_mm_inv).all() and np.max(g_cm3_per_mm_inv) > 0):
        factor = np.max(g_cm3_per_mm_inv)
        raise SettingError(
            "{factor:g} g/cm³ for an attenuation of 1 give no mass; choose a number above 0.", factor=factor
        )
    integral = gaussians.integrals()
    # What is nowhere can be on no side of a wall, and would draw the centre of mass there.
    known = np.isfinite(integral) & np.isfinite(gaussians.means).all(axis=1)
    integral[(gaussians.modality == Modality.CLONE) | ~known] = 0.0
    masses = np.maximum(integral, 0.0) * (g_cm3_per_mm_inv * _CM3_PER_MM3)
    found = float(masses.sum())
    if not found > 0:
        raise SettingError("the model has no density, so it has no mass; choose one that was made from X-rays.")
    if total_g is None:
        return masses
    if not (np.isfinite(total_g) and total_g > 0):
        raise SettingError("a mass of {mass:g} g cannot be; weigh the model again.", mass=total_g)
    return masses * (total_g / found)


def factors_in_steps(gaussians: GaussianSet, curve: DensityCurve) -> Generator[float, None, np.ndarray]:
    """(N,) g/cm³ per mm⁻¹ of the material that each splat is in, by the attenuation of all splats around its centre.

    Yields the share that is done.

    Args:
        gaussians: numpy, mm.
        curve: from attenuation to mass density.

    Raises:
        SettingError: no splat has density.
    """
    if curve.factor is not None:
        return np.full(len(gaussians), curve.factor)
    volume = yield from sample_in_steps(gaussians)
    places = np.nan_to_num((gaussians.means - volume.origin_mm) / volume.spacing_mm)
    x, y, z = np.clip(np.rint(places).astype(np.int64), 0, np.array(volume.values.shape[::-1]) - 1).T
    around = np.maximum(volume.values[z, y, x].astype(np.float64), _LEAST_MM_INV)
    return curve(around) / around


def center_of_mass(gaussians: GaussianSet, masses: np.ndarray) -> np.ndarray:
    """(3,) mm, of splats with masses (N,) that are not all 0."""
    heavy = masses > 0
    return masses[heavy] @ gaussians.means[heavy].astype(np.float64) / masses[heavy].sum()
