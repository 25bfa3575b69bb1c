"""Splats that follow a cage of boxes, as the model of a soft body does: a modifier before those that cut and show them.

Each splat knows its box and its place in it. The box is bent trilinearly; the gradient F of that map at the splat's
centre gives the covariance F Σ Fᵀ. All is done by nodes, so that it plays and renders without this add-on, and
`as_shown` does the same with numpy for sections and exports.
"""

from __future__ import annotations

from itertools import product

import bpy
import numpy as np

from ...core.deform import MOST_STRETCH, deformed
from ...core.gaussians import GaussianSet
from .node_tree import (
    InputRow,
    OutputRow,
    Sockets,
    TreeBuilder,
    modifier_input,
    row,
    set_modifier_input,
    shared_group,
)

GROUP = "InsideOut Follow Cage"
# On splats: 1 + the vertex that is the lowest corner of their box, 0 for those that stay where they are; and their
# place in it, 0 to 1 from there to the highest corner.
CELL, PLACE = "cage_cell", "cage_place"
# On the cage, at each box's lowest corner: the vertices that are its others; corner k is at (k & 1, k >> 1 & 1, k >> 2).
CORNERS = tuple(f"corner_{k}" for k in range(1, 8))
_INPUTS: tuple[InputRow, ...] = (
    row("Geometry", "Geometry"),
    row("Cage", "Object", "Boxes that the splats move with"),
    row("Sides", "Vector", "Lengths of a box at rest, in the splats' frame"),
)
_COLUMNS: tuple[OutputRow, ...] = (("A", "NodeSocketVector"), ("B", "NodeSocketVector"))
# Columns are at right angles to single precision then, whatever they were.
_SWEEPS = 5
_RIGHT_ANGLE = 1e-6
_HUGE = 1e30


def follow(splats: bpy.types.Object, cage: bpy.types.Object, cells: np.ndarray, places: np.ndarray, sides: np.ndarray) -> None:
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
    modifier = following_modifier(splats) or splats.modifiers.new(GROUP, "NODES")
    modifier.node_group = _follow_group()
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
    modifier, cage = following_modifier(splats), cage_of(splats)
    if cage is None:
        return gaussians
    shown = cage.evaluated_get(depsgraph or bpy.context.evaluated_depsgraph_get())
    vertices, corners = _bent_cage(shown, splats)
    cells, places = np.empty(len(gaussians), np.int32), np.empty(3 * len(gaussians), np.float32)
    splats.data.attributes[CELL].data.foreach_get("value", cells)
    splats.data.attributes[PLACE].data.foreach_get("vector", places)
    means, gradients = gaussians.means.astype(np.float64), np.tile(np.eye(3), (len(gaussians), 1, 1))
    rows = np.flatnonzero((cells > 0) & (cells <= len(vertices)))
    sides = np.array(modifier_input(modifier, "Sides"), np.float64)
    boxes = vertices[corners[cells[rows] - 1]]
    means[rows], gradients[rows] = bent(boxes, places.reshape(-1, 3)[rows].astype(np.float64), sides)
    return deformed(gaussians, means, gradients)


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


def _follow_group() -> bpy.types.NodeTree:
    return shared_group(GROUP, _INPUTS, lambda b, given: [_FollowTree(b, given).build()], modifier=True)


def _right_angle_group() -> bpy.types.NodeTree:
    """Two vectors turned against each other until they are at right angles: one of Jacobi's rotations, as in
    `core.affine.principal_axes`."""
    inputs = [row("A", "Vector"), row("B", "Vector")]
    return shared_group("InsideOut Right Angle", inputs, _build_right_angle, _COLUMNS)


def _build_right_angle(b: TreeBuilder, given: Sockets) -> list[bpy.types.NodeSocket]:
    first, second = given["A"], given["B"]
    product_, squares = b.vector("DOT_PRODUCT", first, second), [b.vector("DOT_PRODUCT", v, v) for v in (first, second)]
    size = b.math("MULTIPLY", *(b.math("SQRT", square) for square in squares))
    # Rounding is no angle: it would turn the axes of round splats at random.
    turns = b.math("GREATER_THAN", b.math("ABSOLUTE", product_), b.math("MULTIPLY", size, _RIGHT_ANGLE))
    cotangent = b.math("DIVIDE", b.math("SUBTRACT", squares[1], squares[0]), b.math("MULTIPLY", product_, 2.0))
    sign = b.math("SUBTRACT", 1.0, b.math("MULTIPLY", b.math("LESS_THAN", cotangent, 0.0), 2.0))
    root = b.math("SQRT", b.math("MULTIPLY_ADD", cotangent, cotangent, 1.0))
    tangent = b.math("DIVIDE", b.math("MULTIPLY", sign, turns), b.math("ADD", b.math("ABSOLUTE", cotangent), root))
    cosine = b.math("INVERSE_SQRT", b.math("MULTIPLY_ADD", tangent, tangent, 1.0))
    sine = b.math("MULTIPLY", cosine, tangent)
    return [
        b.vector("SUBTRACT", b.vector("SCALE", first, cosine), b.vector("SCALE", second, sine)),
        b.vector("ADD", b.vector("SCALE", first, sine), b.vector("SCALE", second, cosine)),
    ]


