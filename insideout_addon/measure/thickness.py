"""Wall thickness along the contours of a section. Numpy alone, no bpy.

The thickness at a place of a contour is the diameter of the largest circle in the material that touches the contour
there: the local thickness of Hildebrand and Rüegsegger (A new method for the model-independent assessment of thickness
in three-dimensional images, J. Microscopy 185, 1997), here on the plane and at the surface. A ray straight across says
the same of parallel walls. Where they are not parallel it is too long, tan 2α instead of 2 tan α where the walls form
an angle of 2α, another length from the other side, and past a corner it runs along the wall.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass

import numpy as np

from ...core.digits import fixed, length_decimals
from ...core.steps import run_through
from ...core.views import Plane
from ..scene.section_image import Contour, pixel_mm

# A circle may overlap the contour by this many pixels and this part of its radius: else the least roughness where it
# touches would stop it.
_OVERLAP_PIXELS, _OVERLAP = 0.25, 0.02
# Where the two sides that a circle touches are farther from parallel than 60°, there is an edge and no wall.
_LEAST_TURN = np.cos(np.radians(180.0 - 60.0))
_PRECISION_PIXELS = 0.02
# Points of a contour that are looked at together: near each other, so that few segments are in question.
_TOGETHER = 96


@dataclass(frozen=True)
class ThicknessFigures:
    """What the walls of a section have in common; each place counts by the length of contour that it stands for.

    Attributes:
        least_mm, mean_mm, median_mm, most_mm: thickness.
        p5_mm, p95_mm: a twentieth of the contours is thinner, a twentieth thicker.
        measured: share of the contours' length that has a wall behind it.
        thinnest_mm: (3,) place of the least in the model's frame.
    """

    least_mm: float
    p5_mm: float
    median_mm: float
    mean_mm: float
    p95_mm: float
    most_mm: float
    measured: float
    thinnest_mm: tuple[float, float, float]

    def texts(self) -> dict[str, str]:
        """The thicknesses by their names without the unit, all with the decimals that the least one needs."""
        values = {name.removesuffix("_mm"): value for name, value in vars(self).items() if name.endswith("_mm")}
        del values["thinnest"]
        return {name: fixed(value, length_decimals(self.least_mm)) for name, value in values.items()}


def wall_thickness(values: np.ndarray, plane: Plane, contours: Sequence[Contour]) -> list[np.ndarray]:
    """Thickness of the material at each point of each contour, by the largest circle that touches the contour there.

    Args:
        values: (height, width) the section that the contours are of, mm⁻¹; material is where it is higher.
        plane: of these values.
        contours: all of the section at one level, for each may be the other side of a wall.

    Returns:
        For each contour (n,) mm; not a number at edges, where the circle touches no opposite side, and where it
        reaches out of the section.
    """
    return run_through(thickness_in_steps(values, plane, contours))


def thickness_in_steps(
    values: np.ndarray, plane: Plane, contours: Sequence[Contour]
) -> Generator[float, None, list[np.ndarray]]:
    """As `wall_thickness`, with breaks that tell the share that is done."""
    pixel = np.array(pixel_mm(plane))
    extent = pixel * (values.shape[1], values.shape[0])
    segments = np.concatenate([_segments(contour.section_mm) for contour in contours]) if contours else np.zeros((0, 4))
    gradient = np.gradient(np.nan_to_num(values.astype(np.float64)))
    found: list[np.ndarray] = []
    done, total = 0, sum(len(contour.section_mm) for contour in contours)
    for contour in contours:
        points = contour.section_mm
        inward = _directions(gradient, points / pixel, pixel)
        parts = []
        for first in range(0, len(points), _TOGETHER):
            near = slice(first, first + _TOGETHER)
            parts.append(_touching_circles(points[near], inward[near], segments, extent, float(pixel.mean())))
            done += len(parts[-1])
            yield done / total
        found.append(np.concatenate(parts))
    return found


def thickness_figures(contours: Sequence[Contour], thickness: Sequence[np.ndarray]) -> ThicknessFigures | None:
    """Least, mean, percentiles; None where no contour has a wall behind it."""
    if not contours:
        return None
    weights = np.concatenate([_lengths(contour.section_mm) for contour in contours])
    values, places = np.concatenate(list(thickness)), np.concatenate([contour.model_mm for contour in contours])
    known = np.isfinite(values) & (weights > 0)
    if not known.any():
        return None
    measured = float(weights[known].sum() / weights.sum())
    values, weights, places = values[known], weights[known], places[known]
    order = np.argsort(values)
    share = (np.cumsum(weights[order]) - 0.5 * weights[order]) / weights.sum()
    p5, median, p95 = (float(np.interp(part, share, values[order])) for part in (0.05, 0.5, 0.95))
    x, y, z = (float(place) for place in places[order[0]])
    return ThicknessFigures(
        least_mm=float(values.min()),
        p5_mm=p5,
        median_mm=median,
        mean_mm=float(np.average(values, weights=weights)),
        p95_mm=p95,
        most_mm=float(values.max()),
        measured=measured,
        thinnest_mm=(x, y, z),
    )


def _segments(line: np.ndarray) -> np.ndarray:
    return np.concatenate([line[:-1], line[1:]], axis=1)


def _lengths(line: np.ndarray) -> np.ndarray:
    """(n,) half of the segments beside each point of a line; the two ends of a closed one are the same point."""
    steps = 0.5 * np.linalg.norm(np.diff(line, axis=0), axis=1)
    return np.append(steps, 0.0) + np.append(0.0, steps)


def _directions(gradient: Sequence[np.ndarray], pixels: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    """(n, 2) unit vectors towards higher values at (n, 2) places in pixels; not a number where it is flat."""
    down, right = (_between_pixels(part, pixels) for part in gradient)
    towards = np.stack([right, down], axis=1) / pixel
    length = np.linalg.norm(towards, axis=1, keepdims=True)
    return np.divide(towards, length, out=np.full_like(towards, np.nan), where=length > 0)


def _between_pixels(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    height, width = image.shape
    place = np.clip(pixels - 0.5, 0, (width - 1, height - 1))
    left, top = np.minimum(place.astype(np.int64), (width - 2, height - 2)).T
    x, y = place[:, 0] - left, place[:, 1] - top
    upper = (1 - x) * image[top, left] + x * image[top, left + 1]
    lower = (1 - x) * image[top + 1, left] + x * image[top + 1, left + 1]
    return (1 - y) * upper + y * lower


def _touching_circles(
    points: np.ndarray, inward: np.ndarray, segments: np.ndarray, extent: np.ndarray, pixel: float
) -> np.ndarray:
    """(n,) diameters of the largest circles that touch the contour at n points, mm.

    Along the inward direction from a point, the distance to the contour grows as fast as the way from the point for as
    long as the point is the nearest of the contour, then it falls behind and never catches up: the place where that
    begins is the circle's centre, found by halving. With r the way and d the distance a little behind it, (r + d) / 2
    is the radius at the place itself: exactly so between parallel walls, and to 7 % of the overlap at 2α = 40°.
    """
    with np.errstate(invalid="ignore"):
        low, high = np.zeros(len(points)), np.full(len(points), 0.5 * float(extent.min()))
        halvings = int(np.ceil(np.log2(max(high[0] / (_PRECISION_PIXELS * pixel), 2.0))))
        for _ in range(halvings):
            middle = 0.5 * (low + high)
            distance, _ = _nearest(points + middle[:, None] * inward, middle, segments)
            touching = distance >= middle * (1 - _OVERLAP) - _OVERLAP_PIXELS * pixel
            low, high = np.where(touching, middle, low), np.where(touching, high, middle)
        center = points + high[:, None] * inward
        distance, opposite = _nearest(center, high, segments)
        turn = ((points - center) * (opposite - center)).sum(axis=1) / np.maximum(high * distance, 1e-300)
        radius = 0.5 * (high + distance)
        inside = ((center - radius[:, None] >= 0) & (center + radius[:, None] <= extent)).all(axis=1)
        return np.where(inside & (turn <= _LEAST_TURN), 2 * radius, np.nan)


def _nearest(places: np.ndarray, reach: np.ndarray, segments: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance (n,) and point (n, 2) of the nearest of M segments, none of which is farther than `reach` (n,)."""
    known = np.isfinite(places).all(axis=1)
    distance, nearest = np.full(len(places), np.nan), np.full((len(places), 2), np.nan)
    if not known.any():
        return distance, nearest
    margin = 1.01 * float(reach[known].max())
    low, high = places[known].min(axis=0) - margin, places[known].max(axis=0) + margin
    first, second = segments[:, :2], segments[:, 2:]
    near = (np.minimum(first, second) <= high) & (np.maximum(first, second) >= low)
    start = first[near.all(axis=1)]
    along = second[near.all(axis=1)] - start
    apart = places[known][:, None, :] - start
    part = np.clip((apart * along).sum(axis=2) / np.maximum((along * along).sum(axis=1), 1e-300), 0, 1)
    apart -= part[:, :, None] * along
    squared = np.einsum("ijk,ijk->ij", apart, apart)
    best = squared.argmin(axis=1)
    rows = np.arange(len(best))
    distance[known] = np.sqrt(squared[rows, best])
    nearest[known] = places[known] - apart[rows, best]
    return distance, nearest
