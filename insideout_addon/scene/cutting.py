"""The node group that a section adds to a model: it notes on each splat which planes cut it.

It draws nothing itself. Several sections stand one after another in the modifiers, each with slots of its own
(`cut_slots`), and the display closes a splat at all of them.
"""

from __future__ import annotations

from collections.abc import Generator

import bpy

from ...core.steps import part_of_work, run_through
from .cut_slots import HEIGHTS, NORMALS, OFFSET, REPEATED, SLOTS
from .node_tree import InputRow, Sockets, TreeBuilder, row, shared_group, shared_in_steps
from .splat_fields import slot_name, stretched

GROUP = "InsideOut Section Cut"
# Largest size at which splats are displayed, in standard deviations: what is hidden beyond it is hidden at every size.
_FARTHEST = 4.0
_INPUTS: tuple[InputRow, ...] = (
    row("Geometry", "Geometry"),
    row("Section", "Object", "The plane, or the box from -1 to 1 in its own frame"),
    ("Box", "NodeSocketBool", False, None, None, "Cut by a box instead of a plane"),
    ("Flip", "NodeSocketBool", False, None, None, "Hide the other side of the plane, or the inside of the box"),
    ("Slab", "NodeSocketFloat", 0.0, 0.0, None, "Show only this depth below the plane; 0 shows all"),
    ("Apart", "NodeSocketFloat", 0.0, 0.0, None, "Show both sides of the plane, this far apart; 0 hides one"),
    ("Slot", "NodeSocketInt", 0, -1, SLOTS - 1, "First place for planes on splats; -1 hides whole splats"),
)


def cut_group() -> bpy.types.NodeTree:
    """The shared node group, built on first use."""
    return run_through(cut_group_in_steps())


def cut_group_in_steps() -> Generator[float, None, bpy.types.NodeTree]:
    """As `cut_group`, with breaks that tell the share that is done, 0 to 1; breaks and errors as `shared_in_steps`."""

    def build(b: TreeBuilder, given: Sockets) -> Generator[float, None, list[bpy.types.NodeSocket]]:
        return [(yield from _CutTree(b, given).build_in_steps())]

    return (yield from shared_in_steps(GROUP, _INPUTS, build, modifier=True))


def _noting_group() -> bpy.types.NodeTree:
    """Writes a plane into a slot and drops splats far behind it; without a slot those whose centres are behind it."""
    inputs = [row("Geometry", "Geometry"), row("Normal", "Vector"), row("Height", "Float"), row("Slot", "Int")]
    return shared_group("InsideOut Note Plane", inputs, _build_noting)


def _build_noting(b: TreeBuilder, given: Sockets) -> list[bpy.types.NodeSocket]:
    normal, height, slot = given["Normal"], given["Height"], given["Slot"]
    has_slot = b.compare("GREATER_EQUAL", slot, 0.0)
    # More than the deviation along the normal, and told much faster: the few splats more the display leaves out itself.
    most = b.vector("LENGTH", b.attribute("scale", "FLOAT_VECTOR"))
    margin = b.math("MULTIPLY", b.math("MULTIPLY", most, _FARTHEST), has_slot)
    hidden = b.compare("LESS_THAN", b.math("ADD", height, margin), 0.0)
    kept = b.deleted(given["Geometry"], hidden)
    facing = b.stored(kept, slot_name(b, NORMALS[0], slot), "FLOAT_VECTOR", normal)
    noted = b.stored(facing, slot_name(b, HEIGHTS[0], slot), "FLOAT", height)
    return [b.switch(has_slot, kept, noted)]


