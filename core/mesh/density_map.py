"""From attenuation to mass density: what makes grams of a scan. Numpy alone."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ..errors import SettingError
from .material_table import find_material

WATER_G_CM3 = 1.0
_ROUNDING = 1e-9
# How the descriptions of curves begin that are not of materials.
_WATER, _TWO_POINTS = "water", "two points"


@dataclass(frozen=True, eq=False)
class DensityCurve:
    """Mass density over attenuation, straight from point to point; a `DensityMap` to be called.

    It weighs nothing up to the first point, and goes on beyond the last as it came, though it never falls there.

    Attributes:
        attenuations_mm_inv: (K,) ascending, K >= 2.
        densities_g_cm3: (K,), the first 0: air counts as nothing, as on scales.
        description: the calibration in words.
    """

    attenuations_mm_inv: np.ndarray
    densities_g_cm3: np.ndarray
    description: str

    def __call__(self, attenuation_mm_inv: np.ndarray) -> np.ndarray:
        """g/cm³ for attenuations of any shape."""
        values = np.asarray(attenuation_mm_inv, np.float64)
        x, y = self.attenuations_mm_inv, self.densities_g_cm3
        slope = max((y[-1] - y[-2]) / (x[-1] - x[-2]), 0.0)
        return np.interp(values, x, y) + slope * np.maximum(values - x[-1], 0.0)

    @property
    def factor(self) -> float | None:
        """g/cm³ per mm⁻¹ where density is proportional to attenuation, else None."""
        x, y = self.attenuations_mm_inv, self.densities_g_cm3
        factor = float(y[-1] / x[-1])
        return factor if np.allclose(factor * x, y, rtol=_ROUNDING, atol=_ROUNDING * float(y.max())) else None

    @property
    def air_mm_inv(self) -> float:
        """Up to where nothing weighs anything."""
        return float(self.attenuations_mm_inv[0])

    @property
    def edge_mm_inv(self) -> float:
        """Half way from air to the lightest material that was named: where its surface lies."""
        return 0.5 * float(self.attenuations_mm_inv[0] + self.attenuations_mm_inv[1])


def curve_of_points(first: tuple[float, float], second: tuple[float, float], unit: str = "mm⁻¹") -> DensityCurve:
    """The line through two measured points: air, of 0 g/cm³, and a material of known density, or two such materials.

    Where neither is air, the line goes on from the lighter one to no attenuation and no mass.

    Args:
        first, second: attenuation in mm⁻¹ and density in g/cm³, in any order.
        unit: what attenuations are called in texts: grey values that were only scaled have none.

    Raises:
        SettingError: a number is negative or not finite, both attenuate the same, the denser one attenuates less, or
            a material does not attenuate at all.
    """
    for attenuation, density in (first, second):
        if not (np.isfinite(attenuation) and attenuation >= 0):
            raise SettingError(
                "A calibration point has {attenuation:g} {unit}; give an attenuation of 0 or more.",
                attenuation=attenuation,
                unit=unit,
            )
        if not (np.isfinite(density) and density >= 0):
            raise SettingError(
                "A calibration point has {density:g} g/cm³; give a density of 0 or more.", density=density
            )
    (x0, y0), (x1, y1) = sorted((first, second))
    if x0 == x1:
        raise SettingError(
            "Both calibration points have {x0:g} {unit}; give two that attenuate differently.", x0=x0, unit=unit
        )
    if y1 <= y0:
        raise SettingError(
            "The calibration point of {x1:g} {unit} has {y1:g} g/cm³, that of {x0:g} {unit} {y0:g} g/cm³; give two "
            "whose density grows with attenuation.",
            x1=x1,
            unit=unit,
            y1=y1,
            x0=x0,
            y0=y0,
        )
    if x0 == 0 and y0 > 0:
        raise SettingError(
            "A calibration point has {y0:g} g/cm³ at 0 {unit}; give an attenuation above 0.", y0=y0, unit=unit
        )
    points = [(x0, y0), (x1, y1)] if y0 == 0 else [(0.0, 0.0), (x0, y0), (x1, y1)]
    return _curve(points, f"{_TWO_POINTS}: {x0:g} {unit} is {y0:g} g/cm³, {x1:g} {unit} is {y1:g} g/cm³")


def curve_of_materials(names: Iterable[str], energy_kev: float, water_mm_inv: float | None = None) -> DensityCurve:
    """Through the materials of an object, in the order in which they attenuate.

    Where two of them meet, voxels are taken for what lies between them, a third perhaps; so name what is in the object
    and nothing else. A single material is a proportion, which has no such error.

    Args:
        names: of `material_table`; air is where every curve starts and need not be named.
        energy_kev: the effective photon energy of the scan.
        water_mm_inv: attenuation of water in the model of a scan in Hounsfield units, to which all of its attenuations
            are in proportion, whatever water has at that energy; None where they are true ones.

    Raises:
        SettingError: an unknown material, an energy outside of the table, no material but air, two materials that
            attenuate the same, or a water that does not attenuate.
    """
    if water_mm_inv is not None:
        _check_water(water_mm_inv)
    found = {material.name: material for material in map(find_material, names) if material.name != "air"}
    if not found:
        raise SettingError("No material is named; choose at least one that the object is made of.")
    scale = 1.0 if water_mm_inv is None else water_mm_inv / find_material("water").attenuation(energy_kev)
    ordered = sorted((scale * m.attenuation(energy_kev), m.density_g_cm3, m.name) for m in found.values())
    for (x0, _, light), (x1, _, heavy) in pairwise(ordered):
        if x1 - x0 <= 1e-3 * x1:
            raise SettingError(
                "At {energy_kev:g} keV {light} and {heavy} attenuate the same ({x1:.4g} mm⁻¹), so a scan cannot tell "
                "them apart; name one of them.",
                energy_kev=energy_kev,
                light=light,
                heavy=heavy,
                x1=x1,
            )
    points = [(0.0, 0.0), *((x, y) for x, y, _ in ordered)]
    told = f"{', '.join(name for _, _, name in ordered)} at {energy_kev:g} keV"
    return _curve(points, told if water_mm_inv is None else f"{told}, with water at {water_mm_inv:g} mm⁻¹")


def curve_of_water(water_mm_inv: float, unit: str = "mm⁻¹") -> DensityCurve:
    """Proportional to attenuation, through water: right for what is like water or tissue, a first guess for the rest.

    Args:
        water_mm_inv: what water has in the scan.
        unit: as `curve_of_points`.

    Raises:
        SettingError: it is not above 0.
    """
    _check_water(water_mm_inv, unit)
    return _curve([(0.0, 0.0), (water_mm_inv, WATER_G_CM3)], f"{_WATER} at {water_mm_inv:g} {unit}")


def calibrated_by(description: str) -> str:
    """ "water", "two points" or "materials": by what a curve with this description was made."""
    kinds = (_WATER, _TWO_POINTS)
    return next((kind for kind in kinds if description.startswith((f"{kind} at ", f"{kind}: "))), "materials")


def _check_water(water_mm_inv: float, unit: str = "mm⁻¹") -> None:
    if not (np.isfinite(water_mm_inv) and water_mm_inv > 0):
        raise SettingError(
            "Water has {water:g} {unit}; give its attenuation in the scan, above 0.",
            water=water_mm_inv,
            unit=unit,
        )


def _curve(points: list[tuple[float, float]], description: str) -> DensityCurve:
    attenuations, densities = np.array(points, np.float64).T
    return DensityCurve(attenuations, densities, description)
