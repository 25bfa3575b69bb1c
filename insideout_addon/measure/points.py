"""Distance, angle and area of points in space. Numpy alone, no bpy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.digits import fixed, length_decimals
from ...core.errors import SettingError

# An area that is less of the square of its outline is nothing but rounding.
_FLAT = 1e-6


@dataclass(frozen=True)
class Measure:
    """What points measure, in their own unit.

    Attributes:
        length: from the first point to the second, the third and so on.
        angle_deg: of three points, at the second one; None of another number, or where two are the same.
        area: of the polygon of three and more; None of two. Of points that are not in one plane it is that of the
            polygon seen from where it is largest.
    """

    length: float
    angle_deg: float | None
    area: float | None

    def text(self, unit: str = "mm") -> str:
        """What the number of points asks for: the distance of two, angle and area of three, the area of more."""
        return ", ".join(self._texts(unit))

    def labels(self, points: np.ndarray, unit: str = "mm") -> list[tuple[np.ndarray, str]]:
        """The same for a drawing: the angle at its point (3,), the rest in the middle of the points (n, 3)."""
        *angle, last = self._texts(unit)
        return [*((points[1], text) for text in angle), (points.mean(axis=0), last)]

    def _texts(self, unit: str) -> list[str]:
        lengths, areas = (f" {unit}", f" {unit}²") if unit else ("", "")
        if self.area is None:
            return [f"{fixed(self.length, length_decimals(self.length))}{lengths}"]
        angle = [] if self.angle_deg is None else [f"{self.angle_deg:.1f}°"]
        size = self.area if self.area > _FLAT * self.length**2 else 0.0
        return [*angle, f"{fixed(self.area, length_decimals(size))}{areas}"]


def measure_points(points: np.ndarray) -> Measure:
    """Measures points (n, 3) in their order.

    Raises:
        SettingError: fewer than two, or one of them is no place.
    """
    points = np.asarray(points, np.float64).reshape(-1, 3)
    if len(points) < 2:
        raise SettingError("Fewer than two points measure nothing; select two for a distance, three for an angle.")
    if not np.isfinite(points).all():
        raise SettingError("One of the points is no place; give three numbers in mm.")
    length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
    return Measure(
        length=length,
        angle_deg=_angle(points) if len(points) == 3 else None,
        area=_area(points) if len(points) > 2 else None,
    )


def _angle(points: np.ndarray) -> float | None:
    first, second = points[0] - points[1], points[2] - points[1]
    if not np.linalg.norm(first) or not np.linalg.norm(second):
        return None
    # Unlike the arc cosine it keeps its digits near 0° and 180°.
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(first, second)), first @ second)))


def _area(points: np.ndarray) -> float:
    around = points - points.mean(axis=0)
    return float(0.5 * np.linalg.norm(np.cross(around, np.roll(around, -1, axis=0)).sum(axis=0)))
