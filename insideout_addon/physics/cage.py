"""A coarse cage of boxes around a model's material: what bends in the place of its splats. Numpy alone, no bpy."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from ...core.errors import SettingError
from ...core.gaussians import GaussianSet
from ...core.rotations import normalize_quats, quats_to_matrices
from ...core.steps import run_through
from .cage_cells import chosen_cells, nearest_chosen

# Corners of a cell: corner k is at (k & 1, k >> 1 & 1, k >> 2).
CORNERS = np.array([[k & 1, k >> 1 & 1, k >> 2] for k in range(8)])
# Springs go from corner to corner in these directions: along edges and across faces, and two boxes far along edges and
# through space, which keeps boxes from turning inside out.
_STEPS = {
    step: [(a, b) for a in range(8) for b in range(8) if tuple(CORNERS[b] - CORNERS[a]) == step]
    for step in product((-1, 0, 1), repeat=3)
    if step > (0, 0, 0)
}
FEWEST, MOST = 2, 32
# Share of the mean that the lightest vertex has: without it the solvers' steps would have to be tiny.
_LIGHTEST = 0.2
# How much softer or stiffer than typical material a place may be.
_SOFTEST, _STIFFEST = 0.2, 20.0
# Splats farther from the material than this, in cells, do not move with it: the room that photos saw behind it.
_FARTHEST = 1.0
_FLAT = 1e-6
_PA_MM2_TO_N = 1e-6
# Splats laid out together, for memory's sake.
_AT_ONCE = 8192


@dataclass(frozen=True, eq=False)
class Cage:
    """Boxes on a grid along the axes of the model's own frame; lengths in mm.

    Attributes:
        vertices: (V, 3) corners of the boxes.
        cells: (C, 8) a box's corners, in the order of `CORNERS`.
        springs: (S, 2) vertices that springs hold apart.
        masses: (V,) g.
        stiffness: (V,) N, the force of a spring at a strain of 1, between vertices like this one.
        low: (3,) the grid's lowest corner.
        sides: (3,) of a box.
        index: (nx, ny, nz) the grid's cells: the number of a box, or where there is none -1 - that of the nearest.
    """

    vertices: np.ndarray
    cells: np.ndarray
    springs: np.ndarray
    masses: np.ndarray
    stiffness: np.ndarray
    low: np.ndarray
    sides: np.ndarray
    index: np.ndarray

    def spring_stiffness(self) -> np.ndarray:
        """(S,) N at a strain of 1: the fourth roots of both ends' averaged, as Blender's soft bodies do it."""
        return np.mean(self.stiffness[self.springs] ** 0.25, axis=1) ** 4

    def spring_lengths(self) -> np.ndarray:
        """(S,) mm at rest."""
        ends = self.vertices[self.springs]
        return np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)

    def parts(self) -> np.ndarray:
        """(V,) number of the connected part that each vertex is of."""
        part, (first, second) = np.arange(len(self.vertices)), self.springs.T
        while True:
            lower, before = np.minimum(part[first], part[second]), part.copy()
            np.minimum.at(part, first, lower)
            np.minimum.at(part, second, lower)
            if (part == before).all():
                return np.unique(part, return_inverse=True)[1]

    def frequency(self) -> float:
        """An upper bound of the cage's angular frequencies, 1/s: how fast its quickest wobble is."""
        # N/m, and by Gershgorin's circles the eigenvalues of what springs do to masses.
        stiffness = self.spring_stiffness() / (1e-3 * self.spring_lengths())
        at_vertex = sum(np.bincount(ends, stiffness, len(self.vertices)) for ends in self.springs.T)
        return float(np.sqrt(2 * np.max(at_vertex / (1e-3 * self.masses))))

    def locate(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """In which box points (N, 3) are, or which is nearest, and where in it.

        Returns:
            (N,) numbers of the boxes, -1 for points that are more than a box away from any; and (N, 3) places, 0 to 1
            from the box's lowest corner to its highest and beyond that outside.
        """
        scaled = (np.nan_to_num(points) - self.low) / self.sides
        shape = np.array(self.index.shape)
        x, y, z = np.clip(np.floor(scaled), 0, shape - 1).astype(np.int64).T
        number = self.index[x, y, z]
        number = np.where(number < 0, -1 - number, number)
        corner = np.rint((self.vertices[self.cells[number, 0]] - self.low) / self.sides)
        place = scaled - corner
        away = (np.maximum(-place, place - 1).max(axis=1) > _FARTHEST) | ~np.isfinite(points).all(axis=1)
        return np.where(away, -1, number), place


def build_cage(
    gaussians: GaussianSet,
    masses: np.ndarray,
    surface: np.ndarray,
    resolution: int,
    stiffness_kpa: float,
) -> Cage:
    """The boxes of a grid that hold a model's material, what they weigh, and how stiff they are.

    A splat's mass is laid out on 27 points (Gauss-Hermite, three along each axis) and each point's on the corners of
    its box, trilinearly: total and centre of mass are those of the splats, but for what a least mass of each corner and
    the air left out shift.

    Young's modulus is in proportion to density, so that all of a body carries sound equally fast: what is twice as
    dense is twice as stiff. Springs that pull with K at a strain of 1 make a modulus of E = Σ K·l / 6V, summed over the
    springs of a volume V: the energy of central forces under an even pressure, whose Poisson's ratio is 1/4 (Cauchy).

    Args:
        gaussians: N splats, mm.
        masses: (N,) g.
        surface: (P, 3) points of the surface, mm, that the grid ends at.
        resolution: boxes along the longest side.
        stiffness_kpa: Young's modulus of what is as dense as half of the mass is at least.

    Raises:
        SettingError: a setting out of range, or there is no body.
    """
    return run_through(cage_in_steps(gaussians, masses, surface, resolution, stiffness_kpa))


def cage_in_steps(
    gaussians: GaussianSet,
    masses: np.ndarray,
    surface: np.ndarray,
    resolution: int,
    stiffness_kpa: float,
) -> Generator[float, None, Cage]:
    """As `build_cage`, with breaks that tell the share that is done."""
    if not FEWEST <= resolution <= MOST:
        raise SettingError(
            "A cage of {count} boxes along a side cannot be; choose {fewest} to {most}.",
            count=resolution,
            fewest=FEWEST,
            most=MOST,
        )
    if not (np.isfinite(stiffness_kpa) and stiffness_kpa > 0):
        raise SettingError(
            "A stiffness of {stiffness:g} kPa holds nothing together; choose one above 0.", stiffness=stiffness_kpa
        )
    low, sides, shape = _grid(surface, resolution)
    count = int(shape.prod())
    weights = np.zeros(count)
    # Splats are laid out twice: where any are, and onto which corners.
    step = 0.5 * _AT_ONCE / max(len(masses), 1)
    for number, (points, shares) in enumerate(_spread(gaussians, masses)):
        weights += np.bincount(_on_grid(points, low, sides, shape)[0], shares, minlength=count)
        yield number * step
    chosen = chosen_cells(weights.reshape(shape))
    index = nearest_chosen(chosen)
    corners, cells = _corners(chosen)
    vertex_masses = np.zeros(len(corners))
    for batch, (points, shares) in enumerate(_spread(gaussians, masses)):
        cell, place = _on_grid(points, low, sides, shape)
        kept = np.flatnonzero(index.ravel()[cell] >= 0)
        number = index.ravel()[cell[kept]]
        vertex_masses += _to_corners(cells[number], place[kept], shares[kept], len(corners))
        yield 0.5 + batch * step
    vertex_masses *= masses.sum() / vertex_masses.sum()
    return Cage(
        vertices=low + sides * corners,
        cells=cells,
        springs=_springs(cells, len(corners)),
        masses=_with_least(vertex_masses),
        stiffness=_stiffness(vertex_masses, cells, sides, stiffness_kpa),
        low=low,
        sides=sides,
        index=index,
    )


def _grid(surface: np.ndarray, resolution: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lowest corner (3,), sides of a cell (3,) and cells along each axis (3,) of a grid that fits points (P, 3)."""
    extent = np.ptp(surface, axis=0)
    if not (np.isfinite(extent).all() and extent.min() > _FLAT * extent.max()):
        raise SettingError("the model is flat, so it has no body; choose one with some thickness.")
    shape = np.maximum(np.rint(resolution * extent / extent.max()), 1).astype(np.int64)
    return surface.min(axis=0), extent / shape, shape


def _spread(gaussians: GaussianSet, masses: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Points (27·M, 3) and the g that each stands for, of splats with mass, some thousand splats at a time."""
    heavy = np.flatnonzero((masses > 0) & np.isfinite(gaussians.means).all(axis=1))
    # Gauss-Hermite: exact up to the fifth moment.
    nodes = np.array(list(product((-np.sqrt(3.0), 0.0, np.sqrt(3.0)), repeat=3)))
    shares = np.prod(np.where(nodes == 0.0, 2 / 3, 1 / 6), axis=1)
    for start in range(0, len(heavy), _AT_ONCE):
        some = heavy[start : start + _AT_ONCE]
        turns = quats_to_matrices(normalize_quats(gaussians.quats[some].astype(np.float64)))
        axes = turns * gaussians.scales[some].astype(np.float64)[:, None, :]
        points = gaussians.means[some].astype(np.float64)[:, None] + np.einsum("nij,kj->nki", axes, nodes)
        yield points.reshape(-1, 3), (masses[some][:, None] * shares).ravel()


def _on_grid(
    points: np.ndarray, low: np.ndarray, sides: np.ndarray, shape: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Flat numbers (N,) of the cells that points are in, or at the grid's edge nearest to, and (N, 3) where in them."""
    scaled = np.clip((points - low) / sides, 0.0, shape)
    cell = np.minimum(np.floor(scaled), shape - 1)
    return np.ravel_multi_index(tuple(cell.astype(np.int64).T), tuple(shape)), scaled - cell


def _corners(chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places (V, 3) on the grid of the corners of the chosen cells, and the cells (C, 8) by their numbers."""
    shape = np.array(chosen.shape) + 1
    all_corners = np.argwhere(chosen)[:, None] + CORNERS
    flat, cells = np.unique(
        np.ravel_multi_index(tuple(np.moveaxis(all_corners, -1, 0)), tuple(shape)), return_inverse=True
    )
    return np.stack(np.unravel_index(flat, tuple(shape)), axis=1), cells.reshape(-1, 8)


def _to_corners(cells: np.ndarray, place: np.ndarray, shares: np.ndarray, count: int) -> np.ndarray:
    """(V,) what the corners of cells (P, 8) get of shares (P,) at places (P, 3) in them."""
    weights = np.prod(np.where(CORNERS[None] == 1, place[:, None], 1 - place[:, None]), axis=2)
    return np.bincount(cells.ravel(), (weights * shares[:, None]).ravel(), minlength=count)


def _springs(cells: np.ndarray, count: int) -> np.ndarray:
    """(S, 2) pairs of vertices, each once, the lower number first."""
    pairs = []
    for step, ends in _STEPS.items():
        after = np.full(count, -1)
        for a, b in ends:
            after[cells[:, a]] = cells[:, b]
        start = np.flatnonzero(after >= 0)
        length = np.abs(step).sum()
        if length < 3:
            pairs.append(np.stack([start, after[start]], axis=1))
        if length != 2:
            end = after[after[start]]
            pairs.append(np.stack([start, end], axis=1)[end >= 0])
    return np.unique(np.sort(np.concatenate(pairs), axis=1), axis=0)


def _with_least(masses: np.ndarray) -> np.ndarray:
    """The masses with none below a share of their mean, and the same sum."""
    raised = np.maximum(masses, _LIGHTEST * masses.mean())
    return raised * (masses.sum() / raised.sum())


def _stiffness(masses: np.ndarray, cells: np.ndarray, sides: np.ndarray, stiffness_kpa: float) -> np.ndarray:
    """(V,) N: the force at a strain of 1 of a spring between vertices that are as dense."""
    boxes = np.bincount(cells.ravel(), minlength=len(masses))
    density = masses / boxes
    order = np.argsort(density)
    typical = density[order[np.searchsorted(np.cumsum(masses[order]), 0.5 * masses.sum())]]
    ratio = np.clip(density / typical, _SOFTEST, _STIFFEST)
    # Of a box within many others: one spring of each direction, or half as many twice as long.
    lengths = sum(
        np.linalg.norm(sides * step) * {1: 1 + 2, 2: 1, 3: 2}[int(np.abs(step).sum())]
        for step in np.array(list(_STEPS))
    )
    return 6 * 1e3 * stiffness_kpa * _PA_MM2_TO_N * float(np.prod(sides)) / lengths * ratio
