"""The node group that shows splats as points, ellipsoids or both, cut at the planes in their slots (`cut_slots`).

A cut ellipsoid stays a closed solid: its visible part and flat caps on the planes. That is geometry, so Cycles, EEVEE
and the solid viewport all show the same cut.
"""

from __future__ import annotations

from collections.abc import Generator
from functools import reduce
from typing import Any

import bpy

from .capping import capped_group, globe_group
from .clipping import clipped_group, core_group, way_group
from .cut_slots import HEIGHTS, REPEATED, SLOTS
from .hiding import visible_group
from .materials import SOFT_SIZE, splat_material
from .memory import MOST_ELLIPSOIDS
from .mixing import mixed_group, worth_group, worthy_group
from .native import draws_splats
from .native_colors import colored_group
from .node_tree import (
    InputRow,
    OutputRow,
    Sockets,
    TreeBuilder,
    input_names,
    is_of_kind,
    modifier_input,
    row,
    set_modifier_input,
    shared_group,
)
from .splat_fields import slot_group
from .splats import WHOLE_SCALE

GROUP = "InsideOut Splats"

_INPUTS: tuple[InputRow, ...] = (
    row("Geometry", "Geometry"),
    ("Ellipsoids", "NodeSocketBool", True, None, None, "Ellipsoids instead of points"),
    ("Size", "NodeSocketFloat", 1.6, 0.1, 4.0, "Half axes in standard deviations"),
    ("Soft", "NodeSocketBool", True, None, None, "Render ellipsoids with the soft edges of Gaussians"),
    ("Soft in Viewport", "NodeSocketBool", False, None, None, "Soft edges in the viewport too; needs a fast GPU"),
    ("Minimum Opacity", "NodeSocketFloat", 0.15, 0.0, 1.0, "Splats below it are not shown"),
    (
        "Minimum Density",
        "NodeSocketFloat",
        0.0,
        0.0,
        None,
        "X-ray splats in less dense surroundings are not shown, mm⁻¹",
    ),
    ("Farthest", "NodeSocketFloat", 0.0, 0.0, None, "Splats reaching farther from the object's middle are not shown"),
    ("Detail", "NodeSocketInt", 2, 1, 5, "Fineness of the ellipsoids"),
    ("Cut", "NodeSocketBool", False, None, None, "Cut the splats at the planes in their slots"),
    ("Mixed", "NodeSocketBool", False, None, None, "Ellipsoids where they matter, points elsewhere"),
    (
        "Ellipsoids at Most",
        "NodeSocketInt",
        MOST_ELLIPSOIDS,
        0,
        None,
        "Mixed: the smaller of the rest are points",
    ),
    ("Near Cuts", "NodeSocketFloat", 0.0, 0.0, None, "Mixed: ellipsoids so far below a cut, mm; 0: those it crosses"),
    ("Large From", "NodeSocketFloat", 0.0, 0.0, None, "Mixed: ellipsoids of this standard deviation and more, mm"),
    row("Box", "Object", "Mixed: what is in this box, from -1 to 1 in its own frame, is ellipsoids"),
    row("Camera", "Object", "Mixed: splats count as large as they look from here"),
    ("Peel", "NodeSocketFloat", 0.0, 0.0, None, "Splats less deep under the outer surface are not shown, mm"),
    ("Layer", "NodeSocketFloat", 0.0, 0.0, None, "Splats deeper than this under Peel are not shown, mm; 0 shows all"),
    ("Density From", "NodeSocketFloat", 0.0, 0.0, None, "Splats where the model is less dense are not shown, mm⁻¹"),
    ("Density To", "NodeSocketFloat", 0.0, 0.0, None, "Splats where it is denser are not shown, mm⁻¹; 0 shows all"),
    ("Photos", "NodeSocketBool", True, None, None, "Show the splats that photos gave"),
    ("X-rays", "NodeSocketBool", True, None, None, "Show the splats that X-rays gave"),
    ("Clones", "NodeSocketBool", True, None, None, "Show the details that photos added to those of X-rays"),
    ("View-Dependent", "NodeSocketBool", False, None, None, "Pass on the color that depends on the view, undrawn here"),
)
_PLANE: tuple[OutputRow, ...] = (
    ("Hidden", "NodeSocketFloat"),
    ("Crossing", "NodeSocketFloat"),
    ("Normal", "NodeSocketVector"),
    ("Height", "NodeSocketFloat"),
    ("Gap", "NodeSocketFloat"),
)
_VERY_FAR = 1e6
# What planes do to a splat, while it is being cut: Hidden, Crossing, Gap.
_MARKS = "insideout_planes"
# Which splats of a mixed display are ellipsoids, mm of the model.
_LENGTHS = ("Large From", "Near Cuts")


