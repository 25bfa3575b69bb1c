"""The node group that lets splats follow a cage of boxes, with their shapes and densities."""

from __future__ import annotations

from functools import reduce
from itertools import product

import bpy

from ...core.deform import MOST_STRETCH
from .node_tree import InputRow, OutputRow, Sockets, TreeBuilder, row, shared_group

GROUP, RIGHT_ANGLE = "InsideOut Follow Cage", "InsideOut Right Angle"
# On splats: 1 + the vertex that is the lowest corner of their box, 0 for those that stay where they are; and their
# place in it, 0 to 1 from there to the highest corner.
CELL, PLACE = "cage_cell", "cage_place"
# On the cage, at each box's lowest corner: the vertices that are its other corners. Corner k is the one at
# (k & 1, k >> 1 & 1, k >> 2).
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


def follow_group() -> bpy.types.NodeTree:
    """The shared node group, built on first use."""
    return shared_group(GROUP, _INPUTS, lambda b, given: [_FollowTree(b, given).build()], modifier=True)


def _right_angle_group() -> bpy.types.NodeTree:
    """Two vectors turned against each other until they are at right angles: one of Jacobi's rotations, as in
    `core.affine.principal_axes`."""
    inputs = [row("A", "Vector"), row("B", "Vector")]
    return shared_group(RIGHT_ANGLE, inputs, _build_right_angle, _COLUMNS)


def _build_right_angle(b: TreeBuilder, given: Sockets) -> list[bpy.types.NodeSocket]:
    first, second = given["A"], given["B"]
    dot, squares = b.vector("DOT_PRODUCT", first, second), [b.vector("DOT_PRODUCT", v, v) for v in (first, second)]
    size = b.math("MULTIPLY", *(b.math("SQRT", square) for square in squares))
    # Rounding is no angle: it would turn the axes of round splats at random.
    turns = b.math("GREATER_THAN", b.math("ABSOLUTE", dot), b.math("MULTIPLY", size, _RIGHT_ANGLE))
    cotangent = b.math("DIVIDE", b.math("SUBTRACT", squares[1], squares[0]), b.math("MULTIPLY", dot, 2.0))
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
        names = dict(zip("ABC", columns, strict=True))
        geometry, (place, *columns) = b.captured(self.given["Geometry"], {"Place": place, **names})
        moves = self._moves(place, columns)
        before = self._numbers(self.scale)
        lengths = self._lengths(before, columns)
        squeezed = reduce(self._times, (b.math("DIVIDE", *pair) for pair in zip(before, lengths, strict=True)))
        density = b.math("MULTIPLY", b.attribute("density", "FLOAT"), squeezed)
        radius = b.math("DIVIDE", reduce(self._plus, lengths), 3.0)
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

    def _moves(self, place: bpy.types.NodeSocket, columns: list[bpy.types.NodeSocket]) -> bpy.types.NodeSocket:
        """Whether a splat follows: it has a box, the cage is there, and all numbers are finite."""
        b = self.b
        there = b.add("GeometryNodeAttributeDomainSize", {"Geometry": self.cage}, component="MESH").outputs[
            "Point Count"
        ]
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
        least, most = (b.math(kind, b.math(kind, before[0], before[1]), before[2]) for kind in ("MINIMUM", "MAXIMUM"))
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

    def _times(self, a: bpy.types.NodeSocket, b: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        return self.b.math("MULTIPLY", a, b)

    def _plus(self, a: bpy.types.NodeSocket, b: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        return self.b.math("ADD", a, b)
