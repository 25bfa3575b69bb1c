"""The node group that closes the ellipsoids that several planes cut, at the edges and corners of what is left."""

from __future__ import annotations

import bpy

from .cut_slots import SLOTS
from .node_tree import InputRow, OutputRow, Sockets, TreeBuilder, row, shared_group
from .splat_fields import slot_group
from .splats import REACH, SURROUNDINGS

_INPUTS: tuple[InputRow, ...] = (
    row("Geometry", "Geometry"),
    row("Size", "Float", "Half axes in standard deviations"),
    row("Detail", "Int", "Fineness of the ellipsoids"),
    row("Material", "Material", "Of the cut ellipsoids"),
)
_CENTER, _CORE = "insideout_center", "insideout_core"
# How deep inside each plane the middle of what is left is sought, in parts of the ellipsoid's half axes.
_DEPTH, _ROUNDS = 0.05, 3
# Height of a plane that is not there: far outside the ball.
_NOWHERE = 10.0
_BALL_PLANE: tuple[OutputRow, ...] = (("Axis", "NodeSocketVector"), ("Height", "NodeSocketFloat"))


def clipped_group() -> bpy.types.NodeTree:
    """The shared node group, built on first use: points with several planes in their slots to closed convex meshes."""
    return shared_group("InsideOut Clipped Splats", _INPUTS, lambda b, given: [_ClippedTree(b, given).build()])


def _ball_plane_group() -> bpy.types.NodeTree:
    """Axis and height of a slot's plane in the frame where the ellipsoid is the unit ball."""
    return shared_group(
        "InsideOut Plane in Ball", [row("Slot", "Int"), row("Size", "Float")], _build_ball_plane, _BALL_PLANE
    )


def _build_ball_plane(b: TreeBuilder, given: Sockets) -> list[bpy.types.NodeSocket]:
    plane = b.group(slot_group(), {"Slot": given["Slot"]})
    reach = b.math("MULTIPLY", b.math("MAXIMUM", plane["Deviation"], 1e-9), given["Size"])
    up = b.math("MULTIPLY", b.math("DIVIDE", plane["Height"], reach), plane["Used"])
    away = b.math("MULTIPLY", b.math("SUBTRACT", 1.0, plane["Used"]), _NOWHERE)
    return [plane["Axis"], b.math("ADD", up, away)]


def _push_group() -> bpy.types.NodeTree:
    """A point pushed back behind a plane where it is beyond it, or nearly."""
    inputs = [row("Point", "Vector"), row("Axis", "Vector"), row("Height", "Float")]
    return shared_group("InsideOut Push Back", inputs, _build_push, [("Point", "NodeSocketVector")])


def _build_push(b: TreeBuilder, given: Sockets) -> list[bpy.types.NodeSocket]:
    beyond = b.math("SUBTRACT", b.vector("DOT_PRODUCT", given["Axis"], given["Point"]), given["Height"])
    excess = b.math("MAXIMUM", b.math("ADD", beyond, _DEPTH), 0.0)
    return [b.vector("SUBTRACT", given["Point"], b.vector("SCALE", given["Axis"], excess))]


def _nearer_group() -> bpy.types.NodeTree:
    """How far it is from the core along a direction, to a plane or to what was met before."""
    inputs = [
        *(row(name, "Vector") for name in ("Core", "Direction", "Axis")),
        *(row(name, "Float") for name in ("Height", "Distance")),
    ]
    return shared_group("InsideOut Nearer Plane", inputs, _build_nearer, [("Distance", "NodeSocketFloat")])


def _build_nearer(b: TreeBuilder, given: Sockets) -> list[bpy.types.NodeSocket]:
    above = b.vector("DOT_PRODUCT", given["Axis"], given["Core"])
    gap = b.math("MAXIMUM", b.math("SUBTRACT", given["Height"], above), 0.0)
    # A direction away from the plane meets it nowhere: a tiny slope puts it far off.
    slope = b.math("MAXIMUM", b.vector("DOT_PRODUCT", given["Axis"], given["Direction"]), 1e-6)
    return [b.math("MINIMUM", given["Distance"], b.math("DIVIDE", gap, slope))]


def core_group() -> bpy.types.NodeTree:
    """A point inside what is left of a ball: its own middle, pushed back behind each plane in turn, a few times."""
    return shared_group("InsideOut Core", [row("Size", "Float")], _build_core, [("Core", "NodeSocketVector")])


