"""Blender's rigid body world at the scale of a model: gravity, steps, a floor; and all of it gone again.

Measured with Bullet at one unit a millimetre: with 20 steps a frame a ball falls g·t²/2 to 0.5 %, and a slab of 80 mm
lands without sinking in. Bodies whose object is scaled fall through floors, so lengths go into the meshes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import bpy
import numpy as np

BODY_KEY = "insideout_body_of"
# On a piece, its number.
PIECE_KEY = "insideout_piece"
# On the cage of a soft body.
CAGE_KEY = "insideout_cage"
# On a cage's twin and the copies of what is in its way: the cage.
TWIN_KEY = "insideout_twin_of"
# On a duplicate of a body, once it was told from it: it goes on in the world that was made for that.
_COPY_KEY = "insideout_copy_of_body"
# On a scene: that its world was made for ours; its gravity before ours, and ours.
_OWN_WORLD, _OLD_GRAVITY, _OWN_GRAVITY = "insideout_world", "insideout_gravity", "insideout_own_gravity"
_STEPS, _ITERATIONS = 20, 20
_DEFAULT_GRAVITY = (0.0, 0.0, -9.81)
_MARGIN_MM = 0.04
# Slower bodies may fall asleep: mm/s, and radians/s.
_SLOW_MM, _SLOW_TURN = 5.0, 0.2
_FLOOR, _FLOOR_KEY = "InsideOut Floor", "insideout_floor"


def units_per_mm(scene: bpy.types.Scene) -> float:
    """Blender units in a millimetre; without a system of units a unit is one."""
    units = scene.unit_settings
    return 1.0 if units.system == "NONE" else 0.001 / units.scale_length


def blender_mass(grams: float, scene: bpy.types.Scene) -> float:
    """What a rigid body's mass is set to, so that Blender's sidebar shows these grams.

    Blender counts kilograms where a unit is a metre, and scales a mass like a volume with the scene's unit. Only
    where a unit is as large as a metre the least mass that it knows, a gram, is one that pieces fall below.
    """
    return 1e-3 * grams * (1000 * units_per_mm(scene)) ** 3


def prepare_world(scene: bpy.types.Scene) -> bpy.types.RigidBodyWorld:
    """The scene's rigid body world, made if there is none; Blender's default gravity becomes that of the earth at the
    scene's scale."""
    world = scene.rigidbody_world
    if world is None:
        with bpy.context.temp_override(scene=scene):
            bpy.ops.rigidbody.world_add()
        world = scene.rigidbody_world
        scene[_OWN_WORLD] = True
        world.substeps_per_frame, world.solver_iterations = _STEPS, _ITERATIONS
        # What overlaps a little at the start is pushed apart without being thrown.
        world.use_split_impulse = True
        world.point_cache.frame_start, world.point_cache.frame_end = scene.frame_start, scene.frame_end
    if world.collection is None:
        world.collection = bpy.data.collections.new("RigidBodyWorld")
    adapt_gravity(scene)
    return world


def adapt_gravity(scene: bpy.types.Scene) -> None:
    """Makes Blender's default gravity that of the earth at the scene's scale; one of the user's stays."""
    if _OLD_GRAVITY not in scene and np.allclose(scene.gravity, _DEFAULT_GRAVITY, atol=1e-4):
        scene[_OLD_GRAVITY] = list(scene.gravity)
        scene.gravity = [g * 1000 * units_per_mm(scene) for g in scene.gravity]
        scene[_OWN_GRAVITY] = list(scene.gravity)


def give_gravity_back(scene: bpy.types.Scene) -> None:
    """Undoes `adapt_gravity` where nothing moves by physics of this add-on any more; one that the user has set since
    stays."""
    if _OLD_GRAVITY in scene and not simulated_in(scene):
        # Files of before do not say which was ours.
        if np.allclose(scene.gravity, scene.get(_OWN_GRAVITY, scene.gravity)):
            scene.gravity = list(scene[_OLD_GRAVITY])
        for key in (_OLD_GRAVITY, _OWN_GRAVITY):
            scene.pop(key, None)


def is_left_over(scene: bpy.types.Scene) -> bool:
    """Whether a scene is still set up for physics of this add-on, of which nothing is left: all was deleted by hand."""
    # Of a body whose model was deleted, too.
    if simulated_in(scene) or any(BODY_KEY in thing and is_simulated(thing) for thing in scene.objects):
        return False
    world = scene.rigidbody_world
    own = _OWN_WORLD in scene and world is not None and not _bodies_in(world)
    return own or _OLD_GRAVITY in scene


