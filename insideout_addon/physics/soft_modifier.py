"""Soft bodies by Blender's modifier, for a Blender without the XPBD solver's node (before 5.2).

The modifier knows one size of things: what it meets pushes with a force of 1 at its surface and of e⁵ one unit inside,
farther inside not at all, and a vertex has a mass of 0.01 or more. A cage in millimetres, or in metres, would fall
through floors. So a twin of it is simulated, out of sight, whose boxes are half a unit wide and whose masses are as
small as can be, among copies of the same size of what is in the way; and the cage takes its shape from the twin.
"""

from __future__ import annotations

import math

import bpy
import numpy as np

from ..scene.node_tree import InputRow, Sockets, TreeBuilder, row, set_modifier_input, shared_group
from .cage import Cage
from .motion import Motion
from .world import BODY_KEY, TWIN_KEY

GROUP, CONTACT_GROUP = "InsideOut Cage of Twin", "InsideOut Scaled Colliders"
# On the twin: frames a second when it was made. Blender's speed is told by the frame, and what is cached stays.
_RATE_KEY = "insideout_frames_per_s"
_BOX = 0.5
_LIGHTEST = 0.0105
# Blender's unit of time in a soft body: gravity is a thousandth of the scene's.
_UNITS_PER_S = math.sqrt(1000.0)
# Of a soft body, as Blender limits it.
_LOWEST_SPEED = 0.01
_STIFFEST, _STRONGEST_GRAVITY = 0.999, 200.0
_INSIDE, _OUTSIDE = 1.0, 0.1
# Steps a frame; and how far into what is in the way a vertex may come in one, in units.
_FEWEST, _MOST, _STEP = 20, 1000, 0.3
# Per cent of a vertex's speed that is lost in each step inside of what it has hit, and the share beside it.
_CHOKE, _BRAKE = 40, 0.2
_DAMPING = 0.05
_COPY_INPUTS: tuple[InputRow, ...] = (
    row("Geometry", "Geometry"),
    row("Twin", "Object", "The simulated cage"),
    ("Scale", "NodeSocketFloat", 1.0, None, None, "Of the twin"),
)
_CONTACT_INPUTS: tuple[InputRow, ...] = (
    row("Geometry", "Geometry"),
    row("Colliders", "Collection", "What a soft body falls onto and is touched by"),
    ("Origin", "NodeSocketVector", None, None, None, "Where the cage is"),
    ("Scale", "NodeSocketFloat", 1.0, None, None, "Of the twin"),
)


def add_soft_body(thing: bpy.types.Object, cage: Cage, motion: Motion, scene: bpy.types.Scene) -> None:
    """Lets an object whose mesh is a cage, each spring an edge, move by the modifier.

    Args:
        thing: not turned or scaled; at rest.
    """
    model = thing[BODY_KEY]
    scale = min(_BOX / (float(cage.sides.min()) * motion.units_per_mm), _STRONGEST_GRAVITY)
    twin = bpy.data.objects.new(f"{thing.name} Twin", thing.data.copy())
    contacts = bpy.data.objects.new(f"{thing.name} Contacts", bpy.data.meshes.new(f"{thing.name} Contacts"))
    around = bpy.data.collections.new(contacts.name)
    around[BODY_KEY] = model
    around.objects.link(contacts)
    for part in (twin, contacts):
        part[BODY_KEY], part[TWIN_KEY] = model, thing
        scene.collection.objects.link(part)
        # Not disabled: then nothing would collide. Copies are empty in renderings.
        part.hide_set(True)
        part.hide_select = True
    twin[_RATE_KEY] = _rate(scene)
    places = np.empty(3 * len(cage.vertices), np.float32)
    twin.data.vertices.foreach_get("co", places)
    twin.data.vertices.foreach_set("co", places * np.float32(scale))
    steps = _steps(cage, motion, scale)
    _add_contacts(contacts, thing, motion, scale)
    masses = cage.masses * (_LIGHTEST / cage.masses.min())
    frame = _UNITS_PER_S * motion.frame_s
    contacts.collision.damping = float(np.clip(_BRAKE * masses.min() * steps / (50 * frame), 1e-3, 1.0))
    _set_up(twin, cage, masses, motion, scale, steps, around)
    modifier = thing.modifiers.new(GROUP, "NODES")
    modifier.node_group = shared_group(GROUP, _COPY_INPUTS, _build_copy, modifier=True)
    set_modifier_input(modifier, "Twin", twin)
    set_modifier_input(modifier, "Scale", scale)


def slowest(frame_s: float) -> float:
    """How many times slower than in reality the modifier can be, where a frame is so long."""
    return _UNITS_PER_S * frame_s / _LOWEST_SPEED


def is_of_other_rate(thing: bpy.types.Object, scene: bpy.types.Scene) -> bool:
    """Whether the scene's frame rate has changed since a cage was made that the modifier simulates: it is as much
    slower, or faster, than in reality. Of older files it is not known."""
    rates = [twin[_RATE_KEY] for twin in _twins(thing) if _RATE_KEY in twin]
    return any(not math.isclose(rate, _rate(scene), rel_tol=1e-6) for rate in rates)


