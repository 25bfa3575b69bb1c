"""All parts of a phantom as tables of their distances: path lengths by material along rays, and voxel means (Numba).

Where parts overlap the last one counts, as `Part` says: along a ray the crossings of all parts are sorted and swept,
so that lengths are exact to the tables' accuracy however thin a part is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..compiled import njit, prange
from ..threads import loops_only
from .distance_grid import DistanceGrid, at, clip, crossing
from .materials import Material
from .model import Part, Phantom

# A wire of radius R in a table of spacing h comes out thinner by h² / 8R: 1 % of R for this share of R.
_SPACING_OF_DEPTH = 0.28
_FINEST_MM = 0.04


@dataclass(frozen=True, eq=False)
class PartTables:
    """The parts' distances in one array, each part with a box and a spacing of its own.

    Attributes:
        values: (total,) float32 mm, the tables (nz, ny, nx) of all P parts one after the other.
        starts: (P + 1,) where each begins.
        shapes: (P, 3) nz, ny, nx.
        origins: (P, 3) x, y, z of each first node, mm.
        spacings: (P,) mm.
        depths: (P,) mm, half the thickness of a part's thinnest place as far as it is known: see `Part.thinnest_mm`.
        kinds: (P,) index into `materials`, -1 for air.
        materials: those that occur.
    """

    values: np.ndarray
    starts: np.ndarray
    shapes: np.ndarray
    origins: np.ndarray
    spacings: np.ndarray
    depths: np.ndarray
    kinds: np.ndarray
    materials: tuple[Material, ...]

    @classmethod
    def bake(cls, phantom: Phantom, table_mm: float = 0.4, step: Callable[[int], None] | None = None) -> PartTables:
        """Tabulates all parts.

        Args:
            table_mm: the widest spacing; thin parts get a finer one, see `Part.thinnest_mm`.
            step: called with the number of parts done so far.
        """
        materials = tuple(dict.fromkeys(part.material for part in phantom.parts if part.material is not None))
        grids = []
        for index, part in enumerate(phantom.parts):
            grids.append(bake_part(part, np.array(phantom.size_mm), table_mm))
            if step is not None:
                step(index + 1)
        return cls(
            values=np.concatenate([grid.values.ravel() for grid in grids]),
            starts=np.cumsum([0, *(grid.values.size for grid in grids)]),
            shapes=np.array([grid.values.shape for grid in grids]),
            origins=np.array([grid.origin for grid in grids], np.float64),
            spacings=np.array([grid.spacing for grid in grids], np.float64),
            depths=np.array([_depth(part, grid) for part, grid in zip(phantom.parts, grids, strict=True)]),
            kinds=np.array([-1 if p.material is None else materials.index(p.material) for p in phantom.parts]),
            materials=materials,
        )

    def lengths(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """(materials, N) mm of each material along rays (N, 3), unit directions, infinite both ways."""
        found = np.zeros((len(origins), len(self.materials)))
        _lengths(*self._arrays(), np.ascontiguousarray(origins, float), np.ascontiguousarray(directions, float), found)
        return found.T

    def voxel_means(self, points: np.ndarray, spacing_mm: float, attenuations: np.ndarray) -> np.ndarray:
        """(N,) attenuation averaged over voxels of `spacing_mm` centred on points (N, 3).

        A voxel that a surface cuts is divided by three along each axis, and each of its 27 shares counts by the part
        that the distance at its centre implies.

        Args:
            attenuations: (materials,) mm⁻¹.
        """
        solid = np.where(self.kinds < 0, 0.0, np.append(attenuations, 0.0)[self.kinds])
        found = np.zeros(len(points))
        _voxel_means(self._arrays()[:-1], solid, np.ascontiguousarray(points, float), float(spacing_mm), found)
        return found

    def inside(self, points: np.ndarray) -> np.ndarray:
        """(P, N) bool, whether each part holds each of the points (N, 3), whatever takes its place there."""
        found = np.zeros((len(self.kinds), len(points)), np.bool_)
        _inside(self._arrays()[:-1], np.ascontiguousarray(points, float), found)
        return found

    def _arrays(self) -> tuple[np.ndarray, ...]:
        return self.values, self.starts, self.shapes, self.origins, self.spacings, self.kinds


def bake_part(part: Part, size_mm: np.ndarray, table_mm: float) -> DistanceGrid:
    """A part's distances, at most `table_mm` apart and finer where the part is thin."""
    grid = DistanceGrid.bake(part.distance, size_mm, table_mm)
    spacing = max(_SPACING_OF_DEPTH * _depth(part, grid), _FINEST_MM)
    return grid if spacing >= grid.spacing else DistanceGrid.bake(part.distance, size_mm, spacing)


