"""Convex cells that a model is broken along: around seeds (Voronoi), or between planes. Numpy alone, no bpy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...core.errors import SettingError
from ...core.gaussians import GaussianSet

# Share of the box's side: nearer to a plane than that is on it.
_ON_PLANE = 1e-7
# How far (share of the model's size) seeds keep apart, at the least, over the cube root of their number.
_APART = 0.35
_TRIES = 30
# Seeds near an impact: this share of the model's size is where one in two lies.
_IMPACT_REACH = 0.25
_MOST_CANDIDATES = 200_000


@dataclass(frozen=True, eq=False)
class Wall:
    """A plane that a model is broken along; `normal` (3,) is unit and points out of the cell, `offset` = normal·x."""

    normal: np.ndarray
    offset: float

    def heights(self, points: np.ndarray) -> np.ndarray:
        """(P,) signed distance of points (P, 3), positive beyond the wall."""
        return points @ self.normal - self.offset


@dataclass(frozen=True, eq=False)
class Cell:
    """A convex polyhedron.

    Attributes:
        vertices: (V, 3) mm.
        loops: each face's corners, counter-clockwise from outside.
        walls: of each face the wall that it lies on, or None on the box around everything.
    """

    vertices: np.ndarray
    loops: tuple[tuple[int, ...], ...]
    walls: tuple[Wall | None, ...]

    def cut(self, wall: Wall) -> Cell | None:
        """What lies below a plane, with a face on it; itself where the plane passes by, None where nothing is below."""
        heights = wall.heights(self.vertices)
        extent = float(np.ptp(self.vertices, axis=0).max())
        heights[np.abs(heights) < _ON_PLANE * extent] = 0.0
        if (heights <= 0).all():
            return self
        if (heights >= 0).all():
            return None
        vertices, crossings = list(self.vertices), {}

        def crossing(a: int, b: int) -> int:
            key = (min(a, b), max(a, b))
            if key not in crossings:
                low, high = key
                share = heights[low] / (heights[low] - heights[high])
                crossings[key] = len(vertices)
                vertices.append(self.vertices[low] + share * (self.vertices[high] - self.vertices[low]))
            return crossings[key]

        loops: list[tuple[int, ...]] = []
        walls: list[Wall | None] = []
        rim: set[int] = set()
        for loop, own in zip(self.loops, self.walls, strict=True):
            kept: list[int] = []
            for a, b in zip(loop, loop[1:] + loop[:1], strict=True):
                if heights[a] <= 0:
                    kept.append(a)
                if heights[a] * heights[b] < 0:
                    kept.append(crossing(a, b))
            if len(kept) >= 3 and any(corner < len(heights) and heights[corner] < 0 for corner in kept):
                loops.append(tuple(kept))
                walls.append(own)
                rim.update(corner for corner in kept if corner >= len(heights) or heights[corner] == 0)
        places = np.array(vertices)
        loops.append(_around(places, sorted(rim), wall.normal))
        return _compact(places, loops, [*walls, wall])


def box_cell(box: np.ndarray) -> Cell:
    """A box (2, 3) as a cell without walls."""
    corners = np.array([[box[(i >> k) & 1][k] for k in range(3)] for i in range(8)], np.float64)
    loops = ((0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5))
    return Cell(corners, loops, (None,) * 6)


def voronoi_cells(seeds: np.ndarray, box: np.ndarray) -> list[Cell]:
    """The part of a box (2, 3) that is nearest to each seed (S, 3): cell i is that of seed i.

    Raises:
        SettingError: two seeds are the same.
    """
    cells = []
    for index, seed in enumerate(seeds):
        cell = box_cell(box)
        apart = np.linalg.norm(seeds - seed, axis=1)
        for other in np.argsort(apart, kind="stable"):
            if other == index:
                continue
            if not apart[other] > 0:
                raise SettingError("two seeds of the pieces are at the same place; give them different places.")
            # Nearer seeds have cut it so small that none farther away can reach it.
            if apart[other] > 2 * np.linalg.norm(cell.vertices - seed, axis=1).max():
                break
            normal = (seeds[other] - seed) / apart[other]
            cut = cell.cut(Wall(normal, float(normal @ (seed + seeds[other]) / 2)))
            if cut is None:
                raise SettingError("a seed of the pieces lies outside of the model's box; choose one inside.")
            cell = cut
        cells.append(cell)
    return cells


def cells_between(planes: Sequence[Wall], box: np.ndarray) -> list[Cell]:
    """The parts that planes cut a box (2, 3) into."""
    cells = [box_cell(box)]
    for plane in planes:
        other = Wall(-plane.normal, -plane.offset)
        parts = [part for cell in cells for part in (cell.cut(plane), cell.cut(other))]
        cells = [part for part in parts if part is not None]
    return cells


def choose_seeds(gaussians: GaussianSet, count: int, seed: int, impact: np.ndarray | None = None) -> np.ndarray:
    """Places (count, 3) among the material, mm: where splats hold much of it, more are.

    Args:
        gaussians: numpy; splats without density count by their opacity where none has any.
        seed: the same gives the same places.
        impact: (3,) mm; pieces are smaller around it.

    Raises:
        SettingError: fewer than two pieces, or fewer splats than pieces.
    """
    if count < 2:
        raise SettingError("{count} pieces are no break; choose two or more.", count=count)
    rng = np.random.default_rng(seed)
    weights = gaussians.density.astype(np.float64) * np.prod(gaussians.scales.astype(np.float64), axis=1)
    if not weights.sum() > 0:
        weights = gaussians.opacities.astype(np.float64)
    if impact is not None:
        distance = np.linalg.norm(gaussians.means - impact, axis=1)
        weights = weights / (1 + (distance / (_IMPACT_REACH * _size(gaussians.means))) ** 4)
    if np.count_nonzero(weights > 0) < count:
        raise SettingError("the model has too few splats for {count} pieces; choose fewer.", count=count)
    candidates = rng.choice(len(weights), min(_MOST_CANDIDATES, 4 * len(weights)), p=weights / weights.sum())
    places = gaussians.means[candidates].astype(np.float64)
    return _spread(places, count, _APART * _size(places) / np.cbrt(count), local=impact)


def nearest_seed(points: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """(P,) index of the seed nearest to each point (P, 3)."""
    nearest, least = np.zeros(len(points), np.int64), np.full(len(points), np.inf)
    for index, seed in enumerate(seeds):
        distance = ((points - seed) ** 2).sum(axis=1)
        closer = distance < least
        nearest[closer], least[closer] = index, distance[closer]
    return nearest


def nearest_cell(points: np.ndarray, cells: Sequence[Cell]) -> np.ndarray:
    """(P,) index of the cell that holds each point (P, 3), or whose walls it is least beyond."""
    nearest, least = np.zeros(len(points), np.int64), np.full(len(points), np.inf)
    for index, cell in enumerate(cells):
        beyond = np.full(len(points), -np.inf)
        for wall in cell.walls:
            if wall is not None:
                np.maximum(beyond, wall.heights(points), out=beyond)
        closer = beyond < least
        nearest[closer], least[closer] = index, beyond[closer]
    return nearest


def _spread(places: np.ndarray, count: int, apart: float, local: np.ndarray | None) -> np.ndarray:
    """The first `count` places that keep their distance, which shrinks until so many are found; nearer to `local`
    they may be closer together."""
    size = _size(places)
    near = 1.0 if local is None else np.clip(np.linalg.norm(places - local, axis=1) / (_IMPACT_REACH * size), 0.1, 1)
    for _ in range(_TRIES):
        least, chosen = apart * near * np.ones(len(places)), []
        free = np.ones(len(places), bool)
        while free.any() and len(chosen) < count:
            first = int(np.argmax(free))
            chosen.append(first)
            free &= np.linalg.norm(places - places[first], axis=1) > least
        if len(chosen) == count:
            return places[chosen]
        apart *= 0.8
    raise SettingError("the model has too few places for {count} pieces; choose fewer.", count=count)


def _size(points: np.ndarray) -> float:
    """The longest side of the box of most points; a stray one does not count."""
    return float(np.ptp(np.percentile(points, [1, 99], axis=0), axis=0).max()) or 1.0


def _around(vertices: np.ndarray, corners: list[int], normal: np.ndarray) -> tuple[int, ...]:
    """Corners of a convex face in order, counter-clockwise seen against its normal."""
    across = vertices[corners] - vertices[corners].mean(axis=0)
    first = np.cross(normal, [1.0, 0, 0] if abs(normal[0]) < 0.9 else [0, 1.0, 0])
    first /= np.linalg.norm(first)
    angle = np.arctan2(across @ np.cross(normal, first), across @ first)
    return tuple(int(corners[k]) for k in np.argsort(angle, kind="stable"))


def _compact(vertices: np.ndarray, loops: list[tuple[int, ...]], walls: list[Wall | None]) -> Cell:
    """Without vertices that no face uses."""
    used = sorted({corner for loop in loops for corner in loop})
    number = {old: new for new, old in enumerate(used)}
    return Cell(vertices[used], tuple(tuple(number[c] for c in loop) for loop in loops), tuple(walls))
