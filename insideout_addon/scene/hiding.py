"""The node group that leaves of a model's splats those that are to be seen, before any is drawn."""

from __future__ import annotations

from collections.abc import Iterator
from functools import reduce

import bpy

from .node_tree import InputRow, Sockets, TreeBuilder, row, shared_group
from .splats import DENSITY_HERE, DEPTH, REACH, SURROUNDINGS

# In the order of `Modality`.
SHOWN = ("Photos", "X-rays", "Clones")
# Inputs of the display, which describes them.
_NUMBERS = ("Minimum Opacity", "Minimum Density", "Farthest", "Peel", "Layer", "Density From", "Density To")
_INPUTS: tuple[InputRow, ...] = (
    row("Geometry", "Geometry"),
    *(row(name, "Float") for name in _NUMBERS),
    *(row(name, "Bool") for name in SHOWN),
)


def visible_group() -> bpy.types.NodeTree:
    """The shared node group, built on first use: points without those that the display's inputs hide."""
    return shared_group("InsideOut Visible", _INPUTS, lambda b, given: [_VisibleTree(b, given).build()])


class _VisibleTree:
    """Adds the group's nodes."""

    def __init__(self, b: TreeBuilder, given: Sockets) -> None:
        self.b, self.given = b, given

    def build(self) -> bpy.types.NodeSocket:
        hidden = reduce(self._or, [*self._faint_or_alone(), *self._peeled()])
        return self.b.deleted(self.given["Geometry"], hidden)

    def _faint_or_alone(self) -> Iterator[bpy.types.NodeSocket]:
        """Splats too faint to see, X-ray splats that float in air, and the background of photos."""
        b = self.b
        base = b.add("FunctionNodeSeparateColor", {0: b.attribute("radiance:base", "FLOAT_COLOR")})
        yield b.compare("LESS_THAN", base.outputs["Alpha"], self.given["Minimum Opacity"])
        yield b.compare("LESS_THAN", b.attribute(SURROUNDINGS, "FLOAT"), self.given["Minimum Density"])
        # 0 shows all; what has no reach is never too far.
        crops = b.compare("GREATER_THAN", self.given["Farthest"], 0.0)
        yield b.boolean("AND", crops, b.compare("GREATER_THAN", b.attribute(REACH, "FLOAT"), self.given["Farthest"]))

    def _peeled(self) -> Iterator[bpy.types.NodeSocket]:
        """Splats that are taken away by depth, by density, and by what they are from."""
        deepest = self.b.math("ADD", self.given["Peel"], self.given["Layer"])
        yield self._beyond(DEPTH, self.given["Peel"], self.given["Layer"], deepest)
        yield self._beyond(DENSITY_HERE, self.given["Density From"], self.given["Density To"], self.given["Density To"])
        b, modality = self.b, self.b.attribute("modality", "INT")
        for number, name in enumerate(SHOWN):
            of_it = b.add("FunctionNodeCompare", {"A": modality, "B": number}, data_type="INT", operation="EQUAL")
            yield b.boolean("AND", of_it.outputs[0], b.boolean("NOT", self.given[name]))

    def _beyond(
        self,
        name: str,
        least: bpy.types.NodeSocket,
        has_most: bpy.types.NodeSocket,
        most: bpy.types.NodeSocket,
    ) -> bpy.types.NodeSocket:
        """Whether an attribute is below `least`, or above `most` where `has_most` is not 0; splats without it stay."""
        b = self.b
        node = b.add("GeometryNodeInputNamedAttribute", {"Name": name}, data_type="FLOAT")
        value = node.outputs["Attribute"]
        above = b.boolean("AND", b.compare("GREATER_THAN", has_most, 0.0), b.compare("GREATER_THAN", value, most))
        return b.boolean("AND", node.outputs["Exists"], b.boolean("OR", b.compare("LESS_THAN", value, least), above))

    def _or(self, one: bpy.types.NodeSocket, other: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        return self.b.boolean("OR", one, other)
