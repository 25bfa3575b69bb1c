"""The node group that shows splats as points or ellipsoids and cuts them at a plane.

A cut ellipsoid stays a closed solid: its visible part and a flat cap, whose rim is the exact ellipse in which the
plane meets it. That is geometry, so Cycles, EEVEE and the solid viewport all show the same cut.
"""

from __future__ import annotations

import bpy

from .capping import capped_group
from .materials import SOFT_SIZE, splat_material
from .node_tree import TreeBuilder, set_modifier_input
from .splats import REACH, SURROUNDINGS

GROUP = "InsideOut Splats"

# Name, socket type, default, lowest, highest, description.
_INPUTS = (
    ("Ellipsoids", "NodeSocketBool", True, None, None, "Ellipsoids instead of points"),
    ("Size", "NodeSocketFloat", 1.6, 0.1, 4.0, "Half axes in standard deviations"),
    ("Soft", "NodeSocketBool", True, None, None, "Render ellipsoids with the soft edges of Gaussians"),
    ("Soft in Viewport", "NodeSocketBool", False, None, None, "Soft edges in the viewport too; needs a fast GPU"),
    ("Minimum Opacity", "NodeSocketFloat", 0.15, 0.0, 1.0, "Splats below it are not shown"),
    ("Minimum Density", "NodeSocketFloat", 0.0, 0.0, None, "X-ray splats in thinner surroundings are not shown, 1/mm"),
    ("Farthest", "NodeSocketFloat", 0.0, 0.0, None, "Splats reaching farther from the object's middle are not shown"),
    ("Detail", "NodeSocketInt", 2, 1, 5, "Fineness of the ellipsoids"),
    ("Section", "NodeSocketObject", None, None, None, "The plane that cuts"),
    ("Cut", "NodeSocketBool", False, None, None, "Hide what lies on one side of the plane"),
    ("Flip", "NodeSocketBool", False, None, None, "Hide the other side"),
    ("Slab", "NodeSocketFloat", 0.0, 0.0, None, "Show only this depth below the plane, mm; 0 shows all"),
)


def show_splats(splats: bpy.types.Object, ellipsoids: bool) -> bpy.types.NodesModifier:
    """Gives a point cloud the display modifier, or changes the one it has."""
    modifier = display_modifier(splats)
    if modifier is None:
        modifier = splats.modifiers.new(GROUP, "NODES")
        modifier.node_group = display_group()
        for name, kind, default, *_ in _INPUTS:
            if kind != "NodeSocketObject":
                set_modifier_input(modifier, name, default)
    set_modifier_input(modifier, "Ellipsoids", ellipsoids)
    return modifier


def display_modifier(splats: bpy.types.Object) -> bpy.types.NodesModifier | None:
    """The display modifier of a point cloud, if it has one."""
    for modifier in splats.modifiers:
        if modifier.type == "NODES" and modifier.node_group and modifier.node_group.name.startswith(GROUP):
            return modifier
    return None


def display_group() -> bpy.types.NodeTree:
    """The shared node group, built on first use; one of an older version in the file is left to its models."""
    wanted = {name for name, *_ in _INPUTS}
    for group in bpy.data.node_groups:
        if group.name.startswith(GROUP) and wanted <= set(group.interface.items_tree.keys()):
            return group
    return _build_group()


def _build_group() -> bpy.types.NodeTree:
    group = bpy.data.node_groups.new(GROUP, "GeometryNodeTree")
    group.is_modifier = True
    group.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    for name, kind, default, low, high, description in _INPUTS:
        socket = group.interface.new_socket(name, in_out="INPUT", socket_type=kind)
        socket.description = description
        if default is not None:
            socket.default_value = default
        if low is not None:
            socket.min_value = low
        if high is not None:
            socket.max_value = high
    group.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    _DisplayTree(group).build()
    return group


