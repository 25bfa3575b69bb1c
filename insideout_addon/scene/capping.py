"""The node group that closes the ellipsoids that one plane cuts: geometry, so every renderer shows the same cut."""

from __future__ import annotations

import math

import bpy

from .node_tree import InputRow, Sockets, TreeBuilder, row, shared_group
from .splat_fields import stretched

# All fields are in the frame of the splats.
_INPUTS: tuple[InputRow, ...] = (
    row("Geometry", "Geometry"),
    row("Size", "Float", "Half axes in standard deviations"),
    row("Detail", "Int", "Fineness of the ellipsoids"),
    row("Normal", "Vector", "Of the plane, towards the hidden side"),
    row("Height", "Float", "From a splat's centre to the plane, mm"),
    row("Material", "Material", "Of the cut ellipsoids"),
)
_CENTER = "insideout_center"


def capped_group() -> bpy.types.NodeTree:
    """The shared node group, built on first use: points that a plane cuts to meshes closed by a flat cap on it."""
    return shared_group("InsideOut Cut Splats", _INPUTS, lambda b, given: [_CappedTree(b, given).build()])


class _CappedTree:
    """Adds the group's nodes.

    In the frame where an ellipsoid is the unit ball, the plane is at height h over its middle along the axis m. A
    globe with its pole on m has its northernmost circle of latitude moved to the cut, the others spread evenly from
    there to the south pole, and the north pole moved to the middle of the cut.
    """

    def __init__(self, b: TreeBuilder, given: Sockets) -> None:
        self.b, self.given = b, given

    def build(self) -> bpy.types.NodeSocket:
        b = self.b
        self._plane_in_the_ball()
        position = b.add("GeometryNodeInputPosition").outputs[0]
        marked = b.stored(self.given["Geometry"], _CENTER, "FLOAT_VECTOR", position)
        real = b.add("GeometryNodeRealizeInstances", {"Geometry": self._globes(marked)}).outputs[0]
        center = b.attribute(_CENTER, "FLOAT_VECTOR")
        direction = self._cut_direction(b.vector("SUBTRACT", position, center))
        axes = b.vector("SCALE", b.attribute("scale", "FLOAT_VECTOR"), self.given["Size"])
        ellipsoid = b.vector("MULTIPLY", direction, axes)
        turned = b.add("FunctionNodeRotateVector", {0: ellipsoid, 1: b.attribute("rotation", "QUATERNION")}).outputs[0]
        place = b.vector("ADD", center, turned)
        moved = b.add("GeometryNodeSetPosition", {"Geometry": real, "Position": place}).outputs[0]
        smooth = b.add("GeometryNodeSetShadeSmooth", {0: moved}).outputs[0]
        flat = b.compare("GREATER_THAN", self._face_alignment(), 0.9999)
        shaded = b.add("GeometryNodeSetShadeSmooth", {0: smooth, 1: flat, 2: False}, domain="FACE").outputs[0]
        return b.without(shaded, _CENTER)

    def _plane_in_the_ball(self) -> None:
        """The plane's axis m, the direction of S·Rᵀn, and how high over the middle it cuts, h."""
        b = self.b
        stretch = stretched(b, self.given["Normal"])
        self.axis = b.vector("NORMALIZE", stretch)
        length = b.math("MAXIMUM", b.vector("LENGTH", stretch), 1e-9)
        self.height = b.math("DIVIDE", self.given["Height"], b.math("MULTIPLY", length, self.given["Size"]))

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
        upright = b.add("FunctionNodeAlignRotationToVector", {"Vector": self.axis}, axis="Z").outputs[0]
        return b.add(
            "GeometryNodeInstanceOnPoints", {"Points": points, "Instance": shown, "Rotation": upright}
        ).outputs[0]

    def _cut_direction(self, direction: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """Where a globe's vertex goes, in the frame where the ellipsoid is the unit ball."""
        b = self.b
        axis = self.axis
        rim = b.math("ARCCOSINE", b.math("MAXIMUM", b.math("MINIMUM", self.height, 1.0), -1.0))
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
        return self.b.vector("DOT_PRODUCT", normal, self.given["Normal"])