def soft_caches(thing: bpy.types.Object) -> list[bpy.types.PointCache]:
    """The caches of what simulates a cage; none where nodes do."""
    return [
        modifier.point_cache for twin in _twins(thing) for modifier in twin.modifiers if modifier.type == "SOFT_BODY"
    ]


def remove_twin(thing: bpy.types.Object) -> None:
    """Takes away what simulates a cage, if something does beside it."""
    for twin in _twins(thing):
        mesh, collections = twin.data, [each for each in twin.users_collection if BODY_KEY in each]
        bpy.data.objects.remove(twin)
        bpy.data.meshes.remove(mesh)
        for collection in collections:
            bpy.data.collections.remove(collection)


def _rate(scene: bpy.types.Scene) -> float:
    return scene.render.fps / scene.render.fps_base


def _twins(thing: bpy.types.Object) -> list[bpy.types.Object]:
    return [other for other in bpy.data.objects if other.get(TWIN_KEY) == thing]


def _steps(cage: Cage, motion: Motion, scale: float) -> int:
    """Steps a frame that are short enough for the stiffest spring, and for the fastest fall onto something."""
    crossing = motion.fastest_mm_s * motion.units_per_mm * scale / _STEP
    return math.ceil(np.clip(motion.frame_s * max(cage.frequency(), crossing), _FEWEST, _MOST))


def _set_up(
    twin: bpy.types.Object,
    cage: Cage,
    masses: np.ndarray,
    motion: Motion,
    scale: float,
    steps: int,
    around: bpy.types.Collection,
) -> None:
    modifier = twin.modifiers.new("Soft Body", "SOFT_BODY")
    cache = modifier.point_cache
    cache.frame_start, cache.frame_end = motion.first, motion.last
    body = modifier.settings
    body.use_goal, body.use_edges = False, True
    body.mass, body.vertex_group_mass = float(masses.max()), _weights(twin, "Mass", masses / masses.max())
    # Blender averages the weights of a spring's ends and takes the fourth power.
    stiffest = float(cage.stiffness.max())
    body.vertex_group_spring = _weights(twin, "Stiffness", (cage.stiffness / stiffest) ** 0.25)
    # Newton to Blender's force, for the twin's masses, lengths and time.
    force = stiffest * (masses.sum() / (1e-3 * cage.masses.sum())) * (1000 * motion.units_per_mm * scale) / 1000
    body.pull = body.push = min(1 - 1 / (1 + force), _STIFFEST)
    body.friction, body.damping = 0.0, _DAMPING
    body.speed = _UNITS_PER_S * motion.frame_s
    body.choke = _CHOKE
    body.step_min, body.step_max = steps, 2 * steps
    body.error_threshold = 0.05 * _BOX
    body.collision_collection = around
    # Fields of force are where the cage is, not the twin.
    body.effector_weights.all = 0.0
    body.effector_weights.gravity = scale


def _weights(twin: bpy.types.Object, name: str, values: np.ndarray) -> str:
    """A vertex group of values (V,) in 0..1."""
    group = twin.vertex_groups.new(name=name)
    for index, value in enumerate(values.tolist()):
        group.add([index], value, "REPLACE")
    return group.name


def _add_contacts(contacts: bpy.types.Object, thing: bpy.types.Object, motion: Motion, scale: float) -> None:
    modifier = contacts.modifiers.new(CONTACT_GROUP, "NODES")
    modifier.node_group = shared_group(CONTACT_GROUP, _CONTACT_INPUTS, _build_contacts, modifier=True)
    for name, value in {"Colliders": motion.colliders, "Origin": tuple(thing.location), "Scale": scale}.items():
        set_modifier_input(modifier, name, value)
    contacts.modifiers.new("Collision", "COLLISION")
    for modifier in contacts.modifiers:
        modifier.show_render = False
    contacts.collision.thickness_inner, contacts.collision.thickness_outer = _INSIDE, _OUTSIDE


def _build_copy(b: TreeBuilder, given: Sockets) -> list[bpy.types.NodeSocket]:
    info = b.add("GeometryNodeObjectInfo", {"Object": given["Twin"]}, transform_space="ORIGINAL")
    index = b.add("GeometryNodeInputIndex").outputs[0]
    position = b.add("GeometryNodeInputPosition").outputs[0]
    place = b.sampled(info.outputs["Geometry"], position, index, "FLOAT_VECTOR")
    true = b.vector("SCALE", place, b.math("DIVIDE", 1.0, given["Scale"]))
    return [b.add("GeometryNodeSetPosition", {"Geometry": given["Geometry"], "Position": true}).outputs[0]]


def _build_contacts(b: TreeBuilder, given: Sockets) -> list[bpy.types.NodeSocket]:
    info = b.add("GeometryNodeCollectionInfo", {"Collection": given["Colliders"]}, transform_space="ORIGINAL")
    real = b.add("GeometryNodeRealizeInstances", {"Geometry": info.outputs[0]}).outputs[0]
    position = b.add("GeometryNodeInputPosition").outputs[0]
    place = b.vector("SCALE", b.vector("SUBTRACT", position, given["Origin"]), given["Scale"])
    return [b.add("GeometryNodeSetPosition", {"Geometry": real, "Position": place}).outputs[0]]