def show_splats(splats: bpy.types.Object, ellipsoids: bool, mixed: bool = False) -> bpy.types.NodesModifier:
    """Gives a point cloud the display modifier, or changes the one it has.

    Args:
        mixed: of ellipsoids only those that matter, the other splats as points.
    """
    modifier = display_modifier(splats)
    if modifier is None:
        modifier = splats.modifiers.new(GROUP, "NODES")
        modifier.node_group = display_group()
        for name, _, default, *_ in _INPUTS:
            if default is not None:
                set_modifier_input(modifier, name, default)
    elif "Mixed" not in input_names(modifier.node_group):
        renew_display(modifier)
    set_modifier_input(modifier, "Ellipsoids", ellipsoids)
    set_modifier_input(modifier, "Mixed", ellipsoids and mixed)
    return modifier


def display_modifier(splats: bpy.types.Object) -> bpy.types.NodesModifier | None:
    """The display modifier of a point cloud, if it has one."""
    for modifier in splats.modifiers:
        if is_of_kind(modifier, GROUP):
            return modifier
    return None


def renew_display(modifier: bpy.types.NodesModifier) -> dict[str, Any]:
    """Gives a display of an older version the node group of this one; inputs that both have keep their values.

    Returns:
        The values of all inputs before, by name.
    """
    values = {name: modifier_input(modifier, name) for name in input_names(modifier.node_group) - {"Geometry"}}
    modifier.node_group = display_group()
    for name, _, default, *_ in _INPUTS:
        value = values.get(name, default)
        if name != "Geometry" and value is not None:
            set_modifier_input(modifier, name, value)
    return values


def scale_display(splats: bpy.types.Object, factor: float, denser: float = 1.0) -> None:
    """Keeps the same splats shown, and as ellipsoids, when all of them become larger and denser."""
    modifier = display_modifier(splats)
    if modifier is None:
        return
    factors = {**dict.fromkeys(_LENGTHS, factor), "Minimum Density": denser}
    for name in input_names(modifier.node_group).intersection(factors):
        set_modifier_input(modifier, name, factors[name] * modifier_input(modifier, name))


def display_group() -> bpy.types.NodeTree:
    """The shared node group, built on first use; one of an older version in the file is left to its models."""
    return shared_group(GROUP, _INPUTS, lambda b, given: [_DisplayTree(b, given).build()], modifier=True)


def display_in_steps() -> Generator[float, None, None]:
    """As `display_group`, with a break after each of its parts that tells the share that is done."""
    for index, build in enumerate(PARTS):
        build()
        yield (index + 1) / len(PARTS)


def _plane_group() -> bpy.types.NodeTree:
    """What the plane in a slot does to a splat.

    Hidden and Crossing are 1 or 0: the plane hides all of it, or cuts it; Normal and Height are the plane's where it
    cuts and zero elsewhere; Gap is how far the centre is below the plane, very far where there is none.
    """
    inputs = [row("Slot", "Int"), row("Size", "Float"), row("Whole Size", "Float")]
    return shared_group("InsideOut Plane and Splat", inputs, _build_plane, _PLANE)


