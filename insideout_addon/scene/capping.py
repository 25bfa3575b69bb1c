"""The node group that closes the ellipsoids that one plane cuts: instances of globes that are cut."""

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
    row("Height", "Float", "From a splat's center to the plane, mm"),
    row("Material", "Material", "Of the cut ellipsoids"),
)
# Globes that splats share, cut at evenly spread angles, twice as many for each step of detail up to the third. None
# reaches out of its ellipsoid by more than half of an angle's step, 5.2, 2.6 or 1.3 % of a half axis, while its flat
# sides lie up to 13, 3.4 and 1.5 % within. More would be made in vain each time that a plane moves.
_FEWEST_GLOBES, _MOST_GLOBES = 30.0, 120.0
_NUMBER = "insideout_globe"
_Z = (0.0, 0.0, 1.0)


def capped_group() -> bpy.types.NodeTree:
    """The shared node group, built on first use: points that a plane cuts to solids closed by a flat cap on it."""
    return shared_group("InsideOut Cut Splats", _INPUTS, lambda b, given: [_CappedTree(b, given).build()])


def globe_group() -> bpy.types.NodeTree:
    """Unit balls cut at right angles to z, at 0, 1, 2 ... steps from the pole, as instances in that order.

    Of a globe the northernmost circle of latitude is moved to the cut, the others are spread evenly from there to
    the south pole, and the north pole is moved to the middle of the cut.
    """
    inputs = [given for given in _INPUTS if given[0] in ("Detail", "Material")]
    return shared_group("InsideOut Cut Globes", inputs, _build_globes)


def _globes(b: TreeBuilder, detail: bpy.types.NodeSocket) -> tuple[bpy.types.NodeSocket, bpy.types.NodeSocket]:
    """How many there are, and the angle from one to the next."""
    doubled = b.math("POWER", 2.0, b.math("SUBTRACT", detail, 1.0))
    count = b.math("MINIMUM", b.math("MULTIPLY", doubled, _FEWEST_GLOBES), _MOST_GLOBES)
    return count, b.math("DIVIDE", math.pi, count)


def _build_globes(b: TreeBuilder, given: Sockets) -> list[bpy.types.NodeSocket]:
    count, step = _globes(b, given["Detail"])
    places = b.add("GeometryNodePoints", {"Count": count}).outputs[0]
    index = b.add("GeometryNodeInputIndex").outputs[0]
    numbered = b.stored(places, _NUMBER, "INT", index)
    rings = b.math("ADD", b.math("MULTIPLY", given["Detail"], 2.0), 2.0)
    segments = b.math("MULTIPLY", given["Detail"], 6.0)
    globe = b.add("GeometryNodeMeshUVSphere", {"Segments": segments, "Rings": rings, "Radius": 1.0}).outputs[0]
    shown = b.add("GeometryNodeSetMaterial", {"Geometry": globe, "Material": given["Material"]}).outputs[0]
    whole = b.add("GeometryNodeInstanceOnPoints", {"Points": numbered, "Instance": shown}).outputs[0]
    real = b.add("GeometryNodeRealizeInstances", {"Geometry": whole}).outputs[0]
    number = b.attribute(_NUMBER, "INT")
    cut = {"Geometry": real, "Position": _cut_place(b, b.math("MULTIPLY", number, step), rings)}
    moved = b.add("GeometryNodeSetPosition", cut).outputs[0]
    smooth = b.add("GeometryNodeSetShadeSmooth", {0: moved}).outputs[0]
    upwards = b.vector("DOT_PRODUCT", b.add("GeometryNodeInputNormal").outputs[0], _Z)
    flat = b.compare("GREATER_THAN", upwards, 0.9999)
    shaded = b.add("GeometryNodeSetShadeSmooth", {0: smooth, 1: flat, 2: False}, domain="FACE").outputs[0]
    apart = b.add("GeometryNodeSplitToInstances", {"Geometry": shaded, "Group ID": number}, domain="FACE")
    return [b.without(apart.outputs[0], _NUMBER)]


