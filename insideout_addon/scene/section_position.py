"""Where a section plane lies in its model, as a number that can be written down. Numpy alone, no bpy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.digits import decimals, fixed
from ...core.views import Plane

# Parts of a normal beside one axis that come from rounding alone, and lengths along two axes that count as the same.
_ROUNDING, _AS_LONG = 1e-4, 1e-3


@dataclass(frozen=True, eq=False)
class Position:
    """A plane's distance from the model's own origin, along the plane's normal, as section sheets tell positions.

    Attributes:
        mm: positive towards which the nearest of the model's axes points, so that it does not matter which side is
            hidden.
        normal: (3,) unit vector to where it grows, in the model's frame.
        axis: "x", "y" or "z" where the plane is at right angles to it, and `mm` is that coordinate; else "".
        size: of the plane, mm; 0 where it does not matter. Of small things more decimals are told.
    """

    mm: float
    normal: np.ndarray
    axis: str
    size: float = 0.0

    @classmethod
    def of(cls, plane: Plane) -> Position:
        """That of a plane in the model's frame."""
        u, v = (np.asarray(step, np.float64) for step in (plane.u, plane.v))
        sides = plane.width * u, plane.height * v
        middle = np.asarray(plane.origin, np.float64) + 0.5 * (sides[0] + sides[1])
        return cls.through(middle, plane.normal, float(max(map(np.linalg.norm, sides))))

    @classmethod
    def through(cls, place: np.ndarray, normal: np.ndarray, size: float = 0.0) -> Position:
        """That of the plane through a place (3,) in the model's frame, at right angles to a unit vector (3,)."""
        lengths = np.abs(normal)
        # Of two axes as near the last, or at 45 degrees rounding would choose the sign.
        nearest = int(np.flatnonzero(lengths >= lengths.max() - _AS_LONG)[-1])
        normal = normal * np.sign(normal[nearest])
        along = bool(np.delete(lengths, nearest).max() < _ROUNDING)
        if along:
            normal = np.eye(3)[nearest]
        return cls(float(normal @ place), normal, "xyz"[nearest] if along else "", size)

    @property
    def text(self) -> str:
        """As it stands in pictures: "y = 12.30 mm", or "12.30 mm along (0.60, 0.00, 0.80)"."""
        return f"{self.axis} = {self.length}" if self.axis else f"{self.length} along {self.direction}"

    @property
    def length(self) -> str:
        """As a number with its unit."""
        return f"{fixed(self.mm, decimals(self.size, 4, 2))} mm"

    @property
    def direction(self) -> str:
        """The normal as numbers."""
        return f"({', '.join(fixed(part, 2) for part in self.normal)})"
