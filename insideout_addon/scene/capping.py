"""The node group that closes the ellipsoids that a plane cuts: geometry, so every renderer shows the same cut."""

from __future__ import annotations

import math

import bpy

from .node_tree import TreeBuilder

GROUP = "InsideOut Cut Splats"
# Name and socket type. The plane and all fields are in the frame of the splats; the normal points to the hidden side.
CAPPED_INPUTS = (
    ("Geometry", "NodeSocketGeometry"),
    ("Size", "NodeSocketFloat"),
    ("Detail", "NodeSocketInt"),
    ("Plane Point", "NodeSocketVector"),
    ("Plane Normal", "NodeSocketVector"),
    ("Axis", "NodeSocketVector"),
    ("Reach", "NodeSocketFloat"),
    ("Scale", "NodeSocketVector"),
    ("Rotation", "NodeSocketRotation"),
    ("Material", "NodeSocketMaterial"),
)
_CENTER = "insideout_center"


def capped_group() -> bpy.types.NodeTree:
    """The shared node group, built on first use: points that a plane cuts to meshes closed by a flat cap on it.

    Apart from the display's group because Blender looks at all of a tree for each new node.
    """
    wanted = {name for name, _ in CAPPED_INPUTS}
    for group in bpy.data.node_groups:
        if group.name.startswith(GROUP) and wanted <= set(group.interface.items_tree.keys()):
            return group
    group = bpy.data.node_groups.new(GROUP, "GeometryNodeTree")
    for name, kind in CAPPED_INPUTS:
        group.interface.new_socket(name, in_out="INPUT", socket_type=kind)
    group.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    _CappedTree(group).build()
    return group


class _CappedTree:
    """Builds the group's nodes.

    In the frame where an ellipsoid is the unit ball, the plane is at height h over its middle along the axis m. A
    globe with its pole on m has its northernmost circle of latitude moved to the cut, the others spread evenly from
    there to the south pole, and the north pole moved to the middle of the cut.
    """

    def __init__(self, group: bpy.types.NodeTree) -> None:
        self.b = TreeBuilder(group, in_place=False)
        self.given = self.b.add("NodeGroupInput").outputs

    def build(self) -> None:
        b = self.b
        position = b.add("GeometryNodeInputPosition").outputs[0]
        marked = b.add(
            "GeometryNodeStoreNamedAttribute",
            {"Geometry": self.given["Geometry"], "Name": _CENTER, "Value": position},
            data_type="FLOAT_VECTOR",
            domain="POINT",
        ).outputs[0]
        real = b.add("GeometryNodeRealizeInstances", {"Geometry": self._globes(marked)}).outputs[0]
        center = b.attribute(_CENTER, "FLOAT_VECTOR")
        direction = self._cut_direction(b.vector("SUBTRACT", position, center), center)
        ellipsoid = b.vector("SCALE", b.vector("MULTIPLY", direction, self.given["Scale"]), self.given["Size"])
        turned = b.add("FunctionNodeRotateVector", {0: ellipsoid, 1: self.given["Rotation"]}).outputs[0]
        moved = b.add(
            "GeometryNodeSetPosition", {"Geometry": real, "Position": b.vector("ADD", center, turned)}
        ).outputs[0]
        smooth = b.add("GeometryNodeSetShadeSmooth", {0: moved}).outputs[0]
        flat = b.compare("GREATER_THAN", self._face_alignment(), 0.9999)
        shaded = b.add("GeometryNodeSetShadeSmooth", {0: smooth, 1: flat, 2: False}, domain="FACE").outputs[0]
        clean = b.add("GeometryNodeRemoveAttribute", {"Geometry": shaded, "Name": _CENTER}).outputs[0]
        b.add("NodeGroupOutput", {0: clean})
        b.arrange()

    def _globes(self, points: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """A unit globe at each point, its pole along the plane's normal as the ellipsoid's own frame sees it."""
        b = self.b
        detail = self.given["Detail"]
        self.rings = b.math("ADD", b.math("MULTIPLY", detail, 2.0), 2.0)
        globe = b.add(
            "GeometryNodeMeshUVSphere",
            {"Segments": b.math("MULTIPLY", detail, 6.0), "Rings": self.rings, "Radius": 1.0},
        ).outputs[0]
        shown = b.add("GeometryNodeSetMaterial", {"Geometry": globe, "Material": self.given["Material"]}).outputs[0]
        upright = b.add("FunctionNodeAlignRotationToVector", {"Vector": self.given["Axis"]}, axis="Z").outputs[0]
        return b.add(
            "GeometryNodeInstanceOnPoints", {"Points": points, "Instance": shown, "Rotation": upright}
        ).outputs[0]

    def _cut_direction(self, direction: bpy.types.NodeSocket, center: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """Where a globe's vertex goes, in the frame where the ellipsoid is the unit ball."""
        b = self.b
        axis = self.given["Axis"]
        above = b.vector("SUBTRACT", center, self.given["Plane Point"])
        distance = b.vector("DOT_PRODUCT", above, self.given["Plane Normal"])
        height = b.math("DIVIDE", b.math("MULTIPLY", distance, -1.0), self.given["Reach"])
        rim = b.math("ARCCOSINE", b.math("MAXIMUM", b.math("MINIMUM", height, 1.0), -1.0))
        cosine = b.vector("DOT_PRODUCT", direction, axis)
        angle = b.math("ARCCOSINE", b.math("MAXIMUM", b.math("MINIMUM", cosine, 1.0), -1.0))
        first = b.math("DIVIDE", math.pi, self.rings)
        south = b.math("DIVIDE", b.math("SUBTRACT", angle, first), b.math("SUBTRACT", math.pi, first))
        along = b.math("MULTIPLY", b.math("MAXIMUM", south, 0.0), b.math("SUBTRACT", math.pi, rim))
        latitude = b.math("ADD", rim, along)
        north = b.math("MINIMUM", b.math("DIVIDE", angle, first), 1.0)
        radius = b.math("MULTIPLY", b.math("SINE", latitude), north)
        sideways = b.vector("NORMALIZE", b.vector("SUBTRACT", direction, b.vector("SCALE", axis, cosine)))
        return b.vector("ADD", b.vector("SCALE", axis, b.math("COSINE", latitude)), b.vector("SCALE", sideways, radius))

    def _face_alignment(self) -> bpy.types.NodeSocket:
        normal = self.b.add("GeometryNodeInputNormal").outputs[0]
        return self.b.vector("DOT_PRODUCT", normal, self.given["Plane Normal"])
