"""What the densities of a scan are in: known from its volume, told by each file of its model. No numpy."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Densities:
    """What a scan's densities are in.

    Attributes:
        relative: no unit, for they are of grey values that were only scaled; else mm⁻¹.
        water_per_mm: attenuation of water that its Hounsfield units were converted with, mm⁻¹; None of other scans.
    """

    relative: bool = False
    water_per_mm: float | None = None

    @property
    def unit(self) -> str:
        """As reports have it: "1/mm" or "relative"."""
        return "relative" if self.relative else "1/mm"


PER_MM = Densities()
"""Of a scan that tells attenuation itself, or of whose water nothing is known."""
