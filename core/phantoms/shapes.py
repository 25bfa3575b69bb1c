"""Signed distances to build phantoms from: points (N, 3) in mm in, distances (N,) in mm out, negative inside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from .model import SignedDistance


def sphere(points: np.ndarray, center: np.ndarray, radius: float) -> np.ndarray:
    """Exact distance to a ball."""
    return np.linalg.norm(points - np.asarray(center, np.float32), axis=1) - radius


def ellipsoid(points: np.ndarray, center: np.ndarray, axes: np.ndarray, semi_axes: Sequence[float]) -> np.ndarray:
    """Distance to an ellipsoid, correct to first order at its surface.

    Args:
        axes: (3, 3), one unit axis a row.
        semi_axes: three half lengths along those axes, mm.
    """
    local = (points - np.asarray(center, np.float32)) @ np.asarray(axes, np.float32).T
    semi = np.asarray(semi_axes, np.float32)
    level = np.linalg.norm(local / semi, axis=1)
    slope = np.linalg.norm(local / semi**2, axis=1)
    return np.where(slope > 1e-6, level * (level - 1) / np.maximum(slope, 1e-6), -semi.min())


def tube(points: np.ndarray, path: np.ndarray, radius: float) -> np.ndarray:
    """Exact distance to the union of capsules along a polyline (K, 3)."""
    path = np.asarray(path, np.float32)
    nearest = np.full(len(points), np.inf, np.float32)
    for start, end in pairwise(path):
        along = end - start
        offset = points - start
        share = np.clip(offset @ along / (along @ along), 0, 1)
        nearest = np.minimum(nearest, np.linalg.norm(offset - share[:, None] * along, axis=1))
    return nearest - radius


def smooth_union(first: np.ndarray, second: np.ndarray, blend_mm: float) -> np.ndarray:
    """Union whose inner edge is rounded over about `blend_mm` (polynomial smooth minimum)."""
    mix = np.maximum(blend_mm - np.abs(first - second), 0) / blend_mm
    return np.minimum(first, second) - mix * mix * blend_mm / 4


@dataclass(frozen=True, eq=False)
class Profile:
    """A solid of revolution about z, its distance tabulated over (radius, z).

    Attributes:
        table: (rows over z, columns over radius) signed distances, mm.
        low_z: z of the first row, mm.
        step: spacing of the table, mm.
        outline: (K, 2) radius and z along the silhouette from the bottom's rim to the top.
    """

    table: np.ndarray
    low_z: float
    step: float
    outline: np.ndarray

    @classmethod
    def through(cls, knots: np.ndarray, step: float = 0.1, margin: float = 14.0) -> Profile:
        """A flat-bottomed solid whose silhouette runs smoothly through `knots`.

        Args:
            knots: (K, 2) radius and z in mm, from the rim of the flat bottom up to the axis at the top.
            step: spacing of the table in mm; distances are exact at its nodes and linear between.
            margin: how far the table reaches beyond the solid in mm.
        """
        knots = np.asarray(knots, np.float64)
        chords = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(knots, axis=0), axis=1))])
        spline = make_interp_spline(chords, knots, k=3)
        outline = np.asarray(spline(np.linspace(0, chords[-1], 2000)))
        outline[:, 0] = np.maximum(outline[:, 0], 0.0)
        outline[-1, 0] = 0.0
        bottom = np.stack([np.linspace(0, outline[0, 0], 400)[:-1], np.full(399, outline[0, 1])], axis=1)
        line = np.concatenate([bottom, outline])
        radii = np.arange(0, line[:, 0].max() + margin, step)
        heights = np.arange(line[:, 1].min() - margin, line[:, 1].max() + margin, step)
        grid = np.stack(np.meshgrid(radii, heights), axis=-1)
        distance = _distance_to_line(grid.reshape(-1, 2), line).reshape(grid.shape[:2])
        inside = _inside(grid.reshape(-1, 2), line).reshape(grid.shape[:2])
        return cls(np.where(inside, -distance, distance).astype(np.float32), float(heights[0]), step, outline)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distances (N,) at points (N, 3)."""
        radius = np.hypot(points[:, 0], points[:, 1])
        position = np.stack([(points[:, 2] - self.low_z) / self.step, radius / self.step])
        return map_coordinates(self.table, position, order=1, mode="nearest", output=np.float32)

    def radius(self, z: np.ndarray | float) -> np.ndarray:
        """Outer radius in mm at height z."""
        return np.interp(z, self.outline[:, 1], self.outline[:, 0])


def moved(distance: SignedDistance, scale: float = 1.0, shift: Sequence[float] = (0.0, 0.0, 0.0)) -> SignedDistance:
    """The solid scaled about the origin, then shifted by `shift` mm."""
    offset = np.asarray(shift, np.float32)
    return lambda points: scale * distance((points - offset) / np.float32(scale))


def shrunk(distance: SignedDistance, wall_mm: float) -> SignedDistance:
    """The solid with `wall_mm` taken off its surface: the cavity that leaves a wall of that thickness."""
    return lambda points: distance(points) + wall_mm


def _distance_to_line(points: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Distance of 2D points to a dense polyline: the nearest vertex, then the two segments that meet there."""
    _, nearest = cKDTree(line).query(points)
    best = np.full(len(points), np.inf)
    for first in (np.maximum(nearest - 1, 0), np.minimum(nearest, len(line) - 2)):
        start, along = line[first], line[first + 1] - line[first]
        share = np.clip(((points - start) * along).sum(1) / (along**2).sum(1), 0, 1)
        best = np.minimum(best, np.linalg.norm(points - start - share[:, None] * along, axis=1))
    return best


def _inside(points: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Whether 2D points (radius, z) lie between the axis and the line (even-odd rule towards larger radius)."""
    heights, index = np.unique(points[:, 1], return_inverse=True)
    low, high = np.minimum(line[:-1, 1], line[1:, 1]), np.maximum(line[:-1, 1], line[1:, 1])
    inside = np.zeros(len(points), bool)
    order = np.argsort(index, kind="stable")
    groups = np.split(order, np.cumsum(np.bincount(index))[:-1])
    for height, members in zip(heights, groups, strict=True):
        crossed = np.flatnonzero((low <= height) & (height < high))
        share = (height - line[crossed, 1]) / (line[crossed + 1, 1] - line[crossed, 1])
        crossings = np.sort(line[crossed, 0] + share * (line[crossed + 1, 0] - line[crossed, 0]))
        beyond = len(crossings) - np.searchsorted(crossings, points[members, 0])
        inside[members] = beyond % 2 == 1
    return inside
