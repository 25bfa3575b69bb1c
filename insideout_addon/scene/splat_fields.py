"""Fields of splats that several node groups need, and the groups that read planes from splats' slots."""

from __future__ import annotations

import bpy

from .cut_slots import HEIGHTS, NORMALS
from .node_tree import OutputRow, Sockets, TreeBuilder, row, shared_group

_SLOT: tuple[OutputRow, ...] = (
    ("Used", "NodeSocketFloat"),
    ("Normal", "NodeSocketVector"),
    ("Height", "NodeSocketFloat"),
    ("Deviation", "NodeSocketFloat"),
    ("Axis", "NodeSocketVector"),
)


def stretched(b: TreeBuilder, direction: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """S·Rᵀn: a plane's normal n in the frame where the splat is the unit ball.

    Its length is the splat's standard deviation along n, mm.
    """
    inverse = b.add("FunctionNodeInvertRotation", {0: b.attribute("rotation", "QUATERNION")}).outputs[0]
    local = b.add("FunctionNodeRotateVector", {0: direction, 1: inverse}).outputs[0]
    return b.vector("MULTIPLY", local, b.attribute("scale", "FLOAT_VECTOR"))


def slot_name(b: TreeBuilder, first: str, slot: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """The name of a slot's attribute, given that of slot 0."""
    number = b.add("FunctionNodeValueToString", {"Value": slot, "Decimals": 0}).outputs[0]
    return b.add("FunctionNodeReplaceString", {"String": first, "Find": "0", "Replace": number}).outputs[0]


def slot_group() -> bpy.types.NodeTree:
    """What is in a slot: 1 where it is used, else 0; normal and height of the plane; deviation and axis of the splat.

    Deviation is the splat's standard deviation along the normal, axis the direction of S·Rᵀn.
    """
    return shared_group("InsideOut Slot", [row("Slot", "Int")], _build_slot, _SLOT)


def _build_slot(b: TreeBuilder, given: Sockets) -> list[bpy.types.NodeSocket]:
    normal = b.attribute(slot_name(b, NORMALS[0], given["Slot"]), "FLOAT_VECTOR")
    height = b.attribute(slot_name(b, HEIGHTS[0], given["Slot"]), "FLOAT")
    used = b.math("GREATER_THAN", b.vector("LENGTH", normal), 0.5)
    stretch = stretched(b, normal)
    return [used, normal, height, b.vector("LENGTH", stretch), b.vector("NORMALIZE", stretch)]
