"""Solids whose exact distance has no formula: distances tabulated from any implicit function, and bent wires."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PchipInterpolator, make_interp_spline
from scipy.ndimage import spline_filter
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from ..compiled import njit, prange
from ..threads import loops_only
from .model import SignedDistance


@dataclass(frozen=True, eq=False)
class SolidTable:
    """The true signed distance to the zero set of an implicit function, tabulated.

    Smooth unions and cross sections that change along an axis give functions that are zero on the wanted surface
    but are no distances elsewhere; a wall of constant thickness cannot be cut from them. From this table it can.

    Attributes:
        coefficients: (nz, ny, nx) cubic spline coefficients of the distances, mm.
        low: (3,) x, y, z of node [0, 0, 0], mm.
        step: mm between nodes.
    """

    coefficients: np.ndarray
    low: np.ndarray
    step: float

    @classmethod
    def of(
        cls, implicit: SignedDistance, low: Sequence[float], high: Sequence[float], step: float = 0.75
    ) -> SolidTable:
        """Tabulates over the box from `low` to `high` (mm), which must hold the solid.

        Args:
            implicit: (N, 3) points -> (N,), negative inside, about linear within `step` of its zero set.
            step: mm between nodes; edges sharper than that come out rounded.
        """
        axes = [np.arange(low[k], high[k] + step, step) for k in range(3)]
        grid = np.stack(np.meshgrid(axes[2], axes[1], axes[0], indexing="ij")[::-1], axis=-1)
        points = grid.reshape(-1, 3).astype(np.float32)
        values = implicit(points).reshape(grid.shape[:3])
        corners, _, normals, _ = marching_cubes(values, 0.0, gradient_direction="ascent")
        places = np.asarray(low) + step * corners[:, ::-1]
        reach, nearest = cKDTree(places).query(points)
        # The nearest corner lies up to a step beside the nearest point. Its tangent plane makes up for that where
        # the surface is smooth; the second bound holds at edges, where planes say too little.
        plane = np.abs(((points - places[nearest]) * normals[nearest][:, ::-1]).sum(axis=1))
        away = np.maximum(plane, np.sqrt(np.maximum(reach**2 - step**2, 0.0)))
        distance = np.where(values.ravel() < 0, -away, away).reshape(values.shape)
        return cls(spline_filter(distance, order=3).astype(np.float32), np.asarray(low, np.float32), step)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distances (N,) at points (N, 3); beyond the table that of its nearest point, which is less."""
        return _spline(self.coefficients, self.low, self.step, np.ascontiguousarray(points, np.float32))


@njit(cache=True, inline="always")
def _weights(share):  # type: ignore[no-untyped-def]
    """Of the four nodes around, for a uniform cubic B-spline."""
    rest = 1.0 - share
    before, after = rest * rest * rest / 6.0, share * share * share / 6.0
    first = 2.0 / 3.0 - share * share * (1.0 - 0.5 * share)
    return before, first, 1.0 - before - first - after, after


@njit(cache=True, parallel=loops_only())
def _spline(coefficients, low, step, points):  # type: ignore[no-untyped-def]
    nz, ny, nx = coefficients.shape
    values = np.empty(len(points), np.float32)
    for index in prange(len(points)):
        x = min(max((points[index, 0] - low[0]) / step, 1.0), nx - 2.001)
        y = min(max((points[index, 1] - low[1]) / step, 1.0), ny - 2.001)
        z = min(max((points[index, 2] - low[2]) / step, 1.0), nz - 2.001)
        i, j, k = int(x), int(y), int(z)
        along_x, along_y, along_z = _weights(x - i), _weights(y - j), _weights(z - k)
        total = 0.0
        for c in range(4):
            for b in range(4):
                row = coefficients[k + c - 1, j + b - 1]
                line = 0.0
                for a in range(4):
                    line += along_x[a] * row[i + a - 1]
                total += along_z[c] * along_y[b] * line
        values[index] = total
    return values


class Wire:
    """Round bars of one radius along curves.

    Args:
        paths: curves, each (K, 3) points in mm, joined by straight lines.
        radius: mm.
        reach: mm from the axis up to which distances are told; beyond it they are `reach` − radius.
    """

    def __init__(self, paths: Sequence[np.ndarray], radius: float, reach: float = 8.0) -> None:
        self._tree = cKDTree(np.concatenate([_dense(np.asarray(path, np.float64), 0.25 * radius) for path in paths]))
        self._radius, self._reach = radius, reach

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distances (N,) at points (N, 3), good to 0.01 radius at the surface."""
        found, _ = self._tree.query(points, distance_upper_bound=self._reach)
        return (np.minimum(found, self._reach) - self._radius).astype(np.float32)


def curve(points: Sequence[Sequence[float]], count: int = 40) -> np.ndarray:
    """(count, 3) points on a smooth curve through the given ones, mm."""
    knots = np.asarray(points, np.float64)
    chords = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(knots, axis=0), axis=1))])
    spline = make_interp_spline(chords, knots, k=min(3, len(knots) - 1))
    return np.asarray(spline(np.linspace(0, chords[-1], count)))


def loft(sections: np.ndarray, power: float, center_y: float = 0.0) -> Callable[[np.ndarray], np.ndarray]:
    """Implicit function of superellipses stacked along z, cut flat at both ends.

    Args:
        sections: (K, 4) rows of z, half width along x, reach towards −y, reach towards +y, in mm, z ascending.
        power: exponent; 2 is an ellipse, more is squarer.
    """
    heights = np.linspace(sections[0, 0], sections[-1, 0], 1000)
    smooth = PchipInterpolator(sections[:, 0], sections[:, 1:])(heights)

    def implicit(points: np.ndarray) -> np.ndarray:
        x, y, z = points[:, 0], points[:, 1] - center_y, points[:, 2]
        width, front, back = (np.interp(z, heights, smooth[:, k]) for k in range(3))
        depth = np.where(y < 0, front, back)
        level = (np.abs(x / width) ** power + np.abs(y / depth) ** power) ** (1 / power)
        side = (level - 1) * np.minimum(width, depth)
        return np.maximum(side, np.maximum(z - heights[-1], heights[0] - z)).astype(np.float32)

    return implicit


def inside_only(guard: SignedDistance, detail: SignedDistance, depth_mm: float) -> SignedDistance:
    """`detail`, computed only where it can matter: it lies at least `depth_mm` under the surface of `guard`."""

    def distance(points: np.ndarray) -> np.ndarray:
        found = guard(points) + np.float32(depth_mm)
        close = np.flatnonzero(found < depth_mm)
        if len(close):
            found[close] = detail(points[close])
        return found

    return distance


def _dense(path: np.ndarray, spacing: float) -> np.ndarray:
    chords = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    along = np.linspace(0, chords[-1], int(np.ceil(chords[-1] / spacing)) + 1)
    return np.stack([np.interp(along, chords, path[:, k]) for k in range(3)], axis=1)
