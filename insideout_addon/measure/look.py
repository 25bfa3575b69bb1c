"""How densities look on paper: in the window, colours and unit of the scene's sections. Numpy alone, no bpy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..scene.section_image import PER_MM, Unit, Window, section_rgba
from .ticks import round_ticks


@dataclass(frozen=True)
class Look:
    """What a picture on paper needs.

    Attributes:
        window: densities shown darkest and brightest, mm⁻¹.
        colors: one of `core.colormap.COLOR_MAPS`.
        unit: what numbers are written in.
    """

    window: Window
    colors: str = "inferno"
    unit: Unit = PER_MM

    def rgb(self, values: np.ndarray, air: float = 1.0) -> np.ndarray:
        """(h, w, 3) 0..1 of densities (h, w), mm⁻¹; `air` is how bright what is transparent becomes."""
        rgba = section_rgba(values, self.window, self.colors)
        return rgba[..., :3] * rgba[..., 3:] + air * (1 - rgba[..., 3:])

    def pixels(self, values: np.ndarray) -> np.ndarray:
        """(h, w, 3) uint8 of densities (h, w), mm⁻¹, air as white as the paper."""
        return np.rint(255 * self.rgb(values)).astype(np.uint8)

    def number(self, density: float) -> float:
        """A density of mm⁻¹ in the unit."""
        return self.unit.factor * density + self.unit.offset

    def ticks(self, low: float, high: float, most: int) -> list[tuple[float, str]]:
        """Densities, mm⁻¹, from `low` to `high` whose numbers are round in the unit, with these numbers."""
        found = round_ticks(self.number(low), self.number(high), most)
        return [((value - self.unit.offset) / self.unit.factor, text) for value, text in found]

    @property
    def name(self) -> str:
        """For an axis."""
        return f"density, {self.unit.label}"
