"""What phantoms are made of, and how much of an X-ray it takes away (xraylib)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ..errors import SettingError


@dataclass(frozen=True)
class Material:
    """A homogeneous solid.

    Attributes:
        name: for people ("birch wood").
        formula: chemical formula, as xraylib parses it ("C6H10O5"), or mass fractions of formulas
            ((("SiO2", 0.7), ("Al2O3", 0.3))).
        density_g_cm3: mass density.
    """

    name: str
    formula: str | tuple[tuple[str, float], ...]
    density_g_cm3: float

    def attenuation(self, energy_kev: float) -> float:
        """Linear attenuation coefficient in mm⁻¹, coherent scatter counted in, at one photon energy.

        Raises:
            SettingError: xraylib is not installed.
        """
        shares = ((self.formula, 1.0),) if isinstance(self.formula, str) else self.formula
        mass = sum(share * _mass_attenuation(formula, float(energy_kev)) for formula, share in shares)
        return 0.1 * self.density_g_cm3 * mass

    def attenuations(self, energies_kev: np.ndarray) -> np.ndarray:
        """The same at energies (E,)."""
        return np.array([self.attenuation(float(energy)) for energy in energies_kev])


@lru_cache(maxsize=4096)
def _mass_attenuation(formula: str, energy_kev: float) -> float:
    """cm²/g at an energy."""
    try:
        import xraylib
    except ImportError as error:
        raise SettingError("phantoms need the package xraylib; install it with: pip install xraylib.") from error
    return float(xraylib.CS_Total_CP(formula, energy_kev))
