"""The model as a soft body: its splats follow a cage of springs with its measured masses."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from dataclasses import dataclass

import bpy
import numpy as np
from mathutils import Vector

from ...core.errors import MeshFileError, SettingError
from ...core.steps import part_of_work, run_through
from ..measure.marks import marks_on
from ..scene.following import follow, stay
from ..scene.following_nodes import CORNERS, RIGHT_ANGLE, follow_group
from ..scene.following_nodes import GROUP as FOLLOW_GROUP
from ..scene.hidden_for_now import hide_for_now
from ..scene.leftovers import remove_unused_looks
from ..scene.splats import read_density, require_own
from ..scene.standing import place_in_world
from ..scene.weighing import MASS_KEY
from .cage import Cage, cage_in_steps
from .hulls import splat_surface
from .masses import G_CM3_PER_MM_INV
from .motion import Motion
from .soft_modifier import CONTACT_GROUP, add_soft_body, remove_twin, slowest
from .soft_modifier import GROUP as TWIN_GROUP
from .soft_nodes import GROUP as SOLVER_GROUP
from .soft_nodes import add_solver, has_solver, soft_group
from .whole import masses_in_steps, read_model_mesh, require_size, require_whole, world_box
from .world import BODY_KEY, CAGE_KEY, adapt_gravity, is_floor, new_floor, units_per_mm

# On the collection of what a model falls onto.
_COLLIDERS_KEY = "insideout_colliders_of"
_GROUPS = (FOLLOW_GROUP, RIGHT_ANGLE, SOLVER_GROUP, TWIN_GROUP, CONTACT_GROUP)
_STARTED, _BUILT = 0.2, 0.8
_SLOWEST = 1000.0


@dataclass(frozen=True)
class SoftOptions:
    """How soft, and what it falls onto.

    Attributes:
        stiffness_kpa: Young's modulus of the model's typical material; denser is stiffer.
        resolution: boxes of the cage along the model's longest side.
        slow_motion: how many times slower than in reality.
        g_cm3_per_mm_inv: g/cm³ per mm⁻¹; what the model was weighed to be goes before.
        floor: add one, `drop_mm` below the model, if the scene has none.
    """

    stiffness_kpa: float = 20.0
    resolution: int = 8
    slow_motion: float = 1.0
    g_cm3_per_mm_inv: float = G_CM3_PER_MM_INV
    floor: bool = True
    drop_mm: float = 50.0


def make_soft(
    model: bpy.types.Object,
    context: bpy.types.Context,
    options: SoftOptions,
    tick: Callable[[float], None] | None = None,
) -> bpy.types.Object:
    """Gives a model a cage that falls, is touched and bends; the splats follow it with their shapes and densities.

    Args:
        tick: called with the share that is done; may raise to stop, and nothing is changed then.

    Returns:
        The cage.

    Raises:
        SettingError: the model has no mass or no size, is of another file, shares its splats, is a part of something
            already or has a body, the options are out of range, or there is no gravity and nothing to touch.
    """
    return run_through(make_soft_in_steps(model, context, options), tick)


def make_soft_in_steps(
    model: bpy.types.Object, context: bpy.types.Context, options: SoftOptions
) -> Generator[float, None, bpy.types.Object]:
    """As `make_soft`, with breaks that tell the share that is done; closed before its end it changes nothing."""
    scene = context.scene
    _check(model, scene, options)
    gaussians = read_density(model)
    masses = yield from part_of_work(masses_in_steps(model, gaussians, options.g_cm3_per_mm_inv), 0.0, _STARTED)
    try:
        surface = read_model_mesh(model).vertices
    except MeshFileError:
        surface = splat_surface(gaussians)
    yield _STARTED
    steps = cage_in_steps(gaussians, masses, surface, options.resolution, options.stiffness_kpa)
    cage = yield from part_of_work(steps, _STARTED, _BUILT)
    boxes, places = cage.locate(gaussians.means)
    yield _BUILT
    # First what another Blender may not be able to do: its solver by nodes is experimental.
    try:
        follow_group()
        if has_solver():
            soft_group()
    except BaseException:
        remove_unused_groups()
        raise
    thing = _create(model, cage)
    context.view_layer.update()
    if options.floor and not _colliders(scene):
        new_floor(model, scene, world_box(thing), options.drop_mm)
    adapt_gravity(scene)
    motion = _motion(model, thing, scene, options)
    if has_solver():
        add_solver(thing, cage, motion)
    else:
        add_soft_body(thing, cage, motion, scene)
    follow(model, thing, np.where(boxes < 0, -1, cage.cells[boxes, 0]), places, cage.sides)
    # Sections go on cutting the splats where they are; what was measured stays where they were.
    hide_for_now(marks_on(model))
    return thing


def release_soft(model: bpy.types.Object) -> None:
    """Lets the splats of a model go from its cage, which is one of `bodies_of`."""
    stay(model)
    for collection in [each for each in bpy.data.collections if each.get(_COLLIDERS_KEY) == model]:
        bpy.data.collections.remove(collection)


def deleted_colliders() -> list[tuple[bpy.types.Collection, bpy.types.Object]]:
    """(collection of a soft body's, what is in it) where the latter is in no other any more, and fallen onto there."""
    return [
        (collection, thing)
        for collection in bpy.data.collections
        if _COLLIDERS_KEY in collection and collection.is_editable
        for thing in collection.objects
        if thing.library is None and all(_COLLIDERS_KEY in one for one in thing.users_collection)
    ]


def end_simulation(thing: bpy.types.Object) -> None:
    """Takes the physics of a cage away, which stays as its mesh is."""
    thing.modifiers.clear()
    remove_twin(thing)
    remove_unused_groups()


def remove_unused_groups() -> None:
    """Takes away the node groups of soft bodies that nothing uses any more."""
    remove_unused_looks(set(), _GROUPS)


def _check(model: bpy.types.Object, scene: bpy.types.Scene, options: SoftOptions) -> None:
    require_own(model)
    require_own(model.data)
    require_whole(model, scene)
    require_size(model)
    count = model.data.users - model.data.use_fake_user
    if count > 1:
        raise SettingError(
            "{model}: {count} objects share its splats; make it a single user "
            "(Object > Relations > Make Single User > Object & Data) first.",
            model=model.name,
            count=count,
        )
    if model.parent is not None:
        raise SettingError(
            "{model} follows {parent}; clear its parent first.", model=model.name, parent=model.parent.name
        )
    if not 1.0 <= options.slow_motion <= _SLOWEST:
        raise SettingError(
            "{times:g} times slower cannot be; choose 1 to {most:g}.", times=options.slow_motion, most=_SLOWEST
        )
    most = _SLOWEST if has_solver() else slowest(scene.render.fps_base / scene.render.fps)
    if options.slow_motion > most:
        raise SettingError(
            "soft bodies of this Blender cannot be {times:g} times slower; choose 1 to {most}, or a Blender from 5.2 "
            "on.",
            times=options.slow_motion,
            most=math.floor(most),
        )
    if not scene.use_gravity and not _colliders(scene):
        raise SettingError(
            "the scene has no gravity and nothing to touch the model, so it would not bend; switch on Gravity in the "
            "scene's properties, or give something Physics > Collision."
        )


def _colliders(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """What soft bodies fall onto: floors and passive rigid bodies, and what has Physics > Collision."""
    return [
        thing
        for thing in scene.objects
        if thing.type == "MESH"
        and (is_floor(thing) or (BODY_KEY not in thing and any(m.type == "COLLISION" for m in thing.modifiers)))
    ]


def _create(model: bpy.types.Object, cage: Cage) -> bpy.types.Object:
    """The cage where the model is: vertices in Blender units about its centre of mass, springs as edges."""
    matrix = np.array(place_in_world(model), np.float64)
    center = matrix[:3, :3] @ (cage.masses @ cage.vertices / cage.masses.sum()) + matrix[:3, 3]
    mesh = bpy.data.meshes.new(f"{model.name} Cage")
    places = cage.vertices @ matrix[:3, :3].T + matrix[:3, 3] - center
    mesh.from_pydata(places.tolist(), cage.springs.tolist(), [])
    for k, name in enumerate(CORNERS, 1):
        number = np.zeros(len(places), np.int32)
        number[cage.cells[:, 0]] = cage.cells[:, k]
        mesh.attributes.new(name, "INT", "POINT").data.foreach_set("value", number)
    thing = bpy.data.objects.new(mesh.name, mesh)
    for collection in model.users_collection:
        collection.objects.link(thing)
    thing.location, thing.display_type, thing.hide_render = Vector(center), "WIRE", True
    thing[BODY_KEY], thing[CAGE_KEY], thing[MASS_KEY] = model, True, float(cage.masses.sum())
    return thing


def _motion(model: bpy.types.Object, thing: bpy.types.Object, scene: bpy.types.Scene, options: SoftOptions) -> Motion:
    colliders = bpy.data.collections.new(f"{model.name} Colliders")
    colliders[_COLLIDERS_KEY] = model
    for other in _colliders(scene):
        colliders.objects.link(other)
    gravity = tuple(scene.gravity) if scene.use_gravity else (0.0, 0.0, 0.0)
    unit = units_per_mm(scene)
    box = world_box(thing)
    deep = max(options.drop_mm, _farthest_below(scene, box, gravity) / unit)
    falling = math.hypot(*gravity) / unit * (deep + float((box[1] - box[0]).max()) / unit)
    return Motion(
        gravity=gravity,
        units_per_mm=unit,
        frame_s=scene.render.fps_base / scene.render.fps / options.slow_motion,
        slow_motion=options.slow_motion,
        fastest_mm_s=math.sqrt(2 * falling),
        colliders=colliders,
        first=scene.frame_start,
        last=scene.frame_end,
    )


def _farthest_below(scene: bpy.types.Scene, box: np.ndarray, gravity: tuple[float, float, float]) -> float:
    """How far a box (2, 3) can fall onto what is under it, Blender units: below a table there may be a floor."""
    graph, down = bpy.context.evaluated_depsgraph_get(), Vector(gravity).normalized()
    corners = [Vector((x, y, z)) for x in box[:, 0] for y in box[:, 1] for z in box[:, 2]]
    lowest = max(corner @ down for corner in corners)
    farthest = 0.0
    for shown in (other.evaluated_get(graph) for other in _colliders(scene)):
        if not shown.is_evaluated:
            # Not in the view layer.
            continue
        back = shown.matrix_world.inverted_safe()
        for start in (*corners, sum(corners, Vector()) / len(corners)):
            hit, place, *_ = shown.ray_cast(back @ start, back.to_3x3() @ down)
            if hit:
                farthest = max(farthest, (shown.matrix_world @ place) @ down - lowest)
    return farthest
