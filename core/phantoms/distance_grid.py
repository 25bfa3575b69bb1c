"""A signed distance on a grid, and rays through it: first hits, crossings, soft shadows (Numba).

Between nodes the distance is linear, so a smooth surface of curvature radius R is off by about spacing² / 8R:
2 µm for a 0.5 mm grid and a radius of 15 mm. One table serves a few million rays at some nanoseconds a look-up,
whatever the shape costs to evaluate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..compiled import njit, prange
from .model import SignedDistance

_COARSE_MM = 2.0
# One level of refinement goes no further than this: where it evaluates is decided by values interpolated before.
_LARGEST_FACTOR = 6.0
_MOST_NODES = 24_000_000


@dataclass(frozen=True, eq=False)
class DistanceGrid:
    """Signed distances at the nodes of a regular grid.

    Attributes:
        values: (nz, ny, nx) float32, mm.
        origin: (3,) x, y, z of node [0, 0, 0], mm.
        spacing: mm.
    """

    values: np.ndarray
    origin: np.ndarray
    spacing: float

    @classmethod
    def bake(cls, distance: SignedDistance, size_mm: np.ndarray, spacing: float) -> DistanceGrid:
        """Tabulates `distance` over the part of the box (about the origin) that the solid fills.

        Args:
            size_mm: (3,) extent of the box that holds the solid.
            spacing: mm between nodes; wider where the solid's box would need more than 24 million of them (96 MB).
        """
        half = 0.5 * np.asarray(size_mm, np.float64) + _COARSE_MM
        axes = [np.arange(-h, h + _COARSE_MM, _COARSE_MM) for h in half]
        coarse = _evaluate(distance, axes)
        filled = np.argwhere(coarse < _COARSE_MM * 0.87)
        if len(filled) == 0:
            return cls(np.full((2, 2, 2), _COARSE_MM, np.float32), np.zeros(3), spacing)
        low = np.array([axes[k][filled[:, 2 - k].min()] for k in range(3)]) - _COARSE_MM
        high = np.array([axes[k][filled[:, 2 - k].max()] for k in range(3)]) + _COARSE_MM
        spacing = max(spacing, float(np.prod(high - low) / _MOST_NODES) ** (1 / 3))
        return cls(_refined(distance, coarse, axes, low, high, spacing), low, spacing)

    def first_hits(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """(N,) mm along rays (N, 3) to the surface; infinite where a ray misses."""
        return _first_hits(self.values, self.origin, self.spacing, _rays(origins), _rays(directions))

    def distances(self, points: np.ndarray) -> np.ndarray:
        """(N,) signed distances at points (N, 3), mm."""
        return _distances(self.values, self.origin, self.spacing, _rays(points))

    def normals(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) unit normals at points (N, 3), by central differences one node either way."""
        return _normals(self.values, self.origin, self.spacing, _rays(points))

    def light(self, points: np.ndarray, normals: np.ndarray, direction: np.ndarray, softness: float) -> np.ndarray:
        """(N,) share 0..1 of a wide light in unit `direction` that reaches surface points, softly shadowed."""
        return _light(self.values, self.origin, self.spacing, _rays(points), _rays(normals), _rays(direction), softness)

    def openness(self, points: np.ndarray, normals: np.ndarray, reach_mm: float) -> np.ndarray:
        """(N,) 0..1, how little of the surroundings up to `reach_mm` blocks ambient light."""
        return _openness(self.values, self.origin, self.spacing, _rays(points), _rays(normals), reach_mm)


def _rays(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, np.float64)


def _evaluate(distance: SignedDistance, axes: list[np.ndarray]) -> np.ndarray:
    x, y, z = (np.asarray(axis, np.float32) for axis in axes)
    values = np.empty((len(z), len(y), len(x)), np.float32)
    layer = np.stack(np.broadcast_arrays(x[None, :], y[:, None], np.float32(0)), axis=-1).reshape(-1, 3).copy()
    for index, height in enumerate(z):
        layer[:, 2] = height
        values[index] = distance(layer).reshape(len(y), len(x))
    return values


