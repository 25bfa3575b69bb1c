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
    """Adds the group's nodes.

    An input of 0 hides nothing, and what hides nothing is not worked out: a plane that moves asks for all of it again
    and again.
    """

    def __init__(self, b: TreeBuilder, given: Sockets) -> None:
        self.b, self.given = b, given

    def build(self) -> bpy.types.NodeSocket:
        hidden = reduce(self._or, [*self._faint_or_alone(), *self._peeled()])
        return self.b.deleted(self.given["Geometry"], hidden)

    def _faint_or_alone(self) -> Iterator[bpy.types.NodeSocket]:
        """Splats too faint to see, X-ray splats that float in air, and the background of photos."""
        b = self.b
        base = b.add("FunctionNodeSeparateColor", {0: b.attribute("radiance:base", "FLOAT_COLOR")})
        yield self._where("Minimum Opacity", "LESS_THAN", base.outputs["Alpha"])
        yield self._where("Minimum Density", "LESS_THAN", b.attribute(SURROUNDINGS, "FLOAT"))
        # What has no reach is never too far.
        yield self._where("Farthest", "GREATER_THAN", b.attribute(REACH, "FLOAT"))

    def _where(self, name: str, operation: str, value: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """Whether a value compares so with an input; never where that is 0."""
        return self._if(self._above_zero(name), self.b.compare(operation, value, self.given[name]))

    def _above_zero(self, name: str) -> bpy.types.NodeSocket:
        return self.b.compare("GREATER_THAN", self.given[name], 0.0)

    def _if(self, asked: bpy.types.NodeSocket, which: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        return self.b.switch(asked, False, which, "BOOLEAN")

    def _peeled(self) -> Iterator[bpy.types.NodeSocket]:
        """Splats that are taken away by depth, by density, and by what they are from."""
        deepest = self.b.math("ADD", self.given["Peel"], self.given["Layer"])
        yield self._beyond(DEPTH, "Peel", "Layer", deepest)
        yield self._beyond(DENSITY_HERE, "Density From", "Density To", self.given["Density To"])
        b, modality = self.b, self.b.attribute("modality", "INT")
        for number, name in enumerate(SHOWN):
            of_it = b.add("FunctionNodeCompare", {"A": modality, "B": number}, data_type="INT", operation="EQUAL")
            yield self._if(b.boolean("NOT", self.given[name]), of_it.outputs[0])

    def _beyond(self, name: str, least: str, has_most: str, most: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """Whether an attribute is below the input `least`, or above `most` where the input `has_most` is not 0.

        Splats without it stay.
        """
        b = self.b
        node = b.add("GeometryNodeInputNamedAttribute", {"Name": name}, data_type="FLOAT")
        value = node.outputs["Attribute"]
        above = self._if(self._above_zero(has_most), b.compare("GREATER_THAN", value, most))
        outside = b.boolean("OR", b.compare("LESS_THAN", value, self.given[least]), above)
        asked = b.boolean("OR", self._above_zero(least), self._above_zero(has_most))
        return self._if(asked, b.boolean("AND", node.outputs["Exists"], outside))

    def _or(self, one: bpy.types.NodeSocket, other: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        return self.b.boolean("OR", one, other)