def _build_plane(b: TreeBuilder, given: Sockets) -> list[bpy.types.NodeSocket]:
    plane = b.group(slot_group(), {"Slot": given["Slot"]})
    used, height = plane["Used"], plane["Height"]
    reach = b.math("MULTIPLY", plane["Deviation"], given["Size"])
    hidden = b.math("MULTIPLY", used, b.math("LESS_THAN", b.math("ADD", height, reach), 0.0))
    # What a soft ball's tail would show through the plane belongs to the cut ones.
    near = b.math("LESS_THAN", height, b.math("MULTIPLY", plane["Deviation"], given["Whole Size"]))
    crossing = b.math("MULTIPLY", used, near)
    away = b.math("MULTIPLY", b.math("SUBTRACT", 1.0, used), _VERY_FAR)
    gap = b.math("ADD", b.math("MULTIPLY", height, used), away)
    normal = b.vector("SCALE", plane["Normal"], crossing)
    return [hidden, crossing, normal, b.math("MULTIPLY", height, crossing), gap]


def planes_group() -> bpy.types.NodeTree:
    """What the planes in all slots do to a splat: sums of what `_plane_group` says of each, and the smallest Gap.

    Where one plane cuts a splat, the sums are that plane's own.
    """
    inputs = [row("Geometry", "Geometry"), row("Size", "Float"), row("Whole Size", "Float")]
    return shared_group("InsideOut Planes and Splat", inputs, _build_planes, _PLANE)


def _build_planes(b: TreeBuilder, given: Sockets) -> list[bpy.types.NodeSocket]:
    sizes = {name: given[name] for name in ("Size", "Whole Size")}
    planes = [_plane_if_any(b, slot, given["Geometry"], sizes) for slot in range(SLOTS)]

    def total(output: str) -> bpy.types.NodeSocket:
        add = b.vector if output == "Normal" else b.math
        return reduce(lambda so_far, more: add("ADD", so_far, more), (plane[output] for plane in planes))

    gap = reduce(lambda least, one: b.math("MINIMUM", least, one), (plane["Gap"] for plane in planes))
    return [total("Hidden"), total("Crossing"), total("Normal"), total("Height"), gap]


def _plane_if_any(b: TreeBuilder, slot: int, geometry: bpy.types.NodeSocket, sizes: Sockets) -> Sockets:
    """What `_plane_group` says of a slot; of one that no splat has the same, worked out once instead of for each."""
    plane, there = b.group(_plane_group(), {"Slot": slot, **sizes}), b.exists(geometry, HEIGHTS[slot])
    none = {"Normal": (0.0, 0.0, 0.0), "Gap": _VERY_FAR}
    return {
        name: b.switch(there, none.get(name, 0.0), plane[name], "VECTOR" if name == "Normal" else "FLOAT")
        for name, _ in _PLANE
    }


def ball_group() -> bpy.types.NodeTree:
    """Instances of a ball on points: solid of the given size, or larger with the soft material."""
    inputs = [row("Geometry", "Geometry"), row("Soft", "Bool"), row("Size", "Float"), row("Detail", "Int")]
    return shared_group("InsideOut Whole Splats", inputs, _build_balls)


def _build_balls(b: TreeBuilder, given: Sockets) -> list[bpy.types.NodeSocket]:
    ball = b.add("GeometryNodeMeshIcoSphere", {"Radius": 1.0, "Subdivisions": given["Detail"]})
    smooth = b.add("GeometryNodeSetShadeSmooth", {0: ball.outputs[0]}).outputs[0]
    solid, soft = (
        b.add("GeometryNodeSetMaterial", {"Geometry": smooth, "Material": splat_material(name)}).outputs[0]
        for name in ("Solid Splats", "Soft Splats")
    )
    size = b.switch(given["Soft"], given["Size"], SOFT_SIZE, "FLOAT")
    placed = {
        "Points": given["Geometry"],
        "Instance": b.switch(given["Soft"], solid, soft),
        "Rotation": b.attribute("rotation", "QUATERNION"),
        "Scale": b.vector("SCALE", b.attribute("scale", "FLOAT_VECTOR"), size),
    }
    return [b.add("GeometryNodeInstanceOnPoints", placed).outputs[0]]


