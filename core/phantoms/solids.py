"""Exact distances to plain solids: boxes, discs, plates cut to an outline, tapered rods; (N, 3) mm in, (N,) mm out."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from .shapes import smooth_union

Vector = Sequence[float] | np.ndarray


def box(points: np.ndarray, center: Vector, half: Vector, rounding: float = 0.0) -> np.ndarray:
    """A box along the axes with edges rounded by `rounding` mm; `half` are its half extents."""
    beyond = np.abs(points - np.asarray(center, np.float32)) - (np.asarray(half, np.float32) - np.float32(rounding))
    outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
    return outside + np.minimum(beyond.max(axis=1), 0) - rounding


def ellipsoid(points: np.ndarray, center: Vector, axes: np.ndarray, semi_axes: Sequence[float]) -> np.ndarray:
    """An ellipsoid, correct to first order at its surface and, unlike `shapes.ellipsoid`, no deeper than it is thin.

    Args:
        axes: (3, 3), one unit axis a row.
        semi_axes: three half lengths along those axes, mm.
    """
    semi = np.asarray(semi_axes, np.float32)
    offset: np.ndarray = points - np.asarray(center, np.float32)
    local: np.ndarray = np.matmul(offset, np.asarray(axes, np.float32).T) / semi
    level = np.linalg.norm(local, axis=1)
    slope = np.linalg.norm(local / semi, axis=1)
    # In the middle of a flat ellipsoid the first-order distance is that to its far ends; the ways out along the axes
    # are nearer.
    rest = np.sqrt(np.maximum(1 - level[:, None] ** 2 + local**2, 0))
    out = ((rest - np.abs(local)) * semi).min(axis=1)
    first_order = np.where(slope > 1e-6, level * (level - 1) / np.maximum(slope, np.float32(1e-6)), -np.inf)
    return np.where(level < 1, np.maximum(first_order, -out), first_order)


def disc(
    points: np.ndarray, center: Vector, axis: int, radius: float, half_height: float, rounding: float = 0.0
) -> np.ndarray:
    """A cylinder along coordinate `axis` (0 x, 1 y, 2 z), rims rounded by `rounding` mm."""
    local: np.ndarray = points - np.asarray(center, np.float32)
    across = np.hypot(local[:, (axis + 1) % 3], local[:, (axis + 2) % 3]) - np.float32(radius - rounding)
    along = np.abs(local[:, axis]) - np.float32(half_height - rounding)
    return _corner(across, along) - rounding


def rod(points: np.ndarray, start: Vector, end: Vector, start_radius: float, end_radius: float) -> np.ndarray:
    """A round rod whose radius changes evenly from end to end, with ball ends; a lower bound when it tapers."""
    origin = np.asarray(start, np.float32)
    along = np.asarray(end, np.float32) - origin
    offset = points - origin
    share = np.clip(offset @ along / (along @ along), 0, 1)
    radius = start_radius + share * (end_radius - start_radius)
    slope = (end_radius - start_radius) / np.linalg.norm(along)
    return (np.linalg.norm(offset - share[:, None] * along, axis=1) - radius) / np.float32(np.hypot(1, slope))


def polygon(u: np.ndarray, v: np.ndarray, corners: Sequence[Vector] | np.ndarray) -> np.ndarray:
    """(N,) signed distance in the plane to a polygon with corners (K, 2)."""
    points = np.stack([u, v], axis=1).astype(np.float32)
    line = np.asarray(corners, np.float32)
    nearest = np.full(len(points), np.inf, np.float32)
    inside = np.zeros(len(points), bool)
    for start, end in zip(line, np.roll(line, -1, axis=0), strict=True):
        along, offset = end - start, points - start
        share = np.clip(offset @ along / (along @ along), 0, 1)
        nearest = np.minimum(nearest, np.linalg.norm(offset - share[:, None] * along, axis=1))
        crosses = (start[1] > points[:, 1]) != (end[1] > points[:, 1])
        if crosses.any():
            inside[crosses] ^= offset[crosses, 0] < offset[crosses, 1] * along[0] / along[1]
    return np.where(inside, -nearest, nearest)


def plate(outline: np.ndarray, across: np.ndarray, half_thickness: float, rounding: float = 0.0) -> np.ndarray:
    """A plate: `outline` (N,) is the distance to its outline in its plane, `across` (N,) mm from that plane."""
    return _corner(outline + rounding, np.abs(across) - np.float32(half_thickness - rounding)) - rounding


def joined(distances: Sequence[np.ndarray], blend_mm: float) -> np.ndarray:
    """The union of all, inner edges rounded over `blend_mm`."""
    total = distances[0]
    for distance in distances[1:]:
        total = smooth_union(total, distance, blend_mm)
    return total


def boxed(
    points: np.ndarray,
    low: Sequence[float],
    high: Sequence[float],
    make: Callable[[np.ndarray], dict[str, np.ndarray]],
    margin_mm: float = 1.6,
) -> dict[str, np.ndarray]:
    """Distances by name to what lies in a box, computed near it only; elsewhere the distance to the box.

    Args:
        low, high: the box's corners, mm.
        make: (N, 3) points -> distances (N,) by name, at least `margin_mm` away from the box left out.
    """
    center, half = 0.5 * np.add(low, high), 0.5 * np.subtract(high, low)
    away = box(points, center, half).astype(np.float32)
    close = np.flatnonzero(away < margin_mm)
    found = {}
    for name, distance in make(points[close]).items():
        found[name] = away.copy()
        found[name][close] = distance
    return found


def mirrored(points: np.ndarray, axis: int = 0) -> np.ndarray:
    """The points folded to the positive side of coordinate `axis`."""
    folded = points.copy()
    folded[:, axis] = np.abs(folded[:, axis])
    return folded


def _corner(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Intersection of two half spaces at right angles, exact outside too."""
    outside = np.hypot(np.maximum(first, 0), np.maximum(second, 0))
    return outside + np.minimum(np.maximum(first, second), 0)