def _cut_place(b: TreeBuilder, rim: bpy.types.NodeSocket, rings: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """Where a globe's vertex goes, given the angle of the rim from the pole."""
    place = b.add("GeometryNodeInputPosition").outputs[0]
    angle = b.math("ARCCOSINE", b.math("MAXIMUM", b.math("MINIMUM", b.vector("DOT_PRODUCT", place, _Z), 1.0), -1.0))
    first = b.math("DIVIDE", math.pi, rings)
    south = b.math("DIVIDE", b.math("SUBTRACT", angle, first), b.math("SUBTRACT", math.pi, first))
    along = b.math("MULTIPLY", b.math("MAXIMUM", south, 0.0), b.math("SUBTRACT", math.pi, rim))
    latitude = b.math("ADD", rim, along)
    north = b.math("MINIMUM", b.math("DIVIDE", angle, first), 1.0)
    radius = b.math("MULTIPLY", b.math("SINE", latitude), north)
    sideways = b.vector("NORMALIZE", b.vector("MULTIPLY", place, (1.0, 1.0, 0.0)))
    return b.vector("ADD", b.vector("SCALE", _Z, b.math("COSINE", latitude)), b.vector("SCALE", sideways, radius))


class _CappedTree:
    """Adds the group's nodes.

    In the frame where an ellipsoid is the unit ball, the plane is at height h over its middle along the axis m, and
    the rim of what is left lies at the angle θ = arccos h from the pole m. A mesh for each splat would take ten times
    the memory of an instance, so each is an instance of the cut ball whose θ is next to its own, stretched along m
    until its cap lies on the plane. Below the equator it is stretched sideways too: then the rim is the exact ellipse
    in which plane and ellipsoid meet.
    """

    def __init__(self, b: TreeBuilder, given: Sockets) -> None:
        self.b, self.given = b, given
        self.count, self.step = _globes(b, given["Detail"])

    def build(self) -> bpy.types.NodeSocket:
        b = self.b
        self._plane_in_the_ball()
        instances = b.add(
            "GeometryNodeInstanceOnPoints",
            {
                "Points": self.given["Geometry"],
                "Instance": b.group(globe_group(), {name: self.given[name] for name in ("Detail", "Material")})[0],
                "Pick Instance": True,
                "Instance Index": self.number,
            },
        ).outputs[0]
        placed = {"Instances": instances, "Transform": self._placement()}
        return b.add("GeometryNodeSetInstanceTransform", placed).outputs[0]

    def _plane_in_the_ball(self) -> None:
        """The plane's axis m, the direction of S·Rᵀn, how high over the middle it cuts, h, and the globe for it."""
        b = self.b
        stretch = stretched(b, self.given["Normal"])
        self.axis = b.vector("NORMALIZE", stretch)
        length = b.math("MULTIPLY", b.math("MAXIMUM", b.vector("LENGTH", stretch), 1e-9), self.given["Size"])
        # The soft rim of an ellipsoid may reach through a plane that passes its solid part by.
        self.height = b.math("MAXIMUM", b.math("MINIMUM", b.math("DIVIDE", self.given["Height"], length), 1.0), -1.0)
        nearest = b.math("ROUND", b.math("DIVIDE", b.math("ARCCOSINE", self.height), self.step))
        # Of the last one there would be nothing left.
        self.number = b.math("MINIMUM", nearest, b.math("SUBTRACT", self.count, 1.0))

    def _placement(self) -> bpy.types.NodeSocket:
        """From a cut globe to where the splat is cut: stretched to the height, turned to the plane, then the splat."""
        b = self.b
        turned = b.add("FunctionNodeAlignRotationToVector", {"Vector": self.axis}, axis="Z").outputs[0]
        splat = self._transform(
            Translation=b.add("GeometryNodeInputPosition").outputs[0],
            Rotation=b.attribute("rotation", "QUATERNION"),
            Scale=b.vector("SCALE", b.attribute("scale", "FLOAT_VECTOR"), self.given["Size"]),
        )
        facing = b.add("FunctionNodeMatrixMultiply", {0: splat, 1: self._transform(Rotation=turned)}).outputs[0]
        return b.add("FunctionNodeMatrixMultiply", {0: facing, 1: self._stretch()}).outputs[0]

    def _stretch(self) -> bpy.types.NodeSocket:
        """Moves the cap of the globe to the height h; the south pole stays."""
        b = self.b
        angle = b.math("MULTIPLY", self.number, self.step)
        cap = b.math("COSINE", angle)
        up = b.math("DIVIDE", b.math("ADD", self.height, 1.0), b.math("ADD", cap, 1.0))
        rim = b.math("SINE", b.math("ARCCOSINE", self.height))
        southern = b.math("LESS_THAN", self.height, 0.0)
        wider = b.math("SUBTRACT", b.math("DIVIDE", rim, b.math("MAXIMUM", b.math("SINE", angle), 1e-9)), 1.0)
        sideways = b.math("ADD", b.math("MULTIPLY", southern, wider), 1.0)
        rise = b.math("SUBTRACT", self.height, b.math("MULTIPLY", up, cap))
        return self._transform(
            Translation=b.add("ShaderNodeCombineXYZ", {"Z": rise}).outputs[0],
            Scale=b.add("ShaderNodeCombineXYZ", {"X": sideways, "Y": sideways, "Z": up}).outputs[0],
        )

    def _transform(self, **parts: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        return self.b.add("FunctionNodeCombineTransform", parts).outputs[0]
