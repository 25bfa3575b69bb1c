"""A short way to write node trees in Python that is the same in Blender 4.5, 5.0 and 5.2."""

from __future__ import annotations

from typing import Any

import bpy


class TreeBuilder:
    """Adds nodes to a tree and wires them by socket name or index.

    Args:
        tree: an empty geometry or shader node tree.
        in_place: nodes lie in columns at once; else `arrange` has to be called in the end, which is faster.
    """

    def __init__(self, tree: bpy.types.NodeTree, in_place: bool = True) -> None:
        self.tree = tree
        self._in_place = in_place
        self._count = 0

    def add(
        self, kind: str, inputs: dict[str | int, Any] | None = None, label: str = "", **settings: Any
    ) -> bpy.types.Node:
        """A new node; `settings` are its properties, `inputs` values or sockets to link, by name or index."""
        node = self.tree.nodes.new(kind)
        node.label = label
        if self._in_place:
            node.location = _place(self._count)
        self._count += 1
        for name, value in settings.items():
            setattr(node, name, value)
        for key, value in (inputs or {}).items():
            self.connect(value, input_socket(node, key))
        return node

    def arrange(self) -> None:
        """Puts all nodes where they belong at once: each by itself makes Blender look at the whole tree again."""
        self.tree.nodes.foreach_set("location", [x for index in range(len(self.tree.nodes)) for x in _place(index)])

    def connect(self, value: Any, socket: bpy.types.NodeSocket) -> None:
        """Links `value` to `socket` when it is a socket, else makes it the socket's default."""
        if isinstance(value, bpy.types.NodeSocket):
            self.tree.links.new(value, socket)
        else:
            socket.default_value = value

    def math(self, operation: str, *operands: Any) -> bpy.types.NodeSocket:
        """A scalar Math node's output."""
        node = self.add("ShaderNodeMath", dict(enumerate(operands)), operation=operation)
        return node.outputs[0]

    def vector(self, operation: str, *operands: Any) -> bpy.types.NodeSocket:
        """A Vector Math node's output: the number for DOT_PRODUCT, LENGTH and DISTANCE, else the vector.

        The factor of SCALE is given as the second operand.
        """
        node = self.add("ShaderNodeVectorMath", operation=operation)
        for index, value in enumerate(operands):
            by_name = operation == "SCALE" and index == 1
            self.connect(value, node.inputs["Scale"] if by_name else node.inputs[index])
        scalar = operation in ("DOT_PRODUCT", "LENGTH", "DISTANCE")
        return node.outputs["Value" if scalar else "Vector"]

    def compare(self, operation: str, left: Any, right: Any) -> bpy.types.NodeSocket:
        """A float comparison's boolean output (geometry nodes)."""
        return self.add("FunctionNodeCompare", {0: left, 1: right}, data_type="FLOAT", operation=operation).outputs[0]

    def boolean(self, operation: str, *operands: Any) -> bpy.types.NodeSocket:
        """A Boolean Math node's output (geometry nodes)."""
        return self.add("FunctionNodeBooleanMath", dict(enumerate(operands)), operation=operation).outputs[0]

    def attribute(self, name: str, data_type: str) -> bpy.types.NodeSocket:
        """A named attribute's field (geometry nodes)."""
        node = self.add("GeometryNodeInputNamedAttribute", {"Name": name}, data_type=data_type)
        return next(socket for socket in node.outputs if socket.enabled)


def shader_builder(material: bpy.types.Material) -> TreeBuilder:
    """For a material's node tree, emptied; before Blender 5.0 a new material has none yet."""
    if material.node_tree is None:
        material.use_nodes = True
    material.node_tree.nodes.clear()
    return TreeBuilder(material.node_tree)


def _place(index: int) -> tuple[float, float]:
    return 220.0 * (index // 4), -220.0 * (index % 4)


def input_socket(node: bpy.types.Node, key: str | int) -> bpy.types.NodeSocket:
    """The input with this index, or the one in use among those with this name.

    Some nodes carry one socket of the same name for each data type and enable one of them.

    Raises:
        KeyError: the node has no such input.
    """
    if isinstance(key, int):
        return node.inputs[key]
    for socket in node.inputs:
        if socket.name == key and socket.enabled:
            return socket
    raise KeyError(f"node {node.bl_idname} has no input '{key}', only {[s.name for s in node.inputs]}")


def modifier_input(modifier: bpy.types.NodesModifier, name: str) -> Any:
    """The value of a node-group input of a Geometry Nodes modifier, by the name shown to the user."""
    identifier = _identifier(modifier, name)
    if hasattr(modifier, "properties"):
        return getattr(modifier.properties.inputs, identifier).value
    return modifier[identifier]


def set_modifier_input(modifier: bpy.types.NodesModifier, name: str, value: Any) -> None:
    """Sets a node-group input of a Geometry Nodes modifier, by the name shown to the user."""
    identifier = _identifier(modifier, name)
    if hasattr(modifier, "properties"):
        getattr(modifier.properties.inputs, identifier).value = value
    else:
        modifier[identifier] = value
    modifier.id_data.update_tag()


def _identifier(modifier: bpy.types.NodesModifier, name: str) -> str:
    for item in modifier.node_group.interface.items_tree:
        if item.item_type == "SOCKET" and item.in_out == "INPUT" and item.name == name:
            return item.identifier
    raise KeyError(f"node group '{modifier.node_group.name}' has no input '{name}'")
