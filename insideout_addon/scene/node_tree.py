"""A short way to write node trees in Python that is the same in Blender 4.5, 5.0 and 5.2."""

from __future__ import annotations

import re
from collections.abc import Callable, Generator, Sequence
from contextlib import suppress
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import bpy

from ...core.steps import run_through
from .native import draws_splats

Sockets = bpy.types.NodeOutputs


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

    def group(self, tree: bpy.types.NodeTree, inputs: dict[str, Any]) -> Sockets:
        """A node group's outputs (geometry nodes)."""
        return self.add("GeometryNodeGroup", inputs, node_tree=tree).outputs

    def switch(self, condition: Any, without: Any, with_it: Any, kind: str = "GEOMETRY") -> bpy.types.NodeSocket:
        """One of two geometries, or values of a kind as "FLOAT"; what is not asked for is not computed.

        None is no geometry.
        """
        given = {"Switch": condition, "False": without, "True": with_it}
        known = {name: value for name, value in given.items() if value is not None}
        return self.add("GeometryNodeSwitch", known, input_type=kind).outputs[0]

    def join(self, first: bpy.types.NodeSocket, *others: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """Geometries as one."""
        node = self.add("GeometryNodeJoinGeometry", {0: first})
        for other in others:
            self.connect(other, node.inputs[0])
        return node.outputs[0]

    def stored(
        self,
        geometry: bpy.types.NodeSocket,
        name: bpy.types.NodeSocket | str,
        kind: str,
        value: bpy.types.NodeSocket | bool,
        selection: bpy.types.NodeSocket | bool = True,
    ) -> bpy.types.NodeSocket:
        """Points with a named attribute, which those selected get."""
        given = {"Geometry": geometry, "Name": name, "Value": value, "Selection": selection}
        return self.add("GeometryNodeStoreNamedAttribute", given, data_type=kind, domain="POINT").outputs[0]

    def captured(
        self, geometry: bpy.types.NodeSocket, vectors: dict[str, bpy.types.NodeSocket]
    ) -> tuple[bpy.types.NodeSocket, list[bpy.types.NodeSocket]]:
        """Points and fields of vectors on them that are worked out once, together."""
        node = self.add("GeometryNodeCaptureAttribute", {"Geometry": geometry}, domain="POINT")
        for name, value in vectors.items():
            node.capture_items.new("VECTOR", name)
            self.connect(value, node.inputs[name])
        return node.outputs["Geometry"], [node.outputs[name] for name in vectors]

    def statistic(
        self, geometry: bpy.types.NodeSocket, field: Any, name: str, kind: str = "FLOAT"
    ) -> bpy.types.NodeSocket:
        """One value for all points, those of meshes too: "Mean" or "Sum" of a field (geometry nodes)."""
        given = {"Geometry": geometry, "Attribute": field}
        found = self.add("GeometryNodeAttributeStatistic", given, data_type=kind, domain="POINT")
        return next(socket for socket in found.outputs if socket.name == name and socket.enabled)

    def if_any(self, points: bpy.types.NodeSocket, made: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """What was made of points, not even tried where there are none."""
        count = self.statistic(points, 1.0, "Sum")
        return self.switch(self.compare("GREATER_THAN", count, 0.5), None, made)

    def sampled(
        self, geometry: bpy.types.NodeSocket, value: bpy.types.NodeSocket, index: bpy.types.NodeSocket, kind: str
    ) -> bpy.types.NodeSocket:
        """A field of another geometry's points at one of them."""
        given = {"Geometry": geometry, "Value": value, "Index": index}
        node = self.add("GeometryNodeSampleIndex", data_type=kind, domain="POINT")
        for name, source in given.items():
            self.connect(source, input_socket(node, name))
        return next(socket for socket in node.outputs if socket.enabled)

    def without(self, geometry: bpy.types.NodeSocket, *names: str) -> bpy.types.NodeSocket:
        """Geometry without attributes of these names; in a name "*" stands for anything."""
        for name in names:
            node = self.add("GeometryNodeRemoveAttribute", {"Geometry": geometry, "Name": name})
            if "*" in name and hasattr(node, "pattern_mode"):
                node.pattern_mode = "WILDCARD"
            elif "*" in name:
                # Since Blender 5.0.
                node.inputs["Pattern Mode"].default_value = "Wildcard"
            geometry = node.outputs[0]
        return geometry

    def deleted(self, geometry: bpy.types.NodeSocket, which: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """Points but those chosen."""
        given = {"Geometry": geometry, "Selection": which}
        return self.add("GeometryNodeDeleteGeometry", given, domain="POINT").outputs[0]

    def exists(self, geometry: bpy.types.NodeSocket, name: str) -> bpy.types.NodeSocket:
        """Whether points have an attribute of this name: one answer for all, unlike a field's (geometry nodes)."""
        found = self.add("GeometryNodeInputNamedAttribute", {"Name": name}).outputs["Exists"]
        given = {"Geometry": geometry, "Value": found, "Index": 0}
        return self.add("GeometryNodeSampleIndex", given, data_type="BOOLEAN", domain="POINT").outputs[0]

    def zone(self, kind: str) -> tuple[bpy.types.Node, bpy.types.Node]:
        """The first and last node of a simulation or repeat zone, which passes on a geometry.

        Args:
            kind: as both are called but for Input and Output.
        """
        start, end = self.add(f"{kind}Input"), self.add(f"{kind}Output")
        start.pair_with_output(end)
        return start, end

    def bundle(self, items: dict[str, Any]) -> bpy.types.NodeSocket:
        """Sockets and values by their names as one (since Blender 5.0)."""
        node = self.add("NodeCombineBundle")
        for name, value in items.items():
            node.bundle_items.new(_socket_type(value), name)
            self.connect(value, node.inputs[name])
        return node.outputs[0]

    def total(self, value: bpy.types.NodeSocket, group: bpy.types.NodeSocket, kind: str) -> bpy.types.NodeSocket:
        """The sum of a field over all points with the same number (geometry nodes)."""
        node = self.add("GeometryNodeAccumulateField", data_type=kind, domain="POINT")
        self.connect(value, input_socket(node, "Value"))
        self.connect(group, input_socket(node, "Group ID"))
        return next(socket for socket in node.outputs if socket.name == "Total" and socket.enabled)

    def attribute(self, name: bpy.types.NodeSocket | str, data_type: str) -> bpy.types.NodeSocket:
        """A named attribute's field (geometry nodes)."""
        node = self.add("GeometryNodeInputNamedAttribute", {"Name": name}, data_type=data_type)
        return next(socket for socket in node.outputs if socket.enabled)


InputRow = tuple[str, str, Any, Any, Any, str]
"""Name, socket type, default, lowest, highest, description; None where there is none."""
OutputRow = tuple[str, str]
"""Name and socket type."""
GEOMETRY: tuple[OutputRow, ...] = (("Geometry", "NodeSocketGeometry"),)


# On each node group: which version of the files below built it. On each shared material: of the file that builds it.
STAMP_KEY = "insideout_builders"
# On each node group: the name that it was built under, whatever the user calls it.
KIND_KEY = "insideout_group"
_BUILDERS = (
    "node_tree.py",
    "splat_fields.py",
    "cut_slots.py",
    "cutting.py",
    "capping.py",
    "clipping.py",
    "materials.py",
    "native_colors.py",
    "hiding.py",
    "mixing.py",
    "display.py",
    "following_nodes.py",
    "../physics/soft_nodes.py",
    "../physics/soft_modifier.py",
)


def row(name: str, kind: str, description: str = "") -> InputRow:
    """An input without a default or limits; `kind` as in "Float"."""
    return name, f"NodeSocket{kind}", None, None, None, description


def shared_group(
    name: str,
    inputs: Sequence[InputRow],
    build: Callable[[TreeBuilder, Sockets], Sequence[bpy.types.NodeSocket]],
    outputs: Sequence[OutputRow] = GEOMETRY,
    modifier: bool = False,
) -> bpy.types.NodeTree:
    """The file's geometry node group of this name, built on first use.

    One that another version of the add-on built is left to its models: `STAMP_KEY` tells. One that is linked from a
    library is left there: what is imported into a file is not to depend on another file. What a tree needs several
    times is best a group of its own: Blender looks at all of a tree for each new node.

    Args:
        build: adds the nodes, given a builder and the inputs' sockets, and returns the sockets of the outputs.
        modifier: whether the group can be a modifier.
    """

    def at_once(b: TreeBuilder, given: Sockets) -> Generator[float, None, Sequence[bpy.types.NodeSocket]]:
        yield from ()
        return build(b, given)

    return run_through(shared_in_steps(name, inputs, at_once, outputs, modifier))


def shared_in_steps(
    name: str,
    inputs: Sequence[InputRow],
    build: Callable[[TreeBuilder, Sockets], Generator[float, None, Sequence[bpy.types.NodeSocket]]],
    outputs: Sequence[OutputRow] = GEOMETRY,
    modifier: bool = False,
) -> Generator[float, None, bpy.types.NodeTree]:
    """As `shared_group`, with the breaks that `build` makes; closed before its end there is no new group.

    Raises:
        ReferenceError: an undo, or a purge, in a break has taken the group away.
    """
    found = group_there(name, inputs)
    if found is not None:
        return found
    stamp, group = builders_stamp(), bpy.data.node_groups.new(name, "GeometryNodeTree")
    group.is_modifier = modifier
    _add_sockets(group, inputs, outputs)
    b = TreeBuilder(group, in_place=False)
    try:
        made = yield from _while_there(group, build(b, b.add("NodeGroupInput").outputs))
        b.add("NodeGroupOutput", dict(enumerate(made)))
    except BaseException:
        with suppress(ReferenceError):
            bpy.data.node_groups.remove(group)
        raise
    b.arrange()
    # Half of it would be taken for the group by whoever asks for it in a break.
    group[STAMP_KEY], group[KIND_KEY] = stamp, name
    return group


def is_of_kind(modifier: bpy.types.Modifier, name: str) -> bool:
    """Whether a modifier has the node group that this add-on builds under a name, of any version.

    The user may have renamed it; of one that does not tell, of a file of before, the name does.
    """
    group = modifier.node_group if modifier.type == "NODES" else None
    if group is None:
        return False
    return group[KIND_KEY] == name if KIND_KEY in group else group.name.startswith(name)


def group_there(name: str, inputs: Sequence[InputRow]) -> bpy.types.NodeTree | None:
    """The group of this name and with these inputs that this version of the add-on has built in the file."""
    wanted, stamp = {name for name, *_ in inputs}, builders_stamp()
    for group in bpy.data.node_groups:
        own = group.library is None and group.get(STAMP_KEY) == stamp
        if own and group.bl_idname == "GeometryNodeTree" and _is_called(group, name) and input_names(group) == wanted:
            return group
    return None


def _while_there(
    group: bpy.types.NodeTree, building: Generator[float, None, Sequence[bpy.types.NodeSocket]]
) -> Generator[float, None, Sequence[bpy.types.NodeSocket]]:
    """What adds nodes to a group, ended where an undo or a purge in a break takes that away.

    Its sockets would not know: whoever asks them for anything then crashes Blender.
    """
    try:
        while True:
            yield next(building)
            # Of a group that is gone this is a ReferenceError.
            _ = group.session_uid
    except StopIteration as end:
        return end.value
    finally:
        building.close()


def shared_material(name: str, source: str, build: Callable[[bpy.types.Material], None]) -> bpy.types.Material:
    """The file's material of this name, built on first use; as `shared_group`, one of another version stays beside it.

    Args:
        source: `__file__` of the module that builds it.
        build: gives the new material its nodes and settings.
    """
    stamp = _stamp((Path(__file__), Path(source)))
    for material in bpy.data.materials:
        if material.library is None and material.get(STAMP_KEY) == stamp and _is_called(material, name):
            return material
    material = bpy.data.materials.new(name)
    material[STAMP_KEY] = stamp
    build(material)
    return material


def builders_stamp() -> str:
    """Changes whenever a file that builds node groups does, so that no number has to be kept by hand.

    And where Blender draws splats itself, for there the groups are others.
    """
    return _stamp(tuple(Path(__file__).parent / name for name in _BUILDERS), draws_splats())


@cache
def _stamp(files: tuple[Path, ...], native: bool = False) -> str:
    return sha256(b"".join(file.read_bytes() for file in files) + bytes([native])).hexdigest()[:12]


def _is_called(block: bpy.types.ID, name: str) -> bool:
    """Whether a block has this name, or it with the number that Blender gives to the second of its kind."""
    return re.fullmatch(re.escape(name) + r"(\.\d+)?", block.name) is not None


def input_names(group: bpy.types.NodeTree) -> set[str]:
    """The names of a node group's inputs."""
    sockets = [item for item in group.interface.items_tree if item.item_type == "SOCKET"]
    return {socket.name for socket in sockets if socket.in_out == "INPUT"}


def _add_sockets(group: bpy.types.NodeTree, inputs: Sequence[InputRow], outputs: Sequence[OutputRow]) -> None:
    for name, kind, default, low, high, description in inputs:
        socket = group.interface.new_socket(name, in_out="INPUT", socket_type=kind)
        socket.description = description
        if default is not None:
            socket.default_value = default
        if low is not None:
            socket.min_value = low
        if high is not None:
            socket.max_value = high
    for name, kind in outputs:
        group.interface.new_socket(name, in_out="OUTPUT", socket_type=kind)


def shader_builder(material: bpy.types.Material) -> TreeBuilder:
    """For a material's node tree, emptied; before Blender 5.0 a new material has none yet."""
    if material.node_tree is None:
        material.use_nodes = True
    material.node_tree.nodes.clear()
    return TreeBuilder(material.node_tree)


def _socket_type(value: Any) -> str:
    """What a bundle calls the type of a socket or of a value."""
    if isinstance(value, bpy.types.NodeSocket):
        return "FLOAT" if value.type == "VALUE" else value.type
    return {bool: "BOOLEAN", float: "FLOAT", str: "STRING"}[type(value)]


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
    owner, path = input_property(modifier, name)
    return getattr(owner, path) if path == "value" else modifier[path[2:-2]]


def set_modifier_input(modifier: bpy.types.NodesModifier, name: str, value: Any) -> None:
    """Sets a node-group input of a Geometry Nodes modifier, by the name shown to the user."""
    owner, path = input_property(modifier, name)
    if path == "value":
        owner.value = value
    else:
        modifier[path[2:-2]] = value
    modifier.id_data.update_tag()


def input_property(modifier: bpy.types.NodesModifier, name: str) -> tuple[Any, str]:
    """What holds a node-group input of a modifier, and the path there: as `UILayout.prop` takes them.

    Raises:
        KeyError: the group has no such input.
    """
    for item in modifier.node_group.interface.items_tree:
        if item.item_type == "SOCKET" and item.in_out == "INPUT" and item.name == name:
            if hasattr(modifier, "properties"):
                return getattr(modifier.properties.inputs, item.identifier), "value"
            return modifier, f'["{item.identifier}"]'
    raise KeyError(f"node group '{modifier.node_group.name}' has no input '{name}'")
