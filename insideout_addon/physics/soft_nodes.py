"""Soft bodies by nodes: a cage moved by Blender's XPBD solver, where it has one (since 5.2).

What a spring is worth is in the mesh's attributes, under the names that the solver looks for; the node group adds
gravity, what the cage touches, and damping. Seen in 5.2.2: an odd number of substeps moves half as far.
"""

from __future__ import annotations

import math
from typing import Any

import bpy
import numpy as np

from ..scene.node_tree import (
    InputRow,
    Sockets,
    TreeBuilder,
    is_of_kind,
    modifier_input,
    row,
    set_modifier_input,
    shared_group,
)
from .cage import Cage
from .motion import Motion

GROUP = "InsideOut Soft Body"
_SOLVER = "GeometryNodeXPBDSolver"
# Where in the solver's world the cage and its springs are.
_CAGE, _SPRINGS = "Cage", "Springs"
_FORCE, _MASS, _VELOCITY = "external_force", "mass", "velocity"
# What hangs together: its vertices have the same number.
_PART = "part"
# How often a frame inner motion is damped. The solver's own damping would brake the fall as well.
_PARTS = 4
# At most this far into the contact's zone in a step, the zone's size in boxes, and steps a frame.
_SHARE_OF_ZONE, _ZONE = 0.8, 0.1
_FEWEST, _MOST = 40, 400
_FRICTION = 0.6
# 1/s: how fast wobbling dies away, and turning, which stands for the friction of rolling.
_DAMPING, _SPIN_DAMPING = 10.0, 5.0
_INPUTS: tuple[InputRow, ...] = (
    row("Geometry", "Geometry"),
    row("Colliders", "Collection", "What the body falls onto and is touched by"),
    ("Gravity", "NodeSocketVector", None, None, None, "Acceleration in units per s²"),
    ("Steps", "NodeSocketInt", 20, 2, None, "Steps of the solver in a quarter of a frame; an even number"),
    ("Speed", "NodeSocketFloat", 1.0, 0.0, None, "1 is as fast as in reality"),
    ("Damping", "NodeSocketFloat", _DAMPING, 0.0, None, "How fast inner motion dies away, 1/s"),
    ("Spin Damping", "NodeSocketFloat", _SPIN_DAMPING, 0.0, None, "How fast rotation dies away, 1/s"),
)


def has_solver() -> bool:
    """Whether this Blender has the XPBD solver as a node."""
    return hasattr(bpy.types, _SOLVER)


def add_solver(thing: bpy.types.Object, cage: Cage, motion: Motion) -> None:
    """Lets an object whose mesh is a cage, each spring an edge, move by the solver.

    Args:
        thing: not turned or scaled.
    """
    # The unit of mass does not matter to the solver; numbers near 1 are good for single precision.
    grams = float(cage.masses.mean())
    compliance = 1e-3 * cage.spring_lengths() / cage.spring_stiffness() * (1e-3 * grams)
    # Of the mesh, for the model's object may be scaled, unevenly too.
    places = np.empty(3 * len(cage.vertices), np.float32)
    thing.data.vertices.foreach_get("co", places)
    ends = places.reshape(-1, 3).astype(np.float64)[cage.springs]
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    springs = f"sim:prop:{_CAGE}/{_SPRINGS}"
    zone = np.full(len(cage.masses), _ZONE * cage.sides.min() * motion.units_per_mm)
    for name, domain, values in (
        (_MASS, "POINT", cage.masses / grams),
        ("radius", "POINT", zone),
        ("static_friction", "POINT", np.full(len(zone), _FRICTION)),
        ("dynamic_friction", "POINT", np.full(len(zone), _FRICTION)),
        (f"{springs}:rest_length", "EDGE", lengths),
        (f"{springs}:compliance", "EDGE", compliance),
    ):
        layer = thing.data.attributes.new(name, "FLOAT", domain)
        layer.data.foreach_set("value", values.astype(np.float32))
    thing.data.attributes.new(_VELOCITY, "FLOAT_VECTOR", "POINT")
    thing.data.attributes.new(_PART, "INT", "POINT").data.foreach_set("value", cage.parts().astype(np.int32))
    modifier = thing.modifiers.new(GROUP, "NODES")
    modifier.node_group = soft_group()
    crossing = motion.fastest_mm_s / (_SHARE_OF_ZONE * _ZONE * cage.sides.min())
    steps = min(max(motion.frame_s * max(cage.frequency(), crossing), _FEWEST), _MOST)
    inputs = {
        "Colliders": motion.colliders,
        "Gravity": motion.gravity,
        "Steps": 2 * math.ceil(steps / _PARTS / 2),
        "Speed": 1.0 / motion.slow_motion,
    }
    for name, value in inputs.items():
        set_modifier_input(modifier, name, value)


