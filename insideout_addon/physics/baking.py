"""The motion of rigid bodies as keyframes: it plays and renders without physics."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import bpy

from ...core.errors import SettingError
from .world import BODY_KEY, bodies_of, release


def bake(
    scene: bpy.types.Scene, start: int, end: int, tick: Callable[[float], None] | None = None
) -> list[bpy.types.Object]:
    """Keyframes of what the physics of this add-on's bodies does from one frame to another.

    Their bodies are then gone, and the world with its cache if no other body is left. The scene stays at `start`.

    Args:
        start, end: frames, both with keys; the physics begins at `start`.
        tick: called with the share that is done; may raise to stop, and nothing is changed then.

    Returns:
        The objects that have keyframes now.

    Raises:
        SettingError: there is nothing to bake, or no frame after the first.
    """
    things = [thing for thing in bodies_of(scene) if thing.rigid_body is not None]
    moving = [thing for thing in things if thing.rigid_body.type == "ACTIVE"]
    if not moving:
        raise SettingError("nothing has a rigid body to bake; break the model, or make it rigid, first.")
    if end <= start:
        raise SettingError(f"frames {start} to {end} are none to bake; choose an end after the start.")
    cache = scene.rigidbody_world.point_cache
    before = (cache.frame_start, cache.frame_end, scene.frame_current)
    cache.frame_start, cache.frame_end = start, end
    places = []
    try:
        for frame in range(start, end + 1):
            scene.frame_set(frame)
            graph = bpy.context.evaluated_depsgraph_get()
            places.append([thing.evaluated_get(graph).matrix_world.copy() for thing in moving])
            if tick is not None:
                tick((frame - start + 1) / (end - start + 1))
    except BaseException:
        cache.frame_start, cache.frame_end = before[:2]
        scene.frame_set(before[2])
        raise
    # It may be a world of the user's, which stays.
    cache.frame_start, cache.frame_end = before[:2]
    release(things, scene)
    for index, thing in enumerate(moving):
        _write_keys(thing, start, [matrices[index] for matrices in places])
    scene.frame_set(start)
    return moving


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
    for curve in _curves(thing):
        for key in curve.keyframe_points:
            key.interpolation = "LINEAR"


def _curves(thing: bpy.types.Object) -> list:
    action = thing.animation_data.action
    if hasattr(action, "fcurves"):
        return list(action.fcurves)
    # Since Blender 5.0.
    return list(action.layers[0].strips[0].channelbags[0].fcurves)


def is_baked(thing: bpy.types.Object) -> bool:
    """Whether a piece or a body moves by keyframes."""
    return BODY_KEY in thing and thing.rigid_body is None and thing.animation_data is not None