class _CutTree:
    """Adds the group's nodes; fields that several branches share are attributes."""

    def __init__(self, b: TreeBuilder, given: Sockets) -> None:
        self.b, self.given, self.noting = b, given, _noting_group()
        info = b.add("GeometryNodeObjectInfo", {"Object": given["Section"]}, transform_space="RELATIVE")
        self.origin = info.outputs["Location"]
        self.edges = [self._edge(info.outputs["Transform"], axis) for axis in range(3)]

    def build_in_steps(self) -> Generator[float, None, bpy.types.NodeSocket]:
        """Adds all of it: the later a node comes the longer Blender looks at the tree for it."""
        geometry = self.given["Geometry"]
        yield 0.0
        crop = yield from part_of_work(self._crop(geometry), 0.0, 0.2)
        notch = yield from part_of_work(self._notch(geometry), 0.2, 0.6)
        boxed = self.b.switch(self.given["Flip"], crop, notch)
        plane = yield from part_of_work(self._by_plane(geometry), 0.6, 1.0)
        return self.b.switch(self.given["Box"], plane, boxed)

    def _by_plane(self, geometry: bpy.types.NodeSocket) -> Generator[float, None, bpy.types.NodeSocket]:
        """The side below the plane, down to the slab's floor; or both sides, moved apart."""
        b = self.b
        sign = b.math("SUBTRACT", 1.0, b.math("MULTIPLY", self.given["Flip"], 2.0))
        normal = b.vector("SCALE", self._axis(2), sign)
        against = b.vector("SCALE", normal, -1.0)
        height = b.math("MULTIPLY", self._along(normal), -1.0)
        slot = self.given["Slot"]
        below = self._noted(geometry, normal, height, slot)
        yield 0.3
        # Its own slot, or none where the plane has none.
        second = b.math("ADD", slot, b.math("GREATER_THAN", b.math("ADD", slot, 1.0), 0.5))
        slab = self._noted(below, against, b.math("SUBTRACT", self.given["Slab"], height), second)
        kept = b.switch(b.compare("GREATER_THAN", self.given["Slab"], 0.0), below, slab)
        yield 0.6
        above = self._noted(geometry, against, b.math("MULTIPLY", height, -1.0), slot)
        yield 0.8
        step = b.vector("SCALE", normal, b.math("MULTIPLY", self.given["Apart"], 0.5))
        halves = b.join(self._moved(kept, b.vector("SCALE", step, -1.0)), self._moved(above, step))
        return b.switch(b.compare("GREATER_THAN", self.given["Apart"], 0.0), kept, halves)

    def _crop(self, geometry: bpy.types.NodeSocket) -> Generator[float, None, bpy.types.NodeSocket]:
        """What is in the box: of each pair of faces the nearer one cuts a splat."""
        b, slot = self.b, self.given["Slot"]
        has_slot = b.math("GREATER_THAN", b.math("ADD", slot, 1.0), 0.5)
        for axis in range(3):
            outward, depth = self._face(axis)
            own = b.math("ADD", slot, b.math("MULTIPLY", has_slot, float(axis)))
            geometry = self._noted(geometry, outward, depth, own)
            yield (axis + 1) / 3
        return geometry

    def _notch(self, geometry: bpy.types.NodeSocket) -> Generator[float, None, bpy.types.NodeSocket]:
        """What is not in the box: a splat at an edge stays beyond one face and beyond the other, as two parts.

        Its centre belongs to the first of them. Without a slot, where nothing cuts splats, there is no other.
        """
        b = self.b
        faces = []
        for axis in range(3):
            yield 0.2 * axis
            faces.append(self._face(axis))
        heights = [b.math("MULTIPLY", depth, -1.0) for _, depth in faces]
        highest = b.math("MAXIMUM", heights[0], b.math("MAXIMUM", heights[1], heights[2]))
        parts = []
        has_slot = b.compare("GREATER_EQUAL", self.given["Slot"], 0.0)
        earlier = b.compare("LESS_THAN", 1.0, 0.0)
        for (outward, _), height in zip(faces, heights, strict=True):
            yield 0.6 + 0.13 * len(parts)
            inward = b.vector("SCALE", outward, -1.0)
            reach = b.math("MULTIPLY", b.vector("LENGTH", stretched(b, inward)), _FARTHEST)
            # Far enough outside one face a splat is whole there, and nothing is left for the others.
            best = b.compare("GREATER_EQUAL", height, highest)
            first = b.boolean("AND", best, b.boolean("NOT", earlier))
            others = b.boolean("AND", b.compare("LESS_THAN", highest, reach), has_slot)
            part = b.deleted(geometry, b.boolean("NOT", b.boolean("OR", first, others)))
            marked = b.stored(part, REPEATED, "BOOLEAN", True, b.boolean("NOT", first))
            parts.append(self._noted(marked, inward, height, self.given["Slot"]))
            earlier = b.boolean("OR", earlier, best)
        return b.join(*parts)

    def _edge(self, transform: bpy.types.NodeSocket, axis: int) -> bpy.types.NodeSocket:
        """One of the section's own axes as the splats see it, as long as it is there."""
        unit = tuple(float(axis == k) for k in range(3))
        return self.b.add("FunctionNodeTransformDirection", {0: unit, 1: transform}).outputs[0]

    def _axis(self, axis: int) -> bpy.types.NodeSocket:
        """The unit normal of the section's face across an axis, on the side where the axis points.

        Not the axis itself: seen by splats that are scaled unevenly, the section's axes are not at right angles.
        """
        b = self.b
        normal = b.vector("CROSS_PRODUCT", self.edges[(axis + 1) % 3], self.edges[(axis + 2) % 3])
        mirrored = b.math("LESS_THAN", b.vector("DOT_PRODUCT", normal, self.edges[axis]), 0.0)
        sign = b.math("SUBTRACT", 1.0, b.math("MULTIPLY", mirrored, 2.0))
        return b.vector("SCALE", b.vector("NORMALIZE", normal), sign)

    def _along(self, direction: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """Distance of a splat's centre, before it was pulled away, from the section's middle along a direction."""
        b = self.b
        position = b.add("GeometryNodeInputPosition").outputs[0]
        place = b.vector("SUBTRACT", position, b.attribute(OFFSET, "FLOAT_VECTOR"))
        return b.vector("DOT_PRODUCT", b.vector("SUBTRACT", place, self.origin), direction)

    def _face(self, axis: int) -> tuple[bpy.types.NodeSocket, bpy.types.NodeSocket]:
        """The outward normal of the box's nearer face across an axis, and how far inside of it a centre lies."""
        b = self.b
        direction = self._axis(axis)
        distance = self._along(direction)
        # The sign of 0 would be no direction.
        side = b.math("SUBTRACT", b.math("MULTIPLY", b.math("GREATER_THAN", distance, 0.0), 2.0), 1.0)
        size = b.math("ABSOLUTE", b.vector("DOT_PRODUCT", self.edges[axis], direction))
        depth = b.math("SUBTRACT", size, b.math("ABSOLUTE", distance))
        return b.vector("SCALE", direction, side), depth

    def _noted(
        self,
        geometry: bpy.types.NodeSocket,
        normal: bpy.types.NodeSocket,
        height: bpy.types.NodeSocket,
        slot: bpy.types.NodeSocket,
    ) -> bpy.types.NodeSocket:
        given = {"Geometry": geometry, "Normal": normal, "Height": height, "Slot": slot}
        return self.b.group(self.noting, given)[0]

    def _moved(self, geometry: bpy.types.NodeSocket, step: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        b = self.b
        offset = b.vector("ADD", b.attribute(OFFSET, "FLOAT_VECTOR"), step)
        noted = b.stored(geometry, OFFSET, "FLOAT_VECTOR", offset)
        return b.add("GeometryNodeSetPosition", {"Geometry": noted, "Offset": step}).outputs[0]