def restart(thing: bpy.types.Object) -> None:
    """Forgets what was played of a cage: Blender keeps the frames with the modifier, wherever they are to begin."""
    for old in [each for each in thing.modifiers if is_of_kind(each, GROUP)]:
        name, place = old.name, thing.modifiers.find(old.name)
        new = thing.modifiers.new(GROUP, "NODES")
        new.node_group = old.node_group
        for socket, *_ in _INPUTS[1:]:
            set_modifier_input(new, socket, modifier_input(old, socket))
        thing.modifiers.remove(old)
        new.name = name
        thing.modifiers.move(len(thing.modifiers) - 1, place)


def soft_group() -> bpy.types.NodeTree:
    """The shared node group, built on first use."""
    return shared_group(GROUP, _INPUTS, lambda b, given: [_SoftTree(b, given).build()], modifier=True)


class _SoftTree:
    """Adds the group's nodes."""

    def __init__(self, b: TreeBuilder, given: Sockets) -> None:
        self.b, self.given = b, given

    def build(self) -> bpy.types.NodeSocket:
        b = self.b
        start, end = b.zone("GeometryNodeSimulation")
        end.state_items.new("GEOMETRY", "Colliders")
        colliders = b.add(
            "GeometryNodeCollectionInfo",
            {"Collection": self.given["Colliders"], "Separate Children": True},
            transform_space="RELATIVE",
        ).outputs[0]
        b.connect(self.given["Geometry"], start.inputs["Geometry"])
        b.connect(colliders, start.inputs["Colliders"])
        seconds = b.math("MULTIPLY", start.outputs["Delta Time"], self.given["Speed"])
        moved = self._moved(start.outputs["Geometry"], start.outputs["Colliders"], colliders, seconds)
        b.connect(moved, end.inputs["Geometry"])
        b.connect(colliders, end.inputs["Colliders"])
        return end.outputs["Geometry"]

    def _moved(
        self,
        cage: bpy.types.NodeSocket,
        before: bpy.types.NodeSocket,
        now: bpy.types.NodeSocket,
        seconds: bpy.types.NodeSocket,
    ) -> bpy.types.NodeSocket:
        """The cage a frame later, in parts between which it is damped; what it touches moves evenly all along."""
        b = self.b
        force = b.vector("SCALE", self.given["Gravity"], b.attribute(_MASS, "FLOAT"))
        cage = b.stored(cage, _FORCE, "FLOAT_VECTOR", force)
        world = {"Colliders": self._collider(now, self._collider(before))}
        springs = b.bundle({"Type": "Blender.Constraint.EdgeLength", "filter": "", "error_threshold": 1e-3})
        start, end = b.zone("GeometryNodeRepeat")
        start.inputs["Iterations"].default_value = _PARTS
        b.connect(cage, start.inputs["Geometry"])
        part = b.math("DIVIDE", seconds, float(_PARTS))
        begin = b.math("DIVIDE", start.outputs["Iteration"], float(_PARTS))
        solver = b.add(
            _SOLVER,
            {
                "World": b.bundle(
                    {_CAGE: b.bundle({"Geometry": start.outputs["Geometry"], _SPRINGS: springs}), **world}
                ),
                "Delta Time": part,
                "Substeps": self.given["Steps"],
                "Begin": begin,
                "End": b.math("ADD", begin, 1.0 / _PARTS),
            },
        )
        solved = b.add(
            "NodeGetBundleItem", {"Bundle": solver.outputs[0], "Path": f"{_CAGE}/Geometry"}, socket_type="GEOMETRY"
        )
        b.connect(self._damped(solved.outputs["Item"], part), end.inputs["Geometry"])
        return end.outputs["Geometry"]

    def _collider(
        self, geometry: bpy.types.NodeSocket, previous: bpy.types.NodeSocket | None = None
    ) -> bpy.types.NodeSocket:
        items: dict[str, Any] = {
            "Type": "Blender.Collider.Mesh",
            "filter": "",
            "geometry": geometry,
            "margin": 0.0,
            "friction": _FRICTION,
            "compliance": 0.0,
            "deforming": False,
            "use_edge_contacts": False,
            "is_boundary": False,
            "error_threshold": 1e-3,
        }
        return self.b.bundle(items if previous is None else {**items, "previous": previous})

    def _damped(self, cage: bpy.types.NodeSocket, seconds: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """Velocities nearer to those of a rigid body of the same momentum and angular momentum (Müller et al. 2007,
        Position Based Dynamics, section 3.5), so that neither falling nor turning is braked by inner friction; of each
        part for itself, for what lies does not brake what still falls."""
        b = self.b
        mass, velocity = b.attribute(_MASS, "FLOAT"), b.attribute(_VELOCITY, "FLOAT_VECTOR")
        part = b.attribute(_PART, "INT")
        total = b.total(mass, part, "FLOAT")

        def mean(value: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
            summed = b.total(b.vector("SCALE", value, mass), part, "FLOAT_VECTOR")
            return b.vector("DIVIDE", summed, total)

        position = b.add("GeometryNodeInputPosition").outputs[0]
        arm, along = b.vector("SUBTRACT", position, mean(position)), mean(velocity)
        relative = b.vector("SUBTRACT", velocity, along)
        momentum = mean(b.vector("CROSS_PRODUCT", arm, relative))
        spin = self._spin(momentum, mean(b.vector("MULTIPLY", arm, arm)), mean(self._products(arm)))
        rigid = b.vector("CROSS_PRODUCT", spin, arm)
        inner = b.vector("SCALE", b.vector("SUBTRACT", relative, rigid), self._left("Damping", seconds))
        rest = b.vector("ADD", b.vector("SCALE", rigid, self._left("Spin Damping", seconds)), inner)
        return b.stored(cage, _VELOCITY, "FLOAT_VECTOR", b.vector("ADD", along, rest))

    def _left(self, name: str, seconds: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """The share of a velocity that a damping leaves after some time."""
        b = self.b
        return b.math("EXPONENT", b.math("MULTIPLY", b.math("MULTIPLY", self.given[name], seconds), -1.0))

    def _products(self, arm: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        """(xy, yz, zx) of a vector."""
        b = self.b
        x, y, z = b.add("ShaderNodeSeparateXYZ", {0: arm}).outputs
        turned = b.add("ShaderNodeCombineXYZ", {0: y, 1: z, 2: x}).outputs[0]
        return b.vector("MULTIPLY", arm, turned)

    def _spin(
        self, momentum: bpy.types.NodeSocket, squares: bpy.types.NodeSocket, products: bpy.types.NodeSocket
    ) -> bpy.types.NodeSocket:
        """The angular velocity that belongs to an angular momentum, by the inertia tensor."""
        b = self.b
        xx, yy, zz = b.add("ShaderNodeSeparateXYZ", {0: squares}).outputs
        xy, yz, zx = b.add("ShaderNodeSeparateXYZ", {0: b.vector("SCALE", products, -1.0)}).outputs
        columns = (
            (b.math("ADD", yy, zz), xy, zx),
            (xy, b.math("ADD", xx, zz), yz),
            (zx, yz, b.math("ADD", xx, yy)),
        )
        entries = {4 * j + i: value for j, column in enumerate(columns) for i, value in enumerate(column)}
        inertia = b.add("FunctionNodeCombineMatrix", entries).outputs[0]
        inverse = b.add("FunctionNodeInvertMatrix", {0: inertia}).outputs[0]
        return b.add("FunctionNodeTransformDirection", {0: momentum, 1: inverse}).outputs[0]