class _FollowTree:
    """Adds the group's nodes."""

    def __init__(self, b: TreeBuilder, given: Sockets) -> None:
        self.b, self.given = b, given
        info = b.add("GeometryNodeObjectInfo", {"Object": given["Cage"]}, transform_space="RELATIVE")
        self.cage = info.outputs["Geometry"]
        self.cell = b.attribute(CELL, "INT")
        self.scale = b.attribute("scale", "FLOAT_VECTOR")

    def build(self) -> bpy.types.NodeSocket:
        b = self.b
        place, edges = self._bent()
        columns = self._at_right_angles(self._shape(edges))
        geometry, (place, *columns) = b.captured(self.given["Geometry"], {"Place": place, **dict(zip("ABC", columns))})
        moves = self._moves(place, columns)
        before = self._numbers(self.scale)
        lengths = self._lengths(before, columns)
        squeezed = b.math("MULTIPLY", *(b.math("DIVIDE", *pair) for pair in list(zip(before, lengths))[:2]))
        squeezed = b.math("MULTIPLY", squeezed, b.math("DIVIDE", before[2], lengths[2]))
        density = b.math("MULTIPLY", b.attribute("density", "FLOAT"), squeezed)
        radius = b.math("DIVIDE", b.math("ADD", b.math("ADD", lengths[0], lengths[1]), lengths[2]), 3.0)
        # The scale last: the others are made of it.
        geometry = b.stored(geometry, "density", "FLOAT", density, moves)
        geometry = b.stored(geometry, "radius", "FLOAT", radius, moves)
        geometry = b.stored(geometry, "rotation", "QUATERNION", self._rotation(columns), moves)
        scale = b.add("ShaderNodeCombineXYZ", dict(enumerate(lengths))).outputs[0]
        geometry = b.stored(geometry, "scale", "FLOAT_VECTOR", scale, moves)
        given = {"Geometry": geometry, "Selection": moves, "Position": place}
        return b.add("GeometryNodeSetPosition", given).outputs[0]

    def _bent(self) -> tuple[bpy.types.NodeSocket, list[bpy.types.NodeSocket]]:
        """Where a splat's centre is now, and the three edges that its box has there: see `bent`."""
        b = self.b
        at = b.attribute(PLACE, "FLOAT_VECTOR")
        inside = b.vector("MINIMUM", b.vector("MAXIMUM", at, (0.0, 0.0, 0.0)), (1.0, 1.0, 1.0))
        u, v, w = self._numbers(inside)
        corners = self._corners()

        def between(low: bpy.types.NodeSocket, high: bpy.types.NodeSocket, share: bpy.types.NodeSocket):
            return b.vector("MULTIPLY_ADD", b.vector("SUBTRACT", high, low), share, low)

        # Pairs of corners along x, then their points along y, then along z.
        along = [b.vector("SUBTRACT", corners[k + 1], corners[k]) for k in (0, 2, 4, 6)]
        lines = [b.vector("MULTIPLY_ADD", edge, u, corners[k]) for edge, k in zip(along, (0, 2, 4, 6), strict=True)]
        rises = [b.vector("SUBTRACT", lines[k + 1], lines[k]) for k in (0, 2)]
        low, high = (b.vector("MULTIPLY_ADD", rise, v, lines[k]) for rise, k in zip(rises, (0, 2), strict=True))
        up = b.vector("SUBTRACT", high, low)
        edges = [between(between(*along[:2], v), between(*along[2:], v), w), between(*rises, w), up]
        place = b.vector("MULTIPLY_ADD", up, w, low)
        for edge, beyond in zip(edges, self._numbers(b.vector("SUBTRACT", at, inside)), strict=True):
            place = b.vector("MULTIPLY_ADD", edge, beyond, place)
        return place, edges

    def _corners(self) -> list[bpy.types.NodeSocket]:
        """The corners of a splat's box now."""
        b = self.b
        lowest = b.math("SUBTRACT", self.cell, 1.0)
        numbers = [b.sampled(self.cage, b.attribute(name, "INT"), lowest, "INT") for name in CORNERS]
        position = b.add("GeometryNodeInputPosition").outputs[0]
        return [b.sampled(self.cage, position, number, "FLOAT_VECTOR") for number in (lowest, *numbers)]

    def _shape(self, edges: list[bpy.types.NodeSocket]) -> list[bpy.types.NodeSocket]:
        """The columns of F·R·S: what becomes of a splat's half axes."""
        b = self.b
        gradient = [
            b.vector("SCALE", edge, b.math("DIVIDE", 1.0, side))
            for edge, side in zip(edges, self._numbers(self.given["Sides"]), strict=True)
        ]
        rotation, columns = b.attribute("rotation", "QUATERNION"), []
        for axis in range(3):
            unit = tuple(float(axis == k) for k in range(3))
            half = b.vector("MULTIPLY", self.scale, unit)
            parts = self._numbers(b.add("FunctionNodeRotateVector", {0: half, 1: rotation}).outputs[0])
            column = b.vector("SCALE", gradient[0], parts[0])
            for edge, part in zip(gradient[1:], parts[1:], strict=True):
                column = b.vector("MULTIPLY_ADD", edge, part, column)
            columns.append(column)
        return columns

    def _at_right_angles(self, columns: list[bpy.types.NodeSocket]) -> list[bpy.types.NodeSocket]:
        group = _right_angle_group()
        for _, (first, second) in product(range(_SWEEPS), ((0, 1), (0, 2), (1, 2))):
            turned = self.b.group(group, {"A": columns[first], "B": columns[second]})
            columns[first], columns[second] = turned["A"], turned["B"]
        return columns

    def _moves(
        self, place: bpy.types.NodeSocket, columns: list[bpy.types.NodeSocket]
    ) -> bpy.types.NodeSocket:
        """Whether a splat follows: it has a box, the cage is there, and all numbers are finite."""
        b = self.b
        there = b.add("GeometryNodeAttributeDomainSize", {"Geometry": self.cage}, component="MESH").outputs["Point Count"]
        moves = b.boolean("AND", b.compare("GREATER_THAN", self.cell, 0.5), b.compare("GREATER_THAN", there, 0.5))
        for vector in (place, *columns):
            # What is no number is not less than any.
            moves = b.boolean("AND", moves, b.compare("LESS_THAN", b.vector("LENGTH", vector), _HUGE))
        return moves

    def _lengths(
        self, before: list[bpy.types.NodeSocket], columns: list[bpy.types.NodeSocket]
    ) -> list[bpy.types.NodeSocket]:
        """Half axes, within the bounds of `core.deform`."""
        b = self.b
        least, most = (
            b.math(kind, b.math(kind, before[0], before[1]), before[2]) for kind in ("MINIMUM", "MAXIMUM")
        )
        least, most = b.math("DIVIDE", least, MOST_STRETCH), b.math("MULTIPLY", most, MOST_STRETCH)
        return [b.math("MINIMUM", b.math("MAXIMUM", b.vector("LENGTH", c), least), most) for c in columns]

    def _rotation(self, columns: list[bpy.types.NodeSocket]) -> bpy.types.NodeSocket:
        """Along the first two columns; where one of them is nothing, across the others."""
        b = self.b
        first, second, third = columns
        axes = []
        for axis, others in ((first, (second, third)), (second, (third, first))):
            nothing = b.compare("EQUAL", b.vector("LENGTH", axis), 0.0)
            given = {"Switch": nothing, "False": axis, "True": b.vector("CROSS_PRODUCT", *others)}
            axes.append(b.add("GeometryNodeSwitch", given, input_type="VECTOR").outputs[0])
        units = {k: b.vector("NORMALIZE", axis) for k, axis in enumerate(axes)}
        return b.add("FunctionNodeAxesToRotation", units, primary_axis="X", secondary_axis="Y").outputs[0]

    def _numbers(self, vector: bpy.types.NodeSocket) -> list[bpy.types.NodeSocket]:
        return list(self.b.add("ShaderNodeSeparateXYZ", {0: vector}).outputs)
