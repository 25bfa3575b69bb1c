"""The motion of rigid and soft bodies as keyframes: it plays and renders without physics."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager

import bpy
import numpy as np
from mathutils import Matrix

from ...core.errors import SettingError
from ...core.steps import run_through
from .soft import end_simulation
from .soft_modifier import soft_caches
from .soft_nodes import restart
from .world import BODY_KEY, CAGE_KEY, bodies_of, give_gravity_back, is_simulated, release, simulated_in


def bake(scene: bpy.types.Scene, start: int, end: int) -> list[bpy.types.Object]:
    """All of `bake_in_steps` at once."""
    return run_through(bake_in_steps(scene, start, end))


def bake_in_steps(scene: bpy.types.Scene, start: int, end: int) -> Generator[float, None, list[bpy.types.Object]]:
    """Keyframes of what the physics of this add-on's bodies does from one frame to another; yields the share done.

    Rigid bodies get them for their places, the cages of soft ones a shape key for each frame. Their bodies are then
    gone, and the world with its cache if no other body is left. The scene stays at `start`. Closed before its end it
    changes nothing.

    Args:
        start, end: frames, both with keys; the physics begins at `start`.

    Returns:
        The objects that have keyframes now.

    Raises:
        SettingError: there is nothing to bake, no frame after the first, or no world that bodies fall in.
    """
    moving = simulated_in(scene)
    if not moving:
        raise SettingError("nothing has a body to bake; break the model, or make it rigid or soft, first.")
    if end <= start:
        raise SettingError(
            "frames {start} to {end} are none to bake; choose an end after the start.", start=start, end=end
        )
    if scene.rigidbody_world is None and any(thing.rigid_body is not None for thing in moving):
        raise SettingError(
            "the scene's rigid body world was removed, so nothing falls; press Back to Whole, then break the model, or "
            "make it rigid, again."
        )
    before, states = scene.frame_current, []
    try:
        with _physics_from(scene, moving, start, end):
            for frame in range(start, end + 1):
                scene.frame_set(frame)
                graph = bpy.context.evaluated_depsgraph_get()
                states.append([_state(thing.evaluated_get(graph)) for thing in moving])
                yield (frame - start + 1) / (end - start + 1)
    except BaseException:
        scene.frame_set(before)
        raise
    # First the keys: whatever may go wrong with the bodies, the motion is there.
    for index, thing in enumerate(moving):
        kept = [state[index] for state in states]
        if CAGE_KEY in thing:
            end_simulation(thing)
            _write_shapes(thing, start, kept)
        else:
            _write_keys(thing, start, kept)
    ours = dict.fromkeys([*moving, *bodies_of(scene)])
    release([thing for thing in ours if thing.rigid_body is not None], scene)
    give_gravity_back(scene)
    scene.frame_set(start)
    return moving


@contextmanager
def _physics_from(scene: bpy.types.Scene, moving: Sequence[bpy.types.Object], start: int, end: int) -> Iterator[None]:
    """Lets physics begin at a frame within the block, whatever was played before. A world of the user's stays, and its
    range of frames."""
    caches = [cache for thing in moving for cache in soft_caches(thing)]
    if any(thing.rigid_body is not None for thing in moving):
        caches.append(scene.rigidbody_world.point_cache)
    before = [(cache, cache.frame_start, cache.frame_end) for cache in caches]
    # What was played from the same frame on is what the user has seen.
    begun_elsewhere = [cache for cache in caches if cache.frame_start != start]
    # That of nodes.
    own = scene.use_custom_simulation_range, scene.simulation_frame_start, scene.simulation_frame_end
    scene.use_custom_simulation_range, scene.simulation_frame_start, scene.simulation_frame_end = True, start, end
    for cache in caches:
        cache.frame_start, cache.frame_end = start, end
    _forget(begun_elsewhere, moving)
    try:
        yield
    finally:
        for cache, first, last in before:
            cache.frame_start, cache.frame_end = first, last
        scene.use_custom_simulation_range, scene.simulation_frame_start, scene.simulation_frame_end = own
        _forget(begun_elsewhere, moving)


def _forget(caches: Sequence[bpy.types.PointCache], moving: Sequence[bpy.types.Object]) -> None:
    """Else Blender plays the frames that it has kept, wherever physics begins."""
    for cache in caches:
        # Set to anything, it outdates the cache.
        cache.frame_step = cache.frame_step
    for thing in moving:
        restart(thing)


def _state(thing: bpy.types.Object) -> Matrix | np.ndarray:
    """Where an evaluated body is in the frame that its location counts in, or the vertices (V, 3) of a cage in its own.

    Physics moves a body that the user has given a parent in the world.
    """
    if CAGE_KEY not in thing:
        if thing.parent is None:
            return thing.matrix_world.copy()
        return (thing.parent.matrix_world @ thing.matrix_parent_inverse).inverted_safe() @ thing.matrix_world
    places = np.empty(3 * len(thing.data.vertices), np.float32)
    thing.data.vertices.foreach_get("co", places)
    return places


def _write_shapes(cage: bpy.types.Object, start: int, states: Sequence[np.ndarray]) -> None:
    """A shape key for each frame, one after another in time, straight lines between."""
    for frame, places in enumerate(states, start):
        shape = cage.shape_key_add(name=f"Frame {frame}", from_mix=False)
        shape.interpolation = "KEY_LINEAR"
        shape.data.foreach_set("co", places)
    shapes = cage.data.shape_keys
    shapes.use_relative = False
    for frame, shape in ((start, shapes.key_blocks[0]), (start + len(states) - 1, shapes.key_blocks[-1])):
        shapes.eval_time = shape.frame
        shapes.keyframe_insert("eval_time", frame=frame)
    _make_linear(shapes)


def _write_keys(thing: bpy.types.Object, start: int, matrices: Sequence) -> None:
    """Location and rotation at each frame, straight lines between."""
    thing.rotation_mode = "QUATERNION"
    last = None
    for frame, matrix in enumerate(matrices, start):
        place, turn, _ = matrix.decompose()
        if last is not None:
            # The same rotation with the sign that is nearer: between two frames it does not go the long way round.
            turn.make_compatible(last)
        thing.location, thing.rotation_quaternion, last = place, turn, turn
        thing.keyframe_insert("location", frame=frame)
        thing.keyframe_insert("rotation_quaternion", frame=frame)
    _make_linear(thing)


def _make_linear(animated: bpy.types.Object | bpy.types.Key) -> None:
    """Straight lines between keyframes."""
    for curve in _curves(animated):
        for key in curve.keyframe_points:
            key.interpolation = "LINEAR"


def _curves(thing: bpy.types.Object | bpy.types.Key) -> list:
    action = thing.animation_data.action
    if hasattr(action, "fcurves"):
        return list(action.fcurves)
    # Since Blender 5.0.
    return list(action.layers[0].strips[0].channelbags[0].fcurves)


def is_baked(thing: bpy.types.Object) -> bool:
    """Whether a piece, a body or a cage moves by keyframes."""
    animated = thing.data.shape_keys if CAGE_KEY in thing else thing
    return (
        BODY_KEY in thing and not is_simulated(thing) and animated is not None and animated.animation_data is not None
    )