def _refined(
    distance: SignedDistance,
    values: np.ndarray,
    axes: list[np.ndarray],
    low: np.ndarray,
    high: np.ndarray,
    spacing: float,
) -> np.ndarray:
    """Values at nodes `spacing` apart from `low` to `high`, from those at `axes` (x, y, z), `_COARSE_MM` apart."""
    before = _COARSE_MM
    while True:
        step = max(spacing, before / _LARGEST_FACTOR)
        nodes = [np.arange(low[k], high[k] + step, step) for k in range(3)]
        values = _interpolated(values, axes, nodes)
        # Exact near the surface; elsewhere a value only says how far one may step.
        k, j, i = np.nonzero(np.abs(values) < 1.5 * before)
        values[k, j, i] = distance(np.stack([nodes[0][i], nodes[1][j], nodes[2][k]], axis=1).astype(np.float32))
        if step == spacing:
            return values
        axes, before = nodes, step


def _interpolated(values: np.ndarray, axes: list[np.ndarray], nodes: list[np.ndarray]) -> np.ndarray:
    for axis, dimension in enumerate((2, 1, 0)):
        position = (nodes[dimension] - axes[dimension][0]) / (axes[dimension][1] - axes[dimension][0])
        low = np.clip(position.astype(int), 0, values.shape[axis] - 2)
        shape = [-1 if k == axis else 1 for k in range(3)]
        part = np.clip(position - low, 0, 1).reshape(shape).astype(np.float32)
        values = values.take(low, axis) * (1 - part) + values.take(low + 1, axis) * part
    return values


@njit(cache=True, inline="always")
def look_up(values, x, y, z):  # type: ignore[no-untyped-def]
    """Trilinear value at grid coordinates, which must lie inside."""
    nz, ny, nx = values.shape
    i, j, k = min(int(x), nx - 2), min(int(y), ny - 2), min(int(z), nz - 2)
    a, b, c = x - i, y - j, z - k
    near = (values[k, j, i] * (1 - a) + values[k, j, i + 1] * a) * (1 - b) + (
        values[k, j + 1, i] * (1 - a) + values[k, j + 1, i + 1] * a
    ) * b
    far = (values[k + 1, j, i] * (1 - a) + values[k + 1, j, i + 1] * a) * (1 - b) + (
        values[k + 1, j + 1, i] * (1 - a) + values[k + 1, j + 1, i + 1] * a
    ) * b
    return near * (1 - c) + far * c


@njit(cache=True)
def at(values, origin, spacing, point, direction, s):  # type: ignore[no-untyped-def]
    """Distance at point + s · direction; outside the grid its nearest value plus the way there."""
    nz, ny, nx = values.shape
    x = (point[0] + s * direction[0] - origin[0]) / spacing
    y = (point[1] + s * direction[1] - origin[1]) / spacing
    z = (point[2] + s * direction[2] - origin[2]) / spacing
    inner_x, inner_y, inner_z = min(max(x, 0.0), nx - 1.0), min(max(y, 0.0), ny - 1.0), min(max(z, 0.0), nz - 1.0)
    beyond = np.sqrt((x - inner_x) ** 2 + (y - inner_y) ** 2 + (z - inner_z) ** 2)
    return look_up(values, inner_x, inner_y, inner_z) + beyond * spacing


@njit(cache=True)
def clip(values, origin, spacing, point, direction):  # type: ignore[no-untyped-def]
    """Where an infinite ray enters and leaves the grid's box; entry > exit when it misses."""
    enter, leave = -np.inf, np.inf
    for axis in range(3):
        low = origin[axis]
        high = low + (values.shape[2 - axis] - 1) * spacing
        if abs(direction[axis]) < 1e-12:
            if point[axis] < low or point[axis] > high:
                return 1.0, 0.0
            continue
        first = (low - point[axis]) / direction[axis]
        second = (high - point[axis]) / direction[axis]
        enter = max(enter, min(first, second))
        leave = min(leave, max(first, second))
    return enter, leave


