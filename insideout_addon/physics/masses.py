"""How heavy a model and its parts are: each splat's mass is its exact integral. Numpy alone, no bpy."""

from __future__ import annotations

import numpy as np

from ...core.errors import SettingError
from ...core.gaussians import GaussianSet, Modality

# Water: 1 g/cm³ and 0.0195 mm⁻¹ at about 69 keV (NIST XCOM).
G_CM3_PER_MM_INV = 1 / 0.0195
_CM3_PER_MM3 = 1e-3


def splat_masses(gaussians: GaussianSet, g_cm3_per_mm_inv: float, total_g: float | None = None) -> np.ndarray:
    """(N,) grams: ρ·(2π)^{3/2}·s₁s₂s₃ for a mass density that is in proportion to the attenuation; 0 of clones.

    Args:
        gaussians: numpy, mm.
        g_cm3_per_mm_inv: g/cm³ per mm⁻¹.
        total_g: what they weigh together, where that is known.

    Raises:
        SettingError: nothing has any mass, or the given mass or factor is none.
    """
    if not (np.isfinite(g_cm3_per_mm_inv) and g_cm3_per_mm_inv > 0):
        raise SettingError(f"{g_cm3_per_mm_inv:g} g/cm³ per 1/mm gives no mass; choose a number above 0.")
    scales = gaussians.scales.astype(np.float64)
    integral = gaussians.density.astype(np.float64) * (2 * np.pi) ** 1.5 * np.prod(scales, axis=1)
    integral[gaussians.modality == Modality.CLONE] = 0.0
    masses = np.maximum(np.nan_to_num(integral), 0.0) * (g_cm3_per_mm_inv * _CM3_PER_MM3)
    found = float(masses.sum())
    if not found > 0:
        raise SettingError("the model has no density, so it has no mass; choose one that was made from X-rays.")
    if total_g is None:
        return masses
    if not (np.isfinite(total_g) and total_g > 0):
        raise SettingError(f"a mass of {total_g:g} g cannot be; weigh the model again.")
    return masses * (total_g / found)


def center_of_mass(gaussians: GaussianSet, masses: np.ndarray) -> np.ndarray:
    """(3,) mm, of splats with masses (N,) that are not all 0."""
    return masses @ gaussians.means.astype(np.float64) / masses.sum()
