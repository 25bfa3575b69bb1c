"""Splats that follow a cage of boxes, as the model of a soft body does: a modifier before those that cut and show them.

Each splat knows its box and its place in it. The box is bent trilinearly; the gradient F of that map at the splat's
centre gives the covariance F Σ Fᵀ. Nodes do it (`following_nodes`), so that it plays and renders without this add-on;
`as_shown` does the same with numpy, for sections and exports.
"""

from __future__ import annotations

import bpy
import numpy as np

from ...core.deform import deformed
from ...core.gaussians import GaussianSet
from .following_nodes import CELL, CORNERS, GROUP, PLACE, follow_group
from .node_tree import modifier_input, set_modifier_input
from .splats import read_density

# Splats bent together, for memory's sake.
_AT_ONCE = 65536


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
        if modifier.type == "NODES" and modifier.node_group and modifier.node_group.name.startswith(GROUP):
            return modifier
    return None


def cage_of(splats: bpy.types.Object) -> bpy.types.Object | None:
    """The cage that splats follow."""
    modifier = following_modifier(splats)
    return None if modifier is None else modifier_input(modifier, "Cage")


def as_shown(
    splats: bpy.types.Object, gaussians: GaussianSet, depsgraph: bpy.types.Depsgraph | None = None
) -> GaussianSet:
    """The splats as the cage that they follow has bent them, still in their own frame; as they are if they follow none.

    Args:
        gaussians: numpy set of the object's points as they are at rest.
        depsgraph: whose state of the cage counts; else what the viewport shows.
    """
    if cage_of(splats) is None:
        return gaussians
    return deformed(gaussians, *bent_at(splats, splats.data, gaussians.means, depsgraph))


def read_shown_density(splats: bpy.types.Object, depsgraph: bpy.types.Depsgraph | None = None) -> GaussianSet:
    """`read_density` of the splats `as_shown`."""
    return as_shown(splats, read_density(splats), depsgraph)


def bent_at(
    splats: bpy.types.Object,
    points: bpy.types.PointCloud,
    means: np.ndarray,
    depsgraph: bpy.types.Depsgraph | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Where a cage takes splats that follow it, and its gradients there.

    Args:
        points: N of the splats, with what `follow` noted on them.
        means: (N, 3) where those are that stay.
        depsgraph: as `as_shown`.

    Returns:
        (N, 3) centres and (N, 3, 3) gradients, float64.
    """
    cage = cage_of(splats).evaluated_get(depsgraph or bpy.context.evaluated_depsgraph_get())
    vertices, corners = _bent_cage(cage, splats)
    cells, places = np.empty(len(means), np.int32), np.empty(3 * len(means), np.float32)
    points.attributes[CELL].data.foreach_get("value", cells)
    points.attributes[PLACE].data.foreach_get("vector", places)
    centers, gradients = means.astype(np.float64), np.tile(np.eye(3), (len(means), 1, 1))
    rows = np.flatnonzero((cells > 0) & (cells <= len(vertices)))
    sides = np.array(modifier_input(following_modifier(splats), "Sides"), np.float64)
    inside = places.reshape(-1, 3)
    for start in range(0, len(rows), _AT_ONCE):
        some = rows[start : start + _AT_ONCE]
        boxes = vertices[corners[cells[some] - 1]]
        centers[some], gradients[some] = bent(boxes, inside[some].astype(np.float64), sides)
    return centers, gradients


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