class _DisplayTree:
    """Builds the group's nodes; fields that several branches share are attributes."""

    def __init__(self, group: bpy.types.NodeTree) -> None:
        self.b = TreeBuilder(group, in_place=False)
        self.given = self.b.add("NodeGroupInput").outputs
        self.opaque = splat_material("Splats")

    def build(self) -> None:
        b = self.b
        self._plane()
        self._reach()
        shown = self._delete(self.given["Geometry"], self._invisible())
        chosen = b.add(
            "GeometryNodeSwitch",
            {
                "Switch": self.given["Ellipsoids"],
                "False": self._points(shown),
                "True": self._ellipsoids(shown),
            },
            input_type="GEOMETRY",
        )
        b.add("NodeGroupOutput", {0: chosen.outputs[0]})
        b.arrange()

    def _invisible(self) -> bpy.types.NodeSocket:
        """Splats too faint to see, X-ray splats that float in air, and the background of photos."""
        b = self.b
        base = b.add("FunctionNodeSeparateColor", {0: b.attribute("radiance:base", "FLOAT_COLOR")})
        faint = b.compare("LESS_THAN", base.outputs["Alpha"], self.given["Minimum Opacity"])
        thin = b.compare("LESS_THAN", b.attribute(SURROUNDINGS, "FLOAT"), self.given["Minimum Density"])
        # 0 shows all; what has no reach is never too far.
        crops = b.compare("GREATER_THAN", self.given["Farthest"], 0.0)
        far = b.boolean("AND", crops, b.compare("GREATER_THAN", b.attribute(REACH, "FLOAT"), self.given["Farthest"]))
        return b.boolean("OR", b.boolean("OR", faint, thin), far)

    def _plane(self) -> None:
        """Plane point and unit normal towards the hidden side, in the frame of the splats."""
        b = self.b
        info = b.add("GeometryNodeObjectInfo", {"Object": self.given["Section"]}, transform_space="RELATIVE")
        up = b.add("FunctionNodeRotateVector", {0: (0.0, 0.0, 1.0), 1: info.outputs["Rotation"]}).outputs[0]
        sign = b.math("SUBTRACT", 1.0, b.math("MULTIPLY", self.given["Flip"], 2.0))
        self.origin = info.outputs["Location"]
        self.normal = b.vector("SCALE", up, sign)

    def _distance(self) -> bpy.types.NodeSocket:
        """Signed distance of an element from the plane, positive on the hidden side."""
        position = self.b.add("GeometryNodeInputPosition").outputs[0]
        return self.b.vector("DOT_PRODUCT", self.b.vector("SUBTRACT", position, self.origin), self.normal)

    def _reach(self) -> None:
        """How far a splat's ellipsoid reaches along the normal, k·|S·Rᵀn|, and the direction of S·Rᵀn."""
        b = self.b
        self.scale = b.attribute("scale", "FLOAT_VECTOR")
        self.rotation = b.attribute("rotation", "QUATERNION")
        inverse = b.add("FunctionNodeInvertRotation", {0: self.rotation}).outputs[0]
        local = b.add("FunctionNodeRotateVector", {0: self.normal, 1: inverse}).outputs[0]
        stretched = b.vector("MULTIPLY", local, self.scale)
        self.axis = b.vector("NORMALIZE", stretched)
        length = b.math("MAXIMUM", b.vector("LENGTH", stretched), 1e-9)
        self.reach = b.math("MULTIPLY", length, self.given["Size"])

    def _hidden(self, margin: bpy.types.NodeSocket | float) -> bpy.types.NodeSocket:
        """Splats wholly on the hidden side, or below the slab."""
        b = self.b
        distance = self._distance()
        above = b.compare("GREATER_THAN", distance, margin)
        has_slab = b.compare("GREATER_THAN", self.given["Slab"], 0.0)
        floor = b.math("MULTIPLY", self.given["Slab"], -1.0)
        below = b.boolean("AND", has_slab, b.compare("LESS_THAN", b.math("ADD", distance, margin), floor))
        return b.boolean("AND", self.given["Cut"], b.boolean("OR", above, below))

    def _delete(self, geometry: bpy.types.NodeSocket, which: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        return self.b.add(
            "GeometryNodeDeleteGeometry", {"Geometry": geometry, "Selection": which}, domain="POINT"
        ).outputs[0]

    def _points(self, shown: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """Spheres of the splats' mean size; near the plane they shrink, so that none pokes through it."""
        b = self.b
        kept = self._delete(shown, self._hidden(0.0))
        radius = b.math("MULTIPLY", b.attribute("radius", "FLOAT"), self.given["Size"])
        gap = b.math("ABSOLUTE", self._distance())
        fitting = b.add(
            "GeometryNodeSwitch",
            {"Switch": self.given["Cut"], "False": radius, "True": b.math("MINIMUM", radius, gap)},
            input_type="FLOAT",
        ).outputs[0]
        sized = b.add("GeometryNodeSetPointRadius", {"Points": kept, "Radius": fitting}).outputs[0]
        return self._material(sized, self.opaque)

    def _ellipsoids(self, shown: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        b = self.b
        kept = self._delete(shown, self._hidden(self.reach))
        self._softness()
        # What a soft ball's tail would show through the plane belongs to the cut ones.
        away = b.math(
            "MULTIPLY", self.reach, b.math("DIVIDE", self.whole_size, b.math("MULTIPLY", self.given["Size"], -1.0))
        )
        crossing = b.boolean("AND", self.given["Cut"], b.compare("GREATER_THAN", self._distance(), away))
        parts = b.add("GeometryNodeSeparateGeometry", {"Geometry": kept, "Selection": crossing}, domain="POINT")
        whole = self._whole(parts.outputs["Inverted"])
        join = b.add("GeometryNodeJoinGeometry", {0: whole})
        b.connect(self._capped(parts.outputs["Selection"]), join.inputs[0])
        return join.outputs[0]

    def _softness(self) -> None:
        """Whether whole ellipsoids are soft, and the half axes that they then need, in standard deviations."""
        b = self.b
        in_viewport = b.add("GeometryNodeIsViewport").outputs[0]
        allowed = b.boolean("OR", b.boolean("NOT", in_viewport), self.given["Soft in Viewport"])
        self.soft = b.boolean("AND", self.given["Soft"], allowed)
        self.whole_size = b.add(
            "GeometryNodeSwitch",
            {"Switch": self.soft, "False": self.given["Size"], "True": SOFT_SIZE},
            input_type="FLOAT",
        ).outputs[0]

    def _whole(self, points: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """Instances of a ball: solid of the given size, or larger with the soft material."""
        b = self.b
        ball = b.add("GeometryNodeMeshIcoSphere", {"Radius": 1.0, "Subdivisions": self.given["Detail"]})
        smooth = b.add("GeometryNodeSetShadeSmooth", {0: ball.outputs[0]}).outputs[0]
        colored = b.add(
            "GeometryNodeSwitch",
            {
                "Switch": self.soft,
                "False": self._material(smooth, splat_material("Solid Splats")),
                "True": self._material(smooth, splat_material("Soft Splats")),
            },
            input_type="GEOMETRY",
        ).outputs[0]
        return b.add(
            "GeometryNodeInstanceOnPoints",
            {
                "Points": points,
                "Instance": colored,
                "Rotation": self.rotation,
                "Scale": b.vector("SCALE", self.scale, self.whole_size),
            },
        ).outputs[0]

    def _capped(self, points: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """Ellipsoids that cross the plane, closed on it."""
        given = {
            "Geometry": points,
            "Size": self.given["Size"],
            "Detail": self.given["Detail"],
            "Plane Point": self.origin,
            "Plane Normal": self.normal,
            "Axis": self.axis,
            "Reach": self.reach,
            "Scale": self.scale,
            "Rotation": self.rotation,
            "Material": self.opaque,
        }
        return self.b.add("GeometryNodeGroup", given, node_tree=capped_group()).outputs[0]

    def _material(self, geometry: bpy.types.NodeSocket, material: bpy.types.Material) -> bpy.types.NodeSocket:
        return self.b.add("GeometryNodeSetMaterial", {"Geometry": geometry, "Material": material}).outputs[0]