def make_body(thing: bpy.types.Object, model: bpy.types.Object, scene: bpy.types.Scene, grams: float) -> None:
    """Makes an object, whose origin is its centre of mass, an active rigid body of the shape of its convex hull.

    A mesh as it is would take Bullet a hundred times as long, and makes it less steady.

    Args:
        model: that it is, or is a part of.
    """
    body = _add(thing, model, scene)
    body.type, body.collision_shape, body.mass = "ACTIVE", "CONVEX_HULL", blender_mass(grams, scene)
    body.friction, body.restitution = 0.6, 0.1
    # Stands for the rolling friction that Bullet does not have here.
    body.angular_damping = 0.3
    body.use_deactivation = True
    body.deactivate_linear_velocity = _SLOW_MM * units_per_mm(scene)
    body.deactivate_angular_velocity = _SLOW_TURN


def let_pass(a: bpy.types.Object, b: bpy.types.Object, model: bpy.types.Object, scene: bpy.types.Scene) -> None:
    """Two bodies do not collide with each other: solids in each other, whose convex shapes would burst apart.

    Blender has a constraint for that, on an empty of its own.
    """
    world = prepare_world(scene)
    if world.constraints is None:
        world.constraints = bpy.data.collections.new("RigidBodyConstraints")
    empty = bpy.data.objects.new(f"{a.name} in {b.name}", None)
    empty[BODY_KEY], empty.empty_display_size, empty.hide_viewport = model, 0.1, True
    for collection in a.users_collection:
        if collection != world.collection:
            collection.objects.link(empty)
    world.constraints.objects.link(empty)
    constraint = empty.rigid_body_constraint
    # Generic without limits: nothing but what collides.
    constraint.type, constraint.object1, constraint.object2 = "GENERIC", a, b
    constraint.disable_collisions = True


def add_floor(model: bpy.types.Object, scene: bpy.types.Scene, box: np.ndarray, drop_mm: float) -> None:
    """A floor for rigid bodies below a box (2, 3) in Blender units, unless the scene has something to fall onto."""
    world = prepare_world(scene)
    if any(map(is_floor, world.collection.objects)):
        return
    floor = next((thing for thing in bodies_of(scene) if is_floor(thing)), None) or new_floor(
        model, scene, box, drop_mm
    )
    body = _add(floor, floor[BODY_KEY], scene)
    # Not BOX: Blender lays its middle on the object's origin, which is the top of the slab.
    body.type, body.collision_shape, body.friction = "PASSIVE", "CONVEX_HULL", 0.6


def new_floor(model: bpy.types.Object, scene: bpy.types.Scene, box: np.ndarray, drop_mm: float) -> bpy.types.Object:
    """A slab below a box (2, 3) in Blender units; nothing falls onto it yet."""
    extent = float((box[1] - box[0]).max())
    half, depth = 8 * extent, 0.5 * extent
    corners = [(x, y, z) for z in (-depth, 0.0) for y in (-half, half) for x in (-half, half)]
    mesh = bpy.data.meshes.new(_FLOOR)
    mesh.from_pydata(corners, [], [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)])
    floor = bpy.data.objects.new(_FLOOR, mesh)
    scene.collection.objects.link(floor)
    middle = box.mean(axis=0)
    floor.location = (middle[0], middle[1], box[0, 2] - drop_mm * units_per_mm(scene))
    floor[BODY_KEY], floor[_FLOOR_KEY] = model, True
    return floor


def is_floor(thing: bpy.types.Object) -> bool:
    """Whether bodies fall onto an object."""
    return _FLOOR_KEY in thing or (thing.rigid_body is not None and thing.rigid_body.type == "PASSIVE")


def is_simulated(thing: bpy.types.Object) -> bool:
    """Whether a body, or the cage of a soft one, moves by physics and not by keyframes."""
    return (thing.rigid_body is not None and not is_floor(thing)) or (CAGE_KEY in thing and len(thing.modifiers) > 0)


def leave_floor(model: bpy.types.Object, scene: bpy.types.Scene) -> None:
    """Hands a model's floor over to another model that may lie on it, if there is one."""
    # Those whose motion is baked lie on it, too.
    others = [thing[BODY_KEY] for thing in bodies_of(scene) if not is_floor(thing) and thing[BODY_KEY] != model]
    # A body that the user lets hold still is no floor of this add-on's, and goes with its model.
    for floor in (thing for thing in bodies_of(scene, model) if _FLOOR_KEY in thing):
        if others:
            floor[BODY_KEY] = others[0]


def bodies_of(scene: bpy.types.Scene, model: bpy.types.Object | None = None) -> list[bpy.types.Object]:
    """What this add-on has made for the physics of one model or of all: bodies and cages, baked or not, and floors."""
    first = _originals()
    return [thing for thing in scene.objects if thing in first and model in (None, thing[BODY_KEY])]


