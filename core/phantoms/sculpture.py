"""Shapes put together from many small pieces: each is asked only about points that its bounding ball concerns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from .model import SignedDistance
from .shapes import smooth_union
from .solids import mirrored, polygon

Vector = Sequence[float] | np.ndarray
_FAR_MM = np.float32(1e3)
_MIRROR = np.array([-1, 1, 1], np.float32)


@dataclass(frozen=True, eq=False)
class Piece:
    """A solid inside a ball.

    Attributes:
        distance: its signed distance.
        center: (3,) of a ball that holds it, mm.
        reach: that ball's radius, mm.
        paired: there are two, mirrored at x = 0; the pieces' own coordinates are those of the one at positive x.
    """

    distance: SignedDistance
    center: np.ndarray
    reach: float
    paired: bool = False

    def of(self, points: np.ndarray) -> np.ndarray:
        """(N,) signed distances at points (N, 3), of both where it is paired."""
        return self.distance(mirrored(points) if self.paired else points)


@dataclass(frozen=True, eq=False)
class Step:
    """A piece added to what is there, or carved out of it, the edge rounded over about `blend` mm."""

    piece: Piece
    blend: float
    carved: bool


def add(piece: Piece, blend: float = 0.0) -> Step:
    """Joins a piece to what is there."""
    return Step(piece, blend, carved=False)


def carve(piece: Piece, blend: float = 0.0) -> Step:
    """Takes a piece away from what is there."""
    return Step(piece, blend, carved=True)


def sculpt(points: np.ndarray, steps: tuple[Step, ...], start: np.ndarray | None = None) -> np.ndarray:
    """(N,) signed distances of the steps, one after another, upon `start` (N,), or upon nothing.

    Where the steps' bounding balls leave no room for a difference nothing is evaluated, which changes no value.
    """
    if start is None:
        return _shaped(points, steps, np.full(len(points), _FAR_MM, np.float32))
    total = start.astype(np.float32)
    center, reach, blend = _extent(steps)
    near = np.flatnonzero(_lengths(points - center) - reach < np.abs(total) + blend)
    if len(near):
        total[near] = _shaped(points[near], steps, total[near])
    return total


@lru_cache(maxsize=64)
def _extent(steps: tuple[Step, ...]) -> tuple[np.ndarray, float, float]:
    """Center and radius in mm of a ball about all the steps' balls, and the widest blend."""
    balls = [(step.piece.center, step.piece.reach) for step in steps]
    balls += [(step.piece.center * _MIRROR, step.piece.reach) for step in steps if step.piece.paired]
    centers = np.array([center for center, _ in balls])
    middle = 0.5 * (centers.min(axis=0) + centers.max(axis=0))
    reach = max(float(np.linalg.norm(center - middle)) + radius for center, radius in balls)
    return middle, reach, max(step.blend for step in steps)


def _shaped(points: np.ndarray, steps: tuple[Step, ...], total: np.ndarray) -> np.ndarray:
    both_sides = mirrored(points)
    squares = np.einsum("nk,nk->n", points, points)
    for step in steps:
        piece = step.piece
        own = both_sides if piece.paired else points
        room = (step.blend - total if step.carved else total + step.blend) + np.float32(piece.reach)
        from_center = squares - own @ (2 * piece.center) + piece.center @ piece.center
        near = np.flatnonzero((room > 0) & (from_center < room * room))
        if len(near):
            found = piece.distance(own[near]).astype(np.float32)
            total[near] = _join(total[near], found, step)
    return total


def group(steps: tuple[Step, ...]) -> Piece:
    """What the steps make, as one piece."""
    center, reach, _ = _extent(steps)
    return Piece(lambda points: sculpt(points, steps), center, reach)


def smooth_cut(first: np.ndarray, second: np.ndarray, blend_mm: float) -> np.ndarray:
    """What is in both solids, the outer edge rounded over about `blend_mm`."""
    return -smooth_union(-first, -second, blend_mm)