def _depth(part: Part, grid: DistanceGrid) -> float:
    return max(float(-grid.values.min()), 0.0) if part.thinnest_mm is None else 0.5 * part.thinnest_mm


@njit(cache=True, inline="always")
def _table(values, starts, shapes, part):  # type: ignore[no-untyped-def]
    nz, ny, nx = shapes[part]
    return values[starts[part] : starts[part + 1]].reshape((nz, ny, nx))


@njit(cache=True)
def _noted(events, whose, count, s, part):  # type: ignore[no-untyped-def]
    """One more crossing, kept in order of s; grows the lists where they are full."""
    if count == len(events):
        events = np.append(events, np.zeros(count))
        whose = np.append(whose, np.zeros(count, np.int64))
    place = count
    while place > 0 and events[place - 1] > s:
        events[place], whose[place] = events[place - 1], whose[place - 1]
        place -= 1
    events[place], whose[place] = s, part
    return events, whose, count + 1


@njit(cache=True)
def _crossings(grid, origin, spacing, part, point, direction, events, whose, count):  # type: ignore[no-untyped-def]
    """Adds all crossings of a part's surface along a ray; a part that reaches out of its box ends there."""
    s, leave = clip(grid, origin, spacing, point, direction)
    if s >= leave:
        return events, whose, count
    value = at(grid, origin, spacing, point, direction, s)
    if value < 0:
        events, whose, count = _noted(events, whose, count, s, part)
    while s < leave:
        ahead = min(s + max(0.8 * abs(value), 0.25 * spacing), leave)
        next_value = at(grid, origin, spacing, point, direction, ahead)
        if (value < 0) != (next_value < 0):
            root = crossing(grid, origin, spacing, point, direction, s, value, ahead, next_value)
            events, whose, count = _noted(events, whose, count, root, part)
        s, value = ahead, next_value
    if value < 0:
        events, whose, count = _noted(events, whose, count, leave, part)
    return events, whose, count


@njit(cache=True, parallel=loops_only())
def _lengths(values, starts, shapes, origins, spacings, kinds, points, directions, found):  # type: ignore[no-untyped-def]
    parts = len(kinds)
    for ray in prange(len(points)):
        events, whose, count = np.zeros(32), np.zeros(32, np.int64), 0
        for part in range(parts):
            grid = _table(values, starts, shapes, part)
            events, whose, count = _crossings(
                grid, origins[part], spacings[part], part, points[ray], directions[ray], events, whose, count
            )
        inside = np.zeros(parts, np.bool_)
        top = -1
        for index in range(count - 1):
            part = whose[index]
            inside[part] = not inside[part]
            if inside[part]:
                top = max(top, part)
            elif part == top:
                top -= 1
                while top >= 0 and not inside[top]:
                    top -= 1
            if top >= 0 and kinds[top] >= 0:
                found[ray, kinds[top]] += events[index + 1] - events[index]


@njit(cache=True)
def _value(tables, part, point):  # type: ignore[no-untyped-def]
    values, starts, shapes, origins, spacings = tables
    still = np.zeros(3)
    return at(_table(values, starts, shapes, part), origins[part], spacings[part], point, still, 0.0)


@njit(cache=True, parallel=loops_only())
def _inside(tables, points, found):  # type: ignore[no-untyped-def]
    for index in prange(len(points)):
        for part in range(len(found)):
            found[part, index] = _value(tables, part, points[index]) < 0


@njit(cache=True)
def _cut_voxel(tables, solid, near, mean, center, size):  # type: ignore[no-untyped-def]
    """Mean over a voxel filled with `mean`, which the parts `near` may cut."""
    third = size / 3.0
    place = np.empty(3)
    total = 0.0
    for share in range(27):
        place[0] = center[0] + third * (share % 3 - 1.0)
        place[1] = center[1] + third * (share // 3 % 3 - 1.0)
        place[2] = center[2] + third * (share // 9 - 1.0)
        mixed = mean
        for part in near:
            inside = min(max(0.5 - _value(tables, part, place) / third, 0.0), 1.0)
            mixed += inside * (solid[part] - mixed)
        total += mixed
    return total / 27.0


@njit(cache=True, parallel=loops_only())
def _voxel_means(tables, solid, points, size, found):  # type: ignore[no-untyped-def]
    reach = 0.87 * size
    for voxel in prange(len(points)):
        # The last part that fills the whole voxel hides those before it; those after it may cut the voxel.
        near, count, mean = np.empty(len(solid), np.int64), 0, 0.0
        for part in range(len(solid)):
            value = _value(tables, part, points[voxel])
            if value <= -reach:
                mean, count = solid[part], 0
            elif value < reach:
                near[count] = part
                count += 1
        found[voxel] = mean if count == 0 else _cut_voxel(tables, solid, near[:count], mean, points[voxel], size)
