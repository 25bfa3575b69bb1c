"""Splats that follow a cage of boxes, as the model of a soft body does: a modifier before those that cut and show them.

Each splat knows its box and its place in it. The box is bent trilinearly; the gradient F of that map at the splat's
centre gives the covariance F Σ Fᵀ. Nodes do it (`following_nodes`), so that it plays and renders without this add-on;
`as_shown` does the same with numpy, for sections and exports.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass

import bpy
import numpy as np

from ...core.deform import deformed
from ...core.gaussians import GaussianSet
from ...core.steps import run_through
from .following_nodes import CELL, CORNERS, GROUP, PLACE, follow_group
from .node_tree import is_of_kind, modifier_input, set_modifier_input
from .splats import read_density

Change = Callable[[GaussianSet, np.ndarray, np.ndarray], GaussianSet]
"""Of N splats, (N, 3) centres and (N, 3, 3) gradients."""

# Splats that are looked at to know whether any are moved, and by how much at least, in parts of a box's shortest side.
_LOOKED_AT, _MOVED = 256, 1e-3
# Splats bent together, for memory's sake and between two breaks.
_AT_ONCE = 16384


def follow(
    splats: bpy.types.Object, cage: bpy.types.Object, cells: np.ndarray, places: np.ndarray, sides: np.ndarray
) -> None:
    """Lets splats move with a cage.

    Args:
        cage: a mesh with `CORNERS`, now at rest.
        cells: (N,) the lowest corner of each splat's box as a vertex of the cage, -1 for splats that stay.
        places: (N, 3) in the box.
        sides: (3,) of a box, along the axes of the splats' frame.
    """
    for name, kind, field, values in (
        (CELL, "INT", "value", np.asarray(cells, np.int32) + 1),
        (PLACE, "FLOAT_VECTOR", "vector", np.asarray(places, np.float32)),
    ):
        layer = splats.data.attributes.get(name) or splats.data.attributes.new(name, kind, "POINT")
        layer.data.foreach_set(field, np.ascontiguousarray(values).ravel())
    splats.data.update_tag()
    modifier = following_modifier(splats) or splats.modifiers.new(GROUP, "NODES")
    modifier.node_group = follow_group()
    modifier.show_expanded = False
    set_modifier_input(modifier, "Cage", cage)
    set_modifier_input(modifier, "Sides", tuple(float(side) for side in sides))
    splats.modifiers.move(splats.modifiers.find(modifier.name), 0)


def stay(splats: bpy.types.Object) -> None:
    """Lets splats be as they were before `follow`."""
    modifier = following_modifier(splats)
    if modifier is not None:
        splats.modifiers.remove(modifier)
    for name in (CELL, PLACE):
        if name in splats.data.attributes:
            splats.data.attributes.remove(splats.data.attributes[name])
    splats.data.update_tag()


def following_modifier(splats: bpy.types.Object) -> bpy.types.NodesModifier | None:
    """The modifier by which splats follow a cage, if they do."""
    for modifier in splats.modifiers:
        if is_of_kind(modifier, GROUP):
            return modifier
    return None


def cage_of(splats: bpy.types.Object) -> bpy.types.Object | None:
    """The cage that splats follow."""
    modifier = following_modifier(splats)
    return None if modifier is None else modifier_input(modifier, "Cage")


@dataclass(frozen=True, eq=False)
class Bending:
    """How a cage bends N splats: all of it read at once, so that no later change of the scene mixes with it.

    Attributes:
        vertices: (V, 3) of the cage in the splats' frame, float64.
        corners: (V, 8) those of each box, by its lowest corner.
        cells: (N,) the lowest corner of each splat's box, counted from 1; 0 for splats that stay.
        places: (N, 3) in the box.
        sides: (3,) of a box at rest.
    """

    vertices: np.ndarray
    corners: np.ndarray
    cells: np.ndarray
    places: np.ndarray
    sides: np.ndarray

    def at(self, means: np.ndarray, some: slice = slice(None)) -> tuple[np.ndarray, np.ndarray]:
        """Where some of the splats are taken, and the gradients there.

        Args:
            means: (M, 3) where those are that stay.

        Returns:
            (M, 3) centres and (M, 3, 3) gradients, float64.
        """
        cells, inside = self.cells[some], self.places[some].astype(np.float64)
        centers, gradients = means.astype(np.float64), np.tile(np.eye(3), (len(means), 1, 1))
        rows = np.flatnonzero((cells > 0) & (cells <= len(self.vertices)))
        boxes = self.vertices[self.corners[cells[rows] - 1]]
        centers[rows], gradients[rows] = bent(boxes, inside[rows], self.sides)
        return centers, gradients

    def in_steps(self, gaussians: GaussianSet, change: Change = deformed) -> Generator[float, None, GaussianSet]:
        """The N splats bent, with breaks that tell the share that is done, 0 to 1.

        Args:
            gaussians: numpy set as it is at rest.
            change: makes of splats, their centres and gradients what is wanted.
        """
        parts = []
        for first in range(0, max(len(gaussians), 1), _AT_ONCE):
            yield first / max(len(gaussians), 1)
            some = slice(first, first + _AT_ONCE)
            part = gaussians.select(some)
            parts.append(change(part, *self.at(part.means, some)))
        return GaussianSet.concatenate(parts)


def bending_of(
    splats: bpy.types.Object,
    points: bpy.types.PointCloud | None = None,
    depsgraph: bpy.types.Depsgraph | None = None,
) -> Bending | None:
    """How the cage that splats follow bends them now; None if they follow none.

    Args:
        points: N of the splats, with what `follow` noted on them; all if None.
        depsgraph: whose state of the cage counts; else what the viewport shows.
    """
    cage = cage_of(splats)
    if cage is None:
        return None
    points = splats.data if points is None else points
    cells, places = np.empty(len(points.points), np.int32), np.empty(3 * len(points.points), np.float32)
    points.attributes[CELL].data.foreach_get("value", cells)
    points.attributes[PLACE].data.foreach_get("vector", places)
    return _bending(splats, cage, cells, places.reshape(-1, 3), depsgraph)


def taken_away(splats: bpy.types.Object, depsgraph: bpy.types.Depsgraph | None = None) -> np.ndarray:
    """How far the cage that splats follow has taken a few of them from where they are at rest.

    For panels, which ask each time that they are drawn.

    Args:
        depsgraph: as `bending_of`.

    Returns:
        (K, 3) mm in the splats' own frame, of the same splats each time as long as none were deleted; 0 of all where
        they follow no cage, or are at rest to what counts. Not a number where one is taken to no place.
    """
    count, cage = len(splats.data.points), cage_of(splats)
    some = np.unique(np.linspace(0, count - 1, min(count, _LOOKED_AT)).astype(int)).tolist()
    if cage is None:
        return np.zeros((len(some), 3))
    position, cell, place = (splats.data.attributes[name].data for name in ("position", CELL, PLACE))
    means, places = (np.array([each[i].vector for i in some], np.float64).reshape(-1, 3) for each in (position, place))
    bending = _bending(splats, cage, np.array([cell[i].value for i in some], np.int32), places, depsgraph)
    # Of a splat without a place nothing is known.
    away = np.where(np.isfinite(means), bending.at(means)[0] - means, 0.0)
    at_rest = np.linalg.norm(away, axis=1) <= _MOVED * bending.sides.min()
    return np.where(at_rest[:, None], 0.0, away)


def bends_alike(splats: bpy.types.Object, before: Sequence[float], most: float) -> bool:
    """Whether a soft body bends as when `taken_away` of it was this, flat, to `most` mm."""
    now = taken_away(splats).ravel()
    return len(before) == len(now) and np.allclose(before, now, rtol=0.0, atol=most, equal_nan=True)


def is_bent(splats: bpy.types.Object, depsgraph: bpy.types.Depsgraph | None = None) -> bool:
    """Whether the cage that splats follow has taken them elsewhere than where they are at rest.

    Args:
        depsgraph: as `bending_of`.
    """
    return bool(taken_away(splats, depsgraph).any())


def as_shown(
    splats: bpy.types.Object, gaussians: GaussianSet, depsgraph: bpy.types.Depsgraph | None = None
) -> GaussianSet:
    """The splats as the cage that they follow has bent them, still in their own frame; as they are if they follow none.

    Args:
        gaussians: numpy set of the object's points as they are at rest.
        depsgraph: as `bending_of`.
    """
    bending = bending_of(splats, depsgraph=depsgraph)
    return gaussians if bending is None else run_through(bending.in_steps(gaussians))


def shown_density_in_steps(
    splats: bpy.types.Object, depsgraph: bpy.types.Depsgraph | None = None
) -> Generator[float, None, GaussianSet]:
    """`read_density` of the splats `as_shown`, with breaks that tell the share that is done, all after it was read."""
    bending, gaussians = bending_of(splats, depsgraph=depsgraph), read_density(splats)
    return gaussians if bending is None else (yield from bending.in_steps(gaussians))


def bent(boxes: np.ndarray, places: np.ndarray, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where points of boxes are and how the boxes are bent there.

    Within a box the map is trilinear; beyond its faces it goes on as it is on them.

    Args:
        boxes: (N, 8, 3) each point's box now.
        places: (N, 3) in the box at rest, 0 to 1 between its corners.
        sides: (3,) of a box at rest.

    Returns:
        (N, 3) places and (N, 3, 3) gradients.
    """
    inside = np.clip(places, 0.0, 1.0)
    take = np.array([[k >> axis & 1 for axis in range(3)] for k in range(8)])
    shares = np.where(take[None] == 1, inside[:, None], 1 - inside[:, None])
    slopes = np.stack(
        [
            np.where(take[:, axis] == 1, 1.0, -1.0) * np.prod(np.delete(shares, axis, axis=2), axis=2)
            for axis in range(3)
        ],
        axis=2,
    )
    edges = np.einsum("nki,nka->nia", boxes, slopes)
    points = np.einsum("nki,nk->ni", boxes, np.prod(shares, axis=2))
    return points + np.einsum("nia,na->ni", edges, places - inside), edges / sides


def _bending(
    splats: bpy.types.Object,
    cage: bpy.types.Object,
    cells: np.ndarray,
    places: np.ndarray,
    depsgraph: bpy.types.Depsgraph | None,
) -> Bending:
    evaluated = cage.evaluated_get(depsgraph or bpy.context.evaluated_depsgraph_get())
    sides = np.array(modifier_input(following_modifier(splats), "Sides"), np.float64)
    return Bending(*_bent_cage(evaluated, splats), cells, places, sides)


def _bent_cage(cage: bpy.types.Object, splats: bpy.types.Object) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) of an evaluated cage in the splats' frame, and (V, 8) those of each box by its lowest corner."""
    mesh, count = cage.data, len(cage.data.vertices)
    local, corners = np.empty(3 * count, np.float32), np.zeros((count, 8), np.int32)
    mesh.attributes["position"].data.foreach_get("vector", local)
    corners[:, 0] = np.arange(count)
    for k, name in enumerate(CORNERS, 1):
        number = np.empty(count, np.int32)
        mesh.attributes[name].data.foreach_get("value", number)
        corners[:, k] = number
    matrix = np.array(splats.matrix_world.inverted_safe() @ cage.matrix_world, np.float64)
    return local.reshape(-1, 3).astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3], corners