def _join(total: np.ndarray, found: np.ndarray, step: Step) -> np.ndarray:
    if step.carved:
        return smooth_cut(total, -found, step.blend) if step.blend else np.maximum(total, -found)
    return smooth_union(total, found, step.blend) if step.blend else np.minimum(total, found)


def _lengths(vectors: np.ndarray) -> np.ndarray:
    return np.sqrt(np.einsum("nk,nk->n", vectors, vectors))


def _piece(distance: SignedDistance, center: Vector, reach: float) -> Piece:
    return Piece(distance, np.asarray(center, np.float32), float(reach))


def paired(piece: Piece) -> Piece:
    """The piece and its mirror image."""
    return replace(piece, paired=True)


def posed(piece: Piece, turn: Vector, pivot: Vector) -> Piece:
    """The piece, or the pair, turned about `pivot` by degrees as in `turned`."""
    axes, middle = turned(turn), np.asarray(pivot, np.float32)
    offset = piece.center - middle
    reach = piece.reach
    if piece.paired:
        # A pair no longer mirrors at x = 0: one ball about both.
        reach += abs(float(piece.center[0]))
        offset = np.array([0, piece.center[1], piece.center[2]], np.float32) - middle
    return Piece(lambda points: piece.of((points - middle) @ axes.T + middle), middle + offset @ axes, reach)


def turned(degrees: Vector) -> np.ndarray:
    """(3, 3) axes, one a row, of a frame turned by these angles about the fixed axes x, then y, then z."""
    return Rotation.from_euler("xyz", degrees, degrees=True).as_matrix().T.astype(np.float32)


def egg(center: Vector, low: Vector, high: Vector | None = None, turn: Vector = (0, 0, 0), power: float = 2.0) -> Piece:
    """An ellipsoid whose halves may differ along each of its axes, correct to first order at its surface.

    Args:
        low: half lengths in mm towards the negative axes, `high` towards the positive ones (as `low` if left out).
        turn: degrees; see `turned`.
        power: 2 for an ellipsoid; larger is boxier.
    """
    low_semi = np.asarray(low, np.float32)
    high_semi = low_semi if high is None else np.asarray(high, np.float32)
    axes, middle = turned(turn), np.asarray(center, np.float32)

    def distance(points: np.ndarray) -> np.ndarray:
        local = (points - middle) @ axes.T
        semi = low_semi if high is None else np.where(local < 0, low_semi, high_semi)
        # First order says too little far outside.
        return np.maximum(_to_egg(np.abs(local), semi, low_semi + high_semi - semi, power), _lengths(local) - longest)

    widest = np.maximum(low_semi, high_semi)
    longest = float(np.linalg.norm(widest) if power > 2 else widest.max())
    return _piece(distance, center, longest)


def _to_egg(offset: np.ndarray, semi: np.ndarray, opposite: np.ndarray, power: float) -> np.ndarray:
    """(N,) first-order distances of points at `offset` (N, 3) from the middle, in mm and without signs.

    Args:
        semi: (3,) or (N, 3) half lengths on each point's side, `opposite` those on the other side.
    """
    share = offset / semi
    if power == 2.0:
        level = _lengths(share)
        slope = _lengths(share / semi) / np.maximum(level, 1e-6)
    else:
        level = np.einsum("nk->n", share**power) ** np.float32(1 / power)
        slope = _lengths((share / np.maximum(level, 1e-6)[:, None]) ** np.float32(power - 1) / semi)
    found = (level - 1) / np.maximum(slope, 1e-6)
    inside = np.flatnonzero(level < 1)
    if len(inside):
        # First order says too much deep inside: no point is deeper than the way out along an axis is long.
        powers = share[inside] ** power
        half = np.maximum(1 - powers.sum(1, keepdims=True) + powers, 0) ** np.float32(1 / power)
        near_side, far_side = (np.broadcast_to(one, offset.shape)[inside] * half for one in (semi, opposite))
        way_out = np.minimum(near_side - offset[inside], far_side + offset[inside])
        found[inside] = np.maximum(found[inside], -way_out.min(1))
    return found