@njit(cache=True)
def crossing(values, origin, spacing, point, direction, low, low_value, high, high_value):  # type: ignore[no-untyped-def]
    """The root between two values of opposite sign (false position, Illinois variant)."""
    side = 0
    root = low
    for _ in range(12):
        root = (low * high_value - high * low_value) / (high_value - low_value)
        value = at(values, origin, spacing, point, direction, root)
        if abs(value) < 1e-5:
            break
        if (value < 0) == (high_value < 0):
            high, high_value = root, value
            low_value = low_value * 0.5 if side == 1 else low_value
            side = 1
        else:
            low, low_value = root, value
            high_value = high_value * 0.5 if side == -1 else high_value
            side = -1
    return root


@njit(cache=True, parallel=True)
def _first_hits(values, origin, spacing, origins, directions):  # type: ignore[no-untyped-def]
    hits = np.full(len(origins), np.inf)
    for ray in prange(len(origins)):
        point, direction = origins[ray], directions[ray]
        s, leave = clip(values, origin, spacing, point, direction)
        s = max(s, 0.0)
        if s >= leave:
            continue
        value = at(values, origin, spacing, point, direction, s)
        while s < leave:
            ahead = s + max(0.8 * value, 0.25 * spacing)
            next_value = at(values, origin, spacing, point, direction, ahead)
            if next_value <= 0 < value:
                hits[ray] = crossing(values, origin, spacing, point, direction, s, value, ahead, next_value)
                break
            s, value = ahead, next_value
    return hits


@njit(cache=True, parallel=True)
def _distances(values, origin, spacing, points):  # type: ignore[no-untyped-def]
    found = np.empty(len(points))
    still = np.zeros(3)
    for index in prange(len(points)):
        found[index] = at(values, origin, spacing, points[index], still, 0.0)
    return found


@njit(cache=True, parallel=True)
def _normals(values, origin, spacing, points):  # type: ignore[no-untyped-def]
    normals = np.empty((len(points), 3))
    axes = np.eye(3)
    for index in prange(len(points)):
        for axis in range(3):
            ahead = at(values, origin, spacing, points[index], axes[axis], spacing)
            behind = at(values, origin, spacing, points[index], axes[axis], -spacing)
            normals[index, axis] = ahead - behind
        length = np.sqrt(np.sum(normals[index] ** 2))
        normals[index] /= max(length, 1e-12)
    return normals


@njit(cache=True, parallel=True)
def _light(values, origin, spacing, points, normals, direction, softness):  # type: ignore[no-untyped-def]
    # Penumbra estimate of Aaltonen (GDC 2018) in its simplest form: least distance over path length.
    shares = np.ones(len(points))
    for index in prange(len(points)):
        start = points[index] + 2.0 * spacing * normals[index]
        _, leave = clip(values, origin, spacing, start, direction)
        s, share = 0.5 * spacing, 1.0
        while s < leave and share > 0:
            value = at(values, origin, spacing, start, direction, s)
            share = min(share, 0.5 + 0.5 * value / (softness * s))
            s += max(0.8 * abs(value), 0.75 * spacing)
        share = min(max(share, 0.0), 1.0)
        shares[index] = share * share * (3.0 - 2.0 * share)
    return shares


@njit(cache=True, parallel=True)
def _openness(values, origin, spacing, points, normals, reach_mm):  # type: ignore[no-untyped-def]
    shares = np.ones(len(points))
    steps = 5
    for index in prange(len(points)):
        blocked, weight = 0.0, 1.0
        for step in range(1, steps + 1):
            s = reach_mm * step / steps
            value = at(values, origin, spacing, points[index], normals[index], s)
            blocked += weight * max(s - value, 0.0) / s
            weight *= 0.7
        shares[index] = max(1.0 - blocked / 2.8, 0.0)
    return shares
