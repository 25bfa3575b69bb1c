"""The X-ray beam: one photon energy, or a tube's spectrum whose soft part the object takes away first."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from .materials import Material

_ALUMINIUM = Material("aluminium", "Al", 2.70)
_COPPER = Material("copper", "Cu", 8.96)
_WINDOW_MM = 1.0
_LOWEST_KEV = 8.0
_KV_OF_MEAN = 1.75


@dataclass(frozen=True, eq=False)
class Spectrum:
    """What the detector's signal is made of without an object.

    Attributes:
        energies_kev: (E,) photon energies.
        weights: (E,) share of the signal that each brings; they add up to 1.
        description: for meta_data.json.
    """

    energies_kev: np.ndarray
    weights: np.ndarray
    description: str

    def line_integrals(self, materials: tuple[Material, ...], lengths: np.ndarray) -> np.ndarray:
        """-ln of the share of the signal that gets through: (...,) from mm of each material (materials, ...)."""
        lengths = np.asarray(lengths, np.float64)
        if not materials:
            return np.zeros(lengths.shape[1:])
        attenuation = np.stack([material.attenuations(self.energies_kev) for material in materials], axis=1)
        # Relative to the energy that gets through best: thick metal lets so little through that exp would be 0.
        depths = np.tensordot(attenuation, lengths, axes=1)
        least = depths.min(axis=0)
        weights = self.weights.reshape(-1, *[1] * least.ndim)
        passed: np.ndarray = np.sum(weights * np.exp(least - depths), axis=0)
        return least - np.log(passed)


def monochromatic(energy_kev: float) -> Spectrum:
    """A beam of one energy: line integrals are those of the attenuation at that energy."""
    return Spectrum(np.array([energy_kev]), np.ones(1), f"{energy_kev:g} keV")


@lru_cache(maxsize=16)
def tube_spectrum(mean_kev: float) -> Spectrum:
    """An X-ray tube whose photons have a mean energy of `mean_kev`, on a detector that integrates energy.

    Bremsstrahlung by Kramers' law, photons per energy proportional to E₀ / E - 1 for a tube voltage E₀ of 1.75 times
    the mean, behind a window of 1 mm aluminium and as much copper as brings the mean to `mean_kev` (Kramers 1923,
    doi:10.1080/14786442308565244). No characteristic lines. The detector takes in every photon that reaches it.
    """
    voltage = _KV_OF_MEAN * mean_kev
    energies = np.arange(_LOWEST_KEV, voltage, 1.0) + 0.5
    energies = energies[energies < voltage]
    tube = (voltage / energies - 1) * np.exp(-_WINDOW_MM * _ALUMINIUM.attenuations(energies))
    copper = _COPPER.attenuations(energies)

    def photons(copper_mm: float) -> np.ndarray:
        return np.asarray(tube * np.exp(-copper_mm * copper))

    low, high = 0.0, 20.0
    for _ in range(50):
        middle = 0.5 * (low + high)
        softer = np.average(energies, weights=photons(middle)) < mean_kev
        low, high = (middle, high) if softer else (low, middle)
    signal = energies * photons(low)
    mean = np.average(energies, weights=photons(low))
    description = f"{voltage:.0f} kV (Kramers), {_WINDOW_MM:g} mm Al and {low:.3f} mm Cu, mean {mean:.1f} keV"
    return Spectrum(energies, signal / signal.sum(), description)