def limb(path: Sequence[Vector], radii: float | Vector) -> Piece:
    """Round rods along a polyline (K, 3), thick by `radii` mm at its points and tapering between."""
    line = np.asarray(path, np.float32)
    thick = np.broadcast_to(np.asarray(radii, np.float32), (len(line),))

    def distance(points: np.ndarray) -> np.ndarray:
        nearest = np.full(len(points), np.inf, np.float32)
        for (start, first), (end, second) in pairwise(zip(line, thick, strict=True)):
            along = end - start
            offset = points - start
            share = np.clip(offset @ along / (along @ along), 0, 1)
            gap = _lengths(offset - share[:, None] * along)
            nearest = np.minimum(nearest, gap - (first + share * (second - first)))
        return nearest

    return _around(distance, line, float(thick.max()))


def box(center: Vector, half: Vector, turn: Vector = (0, 0, 0), rounding: float = 0.0) -> Piece:
    """Exact distance to a box of half lengths `half` mm whose edges are rounded by `rounding` mm."""
    axes, middle = turned(turn), np.asarray(center, np.float32)
    core = np.asarray(half, np.float32) - np.float32(rounding)

    def distance(points: np.ndarray) -> np.ndarray:
        out = np.abs((points - middle) @ axes.T) - core
        deepest = np.maximum(np.maximum(out[:, 0], out[:, 1]), out[:, 2])
        return _lengths(np.maximum(out, 0)) + np.minimum(deepest, 0) - np.float32(rounding)

    return _piece(distance, center, float(np.linalg.norm(half)))


def rail(path: Sequence[Vector], half_height: float, half_width: float, rounding: float) -> Piece:
    """An upright band along a polyline: constant in width and height, its middle at the polyline (K, 3)'s height."""
    line = np.asarray(path, np.float32)

    def distance(points: np.ndarray) -> np.ndarray:
        nearest = np.full(len(points), np.inf, np.float32)
        height = np.zeros(len(points), np.float32)
        for start, end in pairwise(line):
            along = end - start
            offset = points - start
            share = np.clip(offset[:, :2] @ along[:2] / (along[:2] @ along[:2]), 0, 1)
            gap = _lengths(offset[:, :2] - share[:, None] * along[:2])
            height = np.where(gap < nearest, offset[:, 2] - share * along[2], height)
            nearest = np.minimum(nearest, gap)
        return _edge(nearest - half_width, np.abs(height) - half_height, rounding)

    return _around(distance, line, float(np.hypot(half_height, half_width)))


def plate(
    outline: Sequence[Vector], x_of: Callable[[np.ndarray], np.ndarray], half_width: float, rounding: float
) -> Piece:
    """A plate across x: an `outline` (K, 2) in y and z, `half_width` either side of x = x_of(points)."""
    corners = np.asarray(outline, np.float32)
    spots = np.concatenate([np.zeros((len(corners), 1), np.float32), corners], axis=1)
    spots[:, 0] = x_of(spots)

    def distance(points: np.ndarray) -> np.ndarray:
        across = np.abs(points[:, 0] - x_of(points)) - half_width
        return _edge(polygon(points[:, 1], points[:, 2], corners), across, rounding)

    return _around(distance, spots, half_width)


def _edge(first: np.ndarray, second: np.ndarray, rounding: float) -> np.ndarray:
    """The solid within two slabs at right angles, its edge rounded."""
    out_first, out_second = first + rounding, second + rounding
    corner = np.hypot(np.maximum(out_first, 0), np.maximum(out_second, 0))
    return corner + np.minimum(np.maximum(out_first, out_second), 0) - np.float32(rounding)


def _around(distance: SignedDistance, spots: np.ndarray, thick: float) -> Piece:
    center = 0.5 * (spots.min(axis=0) + spots.max(axis=0))
    return _piece(distance, center, float(np.linalg.norm(spots - center, axis=1).max()) + thick)