def simulated_in(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """What moves by physics that this add-on has set up: bodies, cages, and what the user has duplicated of them."""
    return [
        thing
        for thing in scene.objects
        if (thing.get(BODY_KEY) is not None or _COPY_KEY in thing) and is_simulated(thing)
    ]


def free_copies() -> None:
    """Takes their keys from duplicates of bodies, pieces and cages, which are the user's: in a file that is opened
    nothing tells which of two was first."""
    first = _originals()
    for thing in _keyed():
        if thing not in first and thing.is_editable:
            for key in (BODY_KEY, PIECE_KEY, CAGE_KEY, _FLOOR_KEY):
                thing.pop(key, None)
            thing[_COPY_KEY] = True


def _keyed() -> list[bpy.types.Object]:
    return [
        thing
        for thing in bpy.data.objects
        if thing.get(BODY_KEY) is not None and thing.type != "EMPTY" and thing.users_scene
    ]


def _originals() -> set[bpy.types.Object]:
    """Of all scenes. What the user has duplicated has the keys of what it is a copy of, and was made after it."""
    first: dict[tuple[object, ...], bpy.types.Object] = {}
    for thing in sorted(_keyed(), key=lambda thing: thing.session_uid):
        first.setdefault(_role(thing), thing)
    return set(first.values())


def _role(thing: bpy.types.Object) -> tuple[object, ...]:
    if TWIN_KEY in thing:
        # A cage has several, and nobody sees them to duplicate them.
        return (thing,)
    return thing[BODY_KEY], thing.get(PIECE_KEY), CAGE_KEY in thing, _FLOOR_KEY in thing


def release(things: Sequence[bpy.types.Object], scene: bpy.types.Scene) -> None:
    """Takes the bodies of objects away; gravity and the world, if it was made for them, go with the last of them.

    A world with bodies of the user's stays; gravity is what it was before.
    """
    world = scene.rigidbody_world
    if world is None:
        # Removed by the user, who may add one of their own.
        scene.pop(_OWN_WORLD, None)
        return
    for empty in list(world.constraints.objects) if world.constraints is not None else ():
        constraint = empty.rigid_body_constraint
        pair = set() if constraint is None else {constraint.object1, constraint.object2}
        # Of a body that was deleted by hand there is None.
        if BODY_KEY in empty and pair & {None, *things}:
            bpy.data.objects.remove(empty)
    for thing in things:
        if world.collection is not None and world.collection.objects.get(thing.name) == thing:
            if set(thing.users_collection) == {world.collection}:
                # One of the user's, where the model is, too.
                scene.collection.objects.link(thing)
            world.collection.objects.unlink(thing)
        if thing.rigid_body is not None:
            with _as_active(thing, scene):
                bpy.ops.rigidbody.object_remove()
    left = _bodies_in(world)
    if any(thing.get(BODY_KEY) is not None or _COPY_KEY in thing for thing in left):
        return
    if scene.get(_OWN_WORLD) and not left:
        world = scene.rigidbody_world
        collections = [world.collection, world.constraints]
        with bpy.context.temp_override(scene=scene):
            bpy.ops.rigidbody.world_remove()
        for collection in collections:
            if collection is not None and not collection.objects:
                bpy.data.collections.remove(collection)
        del scene[_OWN_WORLD]
    give_gravity_back(scene)


def _bodies_in(world: bpy.types.RigidBodyWorld) -> list[bpy.types.Object]:
    return [] if world.collection is None else [thing for thing in world.collection.objects if thing.rigid_body]


def _add(thing: bpy.types.Object, model: bpy.types.Object, scene: bpy.types.Scene) -> bpy.types.RigidBodyObject:
    world = prepare_world(scene)
    thing[BODY_KEY] = model
    # Blender gives what comes into this collection a body; the user may have chosen one that the object is in already.
    if world.collection not in thing.users_collection:
        world.collection.objects.link(thing)
    if thing.rigid_body is None:
        with _as_active(thing, scene):
            bpy.ops.rigidbody.object_add()
    body = thing.rigid_body
    body.use_margin, body.collision_margin = True, min(_MARGIN_MM * units_per_mm(scene), 1.0)
    return body


@contextmanager
def _as_active(thing: bpy.types.Object, scene: bpy.types.Scene) -> Iterator[None]:
    """Operators in the block are about an object; one that is disabled in viewports, which Blender refuses, too."""
    disabled = thing.hide_viewport
    if disabled:
        thing.hide_viewport = False
    try:
        with bpy.context.temp_override(scene=scene, object=thing, active_object=thing):
            yield
    finally:
        if disabled:
            thing.hide_viewport = True
