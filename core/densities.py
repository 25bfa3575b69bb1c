"""What densities are in, those of a volume and those of a model made with it: each file tells its own. No numpy."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Densities:
    """What the densities of a volume or of a model are in.

    Attributes:
        relative: no unit, for they are of grey values that were only scaled; else mm⁻¹.
        water_per_mm: attenuation of water, that of 0 HU, mm⁻¹: of a volume what its Hounsfield units were converted
            with, of a model that was fitted to projections what those show it to be (`capture.agreement`). None of
            scans without Hounsfield units.
    """

    relative: bool = False
    water_per_mm: float | None = None

    @property
    def unit(self) -> str:
        """As reports have it: "1/mm" or "relative"."""
        return "relative" if self.relative else "1/mm"


PER_MM = Densities()
"""Of what tells attenuation itself, or of whose water nothing is known."""