class _DisplayTree:
    """Adds the group's nodes; fields that several branches share are attributes."""

    def __init__(self, b: TreeBuilder, given: Sockets) -> None:
        self.b, self.given = b, given
        self.opaque = splat_material("Splats")
        self.scale = b.attribute("scale", "FLOAT_VECTOR")
        self._softness()

    def build(self) -> bpy.types.NodeSocket:
        b, given = self.b, self.given
        hides = visible_group()
        inputs = {name: given[name] for name in input_names(hides)}
        visible = b.group(hides, {**inputs, "Geometry": self._drawn(given["Geometry"])})[0]
        shown = self._marked(b.group(colored_group(), {"Geometry": visible})[0])
        mixed = self._mixed(shown)
        chosen = b.switch(given["Mixed"], shown, mixed["Ellipsoids"])
        rest = b.switch(given["Mixed"], None, mixed["Points"])
        points = self._points(b.switch(given["Ellipsoids"], shown, rest))
        return b.join(points, self._ellipsoids(b.switch(given["Ellipsoids"], None, chosen)))

    def _drawn(self, splats: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """Splats without the view-dependent colours that are most of them, for what is shown is a copy; Blender 5.3's
        own drawing has them."""
        if draws_splats():
            return splats
        return self.b.switch(self.given["View-Dependent"], self.b.without(splats, "radiance:sh_*"), splats)

    def _marked(self, shown: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """What planes do to each splat, worked out once for all that asks for it."""
        b, cut = self.b, self.given["Cut"]
        sizes = {"Size": self.given["Size"], "Whole Size": self.whole_size}
        self.planes = b.group(planes_group(), {"Geometry": shown, **sizes})
        names = ("Hidden", "Crossing", "Gap")
        packed = b.add("ShaderNodeCombineXYZ", dict(enumerate(self.planes[name] for name in names))).outputs[0]
        marked = b.stored(shown, _MARKS, "FLOAT_VECTOR", packed)
        unpacked = b.add("ShaderNodeSeparateXYZ", {0: b.attribute(_MARKS, "FLOAT_VECTOR")}).outputs
        without_planes = (0.0, 0.0, _VERY_FAR)
        self.hidden, self.crossing, self.gap = (
            b.switch(cut, none, mark, "FLOAT") for none, mark in zip(without_planes, unpacked, strict=True)
        )
        return b.switch(cut, shown, marked)

    def _mixed(self, shown: bpy.types.NodeSocket) -> Sockets:
        """Which splats are worth an ellipsoid, and which are not."""
        names = ("Large From", "Near Cuts", "Box", "Camera")
        given = {name: self.given[name] for name in names} | {"Most": self.given["Ellipsoids at Most"]}
        marks = {"Hidden": self.hidden, "Crossing": self.crossing, "Gap": self.gap}
        return self.b.group(mixed_group(), {"Geometry": shown, **given, **marks})

    def _points(self, shown: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """Spheres of the splats' mean size; near a plane they shrink, so that none pokes through it."""
        b = self.b
        radius = self._radius()
        # Beside ellipsoids a part may stand for what another one, that is cut, leaves out.
        twice = b.boolean("AND", b.attribute(REPEATED, "BOOLEAN"), b.boolean("NOT", self.given["Ellipsoids"]))
        left = b.deleted(shown, b.boolean("OR", b.compare("LESS_THAN", self.gap, 0.0), twice))
        cut = b.without(self._sized(left, b.math("MINIMUM", radius, self.gap)), _MARKS)
        points = b.switch(self.given["Cut"], self._sized(shown, radius), cut)
        # Where Blender draws splats it has a material of its own for them.
        return points if draws_splats() else self._material(points, self.opaque)

    def _radius(self) -> bpy.types.NodeSocket:
        """Not of the attribute `radius`, which splats of other importers may not have."""
        mean = self.b.vector("DOT_PRODUCT", self.scale, (1 / 3, 1 / 3, 1 / 3))
        return self.b.math("MULTIPLY", mean, self.given["Size"])

    def _sized(self, points: bpy.types.NodeSocket, radius: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        if draws_splats():
            # Blender's own splats go by their axes: those near a plane shrink as a whole.
            points = self.b.stored(points, WHOLE_SCALE, "FLOAT_VECTOR", self.scale)
            part = self.b.math("DIVIDE", radius, self.b.math("MAXIMUM", self._radius(), 1e-9))
            points = self.b.stored(points, "scale", "FLOAT_VECTOR", self.b.vector("SCALE", self.scale, part))
        return self.b.add("GeometryNodeSetPointRadius", {"Points": points, "Radius": radius}).outputs[0]

    def _ellipsoids(self, shown: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        return self.b.switch(self.given["Cut"], self._whole(shown), self._cut(shown))

    def _cut(self, shown: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """Ellipsoids that no plane reaches whole, those that one cuts exactly, and those at edges and corners."""
        b = self.b
        kept = b.deleted(shown, b.compare("GREATER_THAN", self.hidden, 0.5))
        cut, whole = self._separated(kept, b.compare("GREATER_THAN", self.crossing, 0.5))
        several, one = self._separated(cut, b.compare("GREATER_THAN", self.crossing, 1.5))
        whole, one, several = (b.without(part, _MARKS) for part in (whole, one, several))
        capped = self._capped(one, self.planes["Normal"], self.planes["Height"])
        return b.join(self._whole(whole), b.if_any(one, capped), b.if_any(several, self._clipped(several)))

    def _separated(
        self, geometry: bpy.types.NodeSocket, which: bpy.types.NodeSocket
    ) -> tuple[bpy.types.NodeSocket, bpy.types.NodeSocket]:
        """Those that are chosen and the others."""
        node = self.b.add("GeometryNodeSeparateGeometry", {"Geometry": geometry, "Selection": which}, domain="POINT")
        return node.outputs["Selection"], node.outputs["Inverted"]

    def _softness(self) -> None:
        """Whether whole ellipsoids are soft, and the half axes that they then need, in standard deviations."""
        b = self.b
        in_viewport = b.add("GeometryNodeIsViewport").outputs[0]
        allowed = b.boolean("OR", b.boolean("NOT", in_viewport), self.given["Soft in Viewport"])
        self.soft = b.boolean("AND", self.given["Soft"], allowed)
        self.whole_size = b.switch(self.soft, self.given["Size"], SOFT_SIZE, "FLOAT")

    def _whole(self, points: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        given = {name: self.given[name] for name in ("Size", "Detail")}
        return self.b.group(ball_group(), {"Geometry": points, "Soft": self.soft, **given})[0]

    def _capped(
        self, points: bpy.types.NodeSocket, normal: bpy.types.NodeSocket, height: bpy.types.NodeSocket
    ) -> bpy.types.NodeSocket:
        """Ellipsoids that one plane cuts, closed on it."""
        given = {
            "Geometry": points,
            "Size": self.given["Size"],
            "Detail": self.given["Detail"],
            "Normal": normal,
            "Height": height,
            "Material": splat_material("Solid Splats"),
        }
        return self.b.group(capped_group(), given)[0]

    def _clipped(self, points: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """Ellipsoids that several planes cut, closed on them."""
        given = {
            "Geometry": points,
            "Size": self.given["Size"],
            "Detail": self.given["Detail"],
            "Material": self.opaque,
        }
        return self.b.group(clipped_group(), given)[0]

    def _material(self, geometry: bpy.types.NodeSocket, material: bpy.types.Material) -> bpy.types.NodeSocket:
        return self.b.add("GeometryNodeSetMaterial", {"Geometry": geometry, "Material": material}).outputs[0]


PARTS = (
    *(globe_group, capped_group, core_group, way_group, clipped_group, colored_group, visible_group),
    *(worthy_group, worth_group, mixed_group, planes_group, ball_group, display_group),
)
"""What builds the node groups of a display, of which each needs some of those before it."""