def _build_core(b: TreeBuilder, given: Sockets) -> list[bpy.types.NodeSocket]:
    planes, group = _ball_planes(b, given), _push_group()
    middle = b.add("ShaderNodeCombineXYZ").outputs[0]
    for plane in planes * _ROUNDS:
        middle = b.group(group, {"Point": middle, "Axis": plane["Axis"], "Height": plane["Height"]})[0]
    return [middle]


def way_group() -> bpy.types.NodeTree:
    """How far it is from the core along a unit direction to the ball or the first plane."""
    inputs = [row("Core", "Vector"), row("Direction", "Vector"), row("Size", "Float")]
    return shared_group("InsideOut Way Out", inputs, _build_way, [("Distance", "NodeSocketFloat")])


def _build_way(b: TreeBuilder, given: Sockets) -> list[bpy.types.NodeSocket]:
    core, direction, group = given["Core"], given["Direction"], _nearer_group()
    along = b.vector("DOT_PRODUCT", core, direction)
    room = b.math("SUBTRACT", 1.0, b.vector("DOT_PRODUCT", core, core))
    root = b.math("SQRT", b.math("MAXIMUM", b.math("ADD", b.math("MULTIPLY", along, along), room), 0.0))
    distance = b.math("SUBTRACT", root, along)
    for plane in _ball_planes(b, given):
        met = {"Core": core, "Direction": direction, "Axis": plane["Axis"], "Height": plane["Height"]}
        distance = b.group(group, {**met, "Distance": distance})[0]
    return [distance]


def _ball_planes(b: TreeBuilder, given: Sockets) -> list[Sockets]:
    group = _ball_plane_group()
    return [b.group(group, {"Slot": slot, "Size": given["Size"]}) for slot in range(SLOTS)]


class _ClippedTree:
    """Adds the group's nodes.

    In the frame where an ellipsoid is the unit ball, what the planes leave of it is convex. From a point inside of it
    each vertex of a globe is moved along its own direction to the ball or to the nearest plane, whichever comes first.
    Edges between two planes are as fine as the globe; the faces are exactly flat.
    """

    def __init__(self, b: TreeBuilder, given: Sockets) -> None:
        self.b, self.given = b, given

    def build(self) -> bpy.types.NodeSocket:
        b = self.b
        position = b.add("GeometryNodeInputPosition").outputs[0]
        marked = b.stored(self.given["Geometry"], _CENTER, "FLOAT_VECTOR", position)
        cored = b.stored(marked, _CORE, "FLOAT_VECTOR", b.group(core_group(), {"Size": self.given["Size"]})[0])
        core = b.attribute(_CORE, "FLOAT_VECTOR")
        left = b.deleted(cored, b.compare("GREATER_THAN", b.vector("LENGTH", core), 1.0 - _DEPTH))
        fineness = b.math("ADD", self.given["Detail"], 1.0)
        globe = b.add("GeometryNodeMeshIcoSphere", {"Radius": 1.0, "Subdivisions": fineness}).outputs[0]
        shown = b.add("GeometryNodeSetMaterial", {"Geometry": globe, "Material": self.given["Material"]}).outputs[0]
        # Each vertex gets a copy of what its splat has.
        bare = b.without(left, "radiance:*", "radius", SURROUNDINGS, REACH)
        globes = b.add("GeometryNodeInstanceOnPoints", {"Points": bare, "Instance": shown}).outputs[0]
        real = b.add("GeometryNodeRealizeInstances", {"Geometry": globes}).outputs[0]
        center = b.attribute(_CENTER, "FLOAT_VECTOR")
        direction = b.vector("SUBTRACT", position, center)
        given = {"Core": core, "Direction": direction, "Size": self.given["Size"]}
        there = b.vector("ADD", core, b.vector("SCALE", direction, b.group(way_group(), given)[0]))
        axes = b.vector("SCALE", b.attribute("scale", "FLOAT_VECTOR"), self.given["Size"])
        ellipsoid = b.vector("MULTIPLY", there, axes)
        turned = b.add("FunctionNodeRotateVector", {0: ellipsoid, 1: b.attribute("rotation", "QUATERNION")}).outputs[0]
        place = b.vector("ADD", center, turned)
        moved = b.add("GeometryNodeSetPosition", {"Geometry": real, "Position": place}).outputs[0]
        flat = b.add("GeometryNodeSetShadeSmooth", {0: moved, 2: False}, domain="FACE").outputs[0]
        return b.without(flat, _CENTER, _CORE, "cut_*")
