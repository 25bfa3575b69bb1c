"""A model broken into closed pieces: which solids there are, which splats each holds, what each weighs."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass

import numpy as np
from mathutils.bvhtree import BVHTree
from mathutils.kdtree import KDTree

from ...core.errors import SettingError
from ...core.gaussians import GaussianSet
from ...core.mesh.solids import solid_labels, volume_and_centroid
from ...core.steps import run_through
from .cell_mesh import cell_surface
from .cells import Cell, Wall
from .intersect import Intersection
from .masses import center_of_mass
from .meshes import Surface

# A solid with less of the whole volume is a crumb and stays with its neighbour: noise is no piece.
CRUMB = 5e-4
# By so much of the whole's volume the parts' may differ from it.
_LEAST_WRONG = 5e-3
# Walls with normal and place alike to this many decimals are one.
_DECIMALS = 6
# With less than this share of the mass that its volume has on average, a piece's splats do not tell its middle.
_LEAST_KNOWN = 0.1


@dataclass(frozen=True, eq=False)
class Piece:
    """One closed piece.

    Attributes:
        surface: mm in the model's frame.
        cells: numbers of the cells that it was cut from: one, and those of its crumbs.
        volume_mm3: that it encloses.
        splats: (n,) numbers of the model's splats whose centres it holds.
        mass_g: of its splats; of its volume where it holds none.
        center_mm: (3,) centre of mass.
    """

    surface: Surface
    cells: tuple[int, ...]
    volume_mm3: float
    splats: np.ndarray
    mass_g: float
    center_mm: np.ndarray


@dataclass(frozen=True, eq=False)
class Solid:
    """A closed part of the model before it is known what is in it; as in `Piece`."""

    surface: Surface
    cells: tuple[int, ...]
    volume_mm3: float
    centroid_mm: np.ndarray


def cut_in_steps(
    whole: Surface, cells: Sequence[Cell], spacing_mm: float
) -> Generator[float, None, tuple[list[Solid], list[Wall]]]:
    """The solids that cells divide a closed surface into, and the walls that their broken faces are numbered by.

    A cell may hold several; a closed inner surface belongs to the solid around it. Yields the share that is done.

    Args:
        spacing_mm: between vertices on broken faces.

    Raises:
        MeshFileError: the surface is not closed, or the parts do not add up to it.
        SettingError: no cell holds any of it.
    """
    walls: dict[tuple[float, ...], tuple[int, Wall]] = {}
    solids, enclosed = [], 0.0
    with Intersection(whole) as intersection:
        for index, cell in enumerate(cells):
            yield index / len(cells)
            numbers = {face: _number(wall, walls) for face, wall in enumerate(cell.walls) if wall is not None}
            part = intersection.with_(cell_surface(cell, spacing_mm, numbers))
            enclosed += volume_and_centroid(part.vertices, part.faces)[0]
            label = solid_labels(part.vertices, part.faces)
            for number in range(int(label.max(initial=-1)) + 1):
                surface = part.select(label == number)
                volume, centroid = volume_and_centroid(surface.vertices, surface.faces)
                if volume > 0:
                    solids.append(Solid(surface, (index,), volume, centroid))
        volume = volume_and_centroid(whole.vertices, whole.faces)[0]
        if abs(enclosed - volume) > _LEAST_WRONG * abs(volume):
            raise intersection.failed()
    if not solids:
        raise SettingError("the cells hold nothing of the model; choose planes or places that meet it.")
    return _without_crumbs(solids), [wall for _, wall in walls.values()]


def fill_in_steps(
    solids: Sequence[Solid], cell_of_splat: np.ndarray, gaussians: GaussianSet, masses: np.ndarray
) -> Generator[float, None, list[Piece]]:
    """The solids with their splats, masses and centres of mass; the masses add up to that of all splats.

    Yields the share that is done.

    Args:
        cell_of_splat: (N,) number of the cell that each splat's centre is in.
        masses: (N,) grams.
    """
    owner = yield from owners_in_steps(solids, gaussians.means, cell_of_splat)
    splats = [np.flatnonzero(owner == index) for index in range(len(solids))]
    total, volume = float(masses.sum()), sum(solid.volume_mm3 for solid in solids)
    own = np.array([masses[held].sum() for held in splats])
    mean = np.array([total * solid.volume_mm3 / volume for solid in solids])
    weights = np.where(own > 0, own, mean)
    weights *= total / weights.sum()
    pieces = []
    for index, solid in enumerate(solids):
        center = solid.centroid_mm
        if own[index] > _LEAST_KNOWN * mean[index]:
            middle = center_of_mass(gaussians.select(splats[index]), masses[splats[index]])
            low, high = solid.surface.vertices.min(axis=0), solid.surface.vertices.max(axis=0)
            # Splats may lie a little outside of a thin piece.
            center = np.clip(middle, low, high)
        pieces.append(Piece(solid.surface, solid.cells, solid.volume_mm3, splats[index], float(weights[index]), center))
    return pieces


def owners(solids: Sequence[Solid | Piece], points: np.ndarray, cell_of_point: np.ndarray) -> np.ndarray:
    """All of `owners_in_steps` at once."""
    return run_through(owners_in_steps(solids, points, cell_of_point))


def owners_in_steps(
    solids: Sequence[Solid | Piece], points: np.ndarray, cell_of_point: np.ndarray
) -> Generator[float, None, np.ndarray]:
    """(P,) number of the solid that each point (P, 3) lies in or nearest to, of those in its cell.

    The surface nearest to a point within a solid is that solid's own. Where a cell holds none, all count. A point
    that is no number goes to any. Yields the share that is done.
    """
    by_cell: dict[int, list[int]] = {}
    for index, solid in enumerate(solids):
        for cell in solid.cells:
            by_cell.setdefault(cell, []).append(index)
    everywhere = list(range(len(solids)))
    result = np.zeros(len(points), np.int64)
    cells = np.unique(cell_of_point)
    for number, cell in enumerate(cells):
        yield number / len(cells)
        there = np.flatnonzero(cell_of_point == cell)
        candidates = by_cell.get(int(cell), everywhere)
        if len(candidates) == 1:
            result[there] = candidates[0]
            continue
        tree, solid_of_face = _tree([solids[index].surface for index in candidates])
        nearest = [tree.find_nearest(point)[2] for point in np.nan_to_num(points[there]).tolist()]
        result[there] = np.array(candidates)[solid_of_face[np.array(nearest)]]
    return result


def _tree(surfaces: Sequence[Surface]) -> tuple[BVHTree, np.ndarray]:
    """All faces of some surfaces, and (F,) which surface each is of."""
    starts = np.cumsum([0, *(len(surface.vertices) for surface in surfaces)])
    faces = np.concatenate([surface.faces + start for surface, start in zip(surfaces, starts, strict=False)])
    vertices = np.concatenate([surface.vertices for surface in surfaces])
    which = np.repeat(np.arange(len(surfaces)), [len(surface.faces) for surface in surfaces])
    return BVHTree.FromPolygons(vertices.tolist(), faces.tolist(), all_triangles=True), which


def _number(wall: Wall, known: dict[tuple[float, ...], tuple[int, Wall]]) -> int:
    """The number of a wall, the same from both of its sides."""
    across = int(np.argmax(np.abs(wall.normal)))
    sign = np.sign(wall.normal[across])
    key = tuple(np.round(sign * np.array([*wall.normal, wall.offset]), _DECIMALS) + 0.0)
    return known.setdefault(key, (len(known), wall))[0]


def _without_crumbs(solids: list[Solid]) -> list[Solid]:
    """Solids, those too small to be pieces joined to the one nearest to them: mostly what they were chipped from."""
    least = CRUMB * sum(solid.volume_mm3 for solid in solids)
    large = [solid for solid in solids if solid.volume_mm3 >= least] or [max(solids, key=lambda s: s.volume_mm3)]
    crumbs = [solid for solid in solids if solid not in large]
    if not crumbs:
        return large
    tree = KDTree(sum(len(solid.surface.vertices) for solid in large))
    which = np.repeat(np.arange(len(large)), [len(solid.surface.vertices) for solid in large])
    for index, place in enumerate(np.concatenate([solid.surface.vertices for solid in large]).tolist()):
        tree.insert(place, index)
    tree.balance()
    joined: list[list[Solid]] = [[solid] for solid in large]
    for crumb in crumbs:
        nearest = min((tree.find(place) for place in crumb.surface.vertices.tolist()), key=lambda found: found[2])
        joined[which[nearest[1]]].append(crumb)
    return [_joined(group) if len(group) > 1 else group[0] for group in joined]


def _joined(group: list[Solid]) -> Solid:
    surfaces = [solid.surface for solid in group]
    starts = np.cumsum([0, *(len(surface.vertices) for surface in surfaces)])
    surface = Surface(
        np.concatenate([part.vertices for part in surfaces]),
        np.concatenate([part.faces + start for part, start in zip(surfaces, starts, strict=False)]),
        np.concatenate([part.colors for part in surfaces]),
        np.concatenate([part.wall for part in surfaces]),
    )
    volume, centroid = volume_and_centroid(surface.vertices, surface.faces)
    return Solid(surface, tuple(dict.fromkeys(cell for solid in group for cell in solid.cells)), volume, centroid)
