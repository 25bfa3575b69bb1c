"""For scripts: a picture of things as they are shown now. By itself it does nothing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy
from mathutils import Vector

# From there the camera looks: from the front left, and from so far to the left that one sees between two halves.
FRONT_LEFT, LEFT = Vector((-0.5, -1.0, 0.45)).normalized(), Vector((-1.0, -0.5, 0.35)).normalized()
_SAMPLES = 16


def take_picture(
    things: Sequence[bpy.types.Object], path: Path, size: int, towards_camera: Vector = FRONT_LEFT
) -> None:
    """Renders with Cycles on a grey ground; camera, light and settings are as before afterwards.

    Args:
        things: all of them are in the picture.
        size: pixels along each side.
        towards_camera: (3,) direction from them, of length 1.
    """
    scene = bpy.context.scene
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    world = bpy.data.worlds.new("world")
    before = scene.camera, scene.world, scene.render.engine
    try:
        _aim(camera, things, towards_camera)
        sun.data.energy = 3.0
        sun.rotation_euler = Vector((0.4, 0.7, -1.0)).to_track_quat("-Z", "Y").to_euler()
        world.use_nodes = True
        world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.5, 0.5, 0.5, 1.0)
        for thing in (camera, sun):
            scene.collection.objects.link(thing)
        scene.camera, scene.world = camera, world
        _render(scene, path, size)
    finally:
        scene.camera, scene.world, scene.render.engine = before
        bpy.data.batch_remove([camera.data, sun.data, world])


def _aim(camera: bpy.types.Object, things: Sequence[bpy.types.Object], towards_camera: Vector) -> None:
    """So that all of them are seen, and room around them for parts that are pulled away."""
    corners = [thing.matrix_world @ Vector(corner) for thing in things for corner in thing.bound_box]
    middle = 0.5 * sum((Vector(map(end, *corners)) for end in (min, max)), Vector())
    radius = max((corner - middle).length for corner in corners)
    distance = 1.2 * radius / math.sin(0.5 * camera.data.angle)
    camera.data.clip_start, camera.data.clip_end = distance / 100, 10 * distance
    camera.location = middle + distance * towards_camera
    camera.rotation_euler = (-towards_camera).to_track_quat("-Z", "Y").to_euler()


def _render(scene: bpy.types.Scene, path: Path, size: int) -> None:
    render = scene.render
    render.engine = "CYCLES"
    wanted = [
        (scene.cycles, {"device": "CPU", "samples": _SAMPLES, "transparent_max_bounces": 64}),
        (render, {"resolution_x": size, "resolution_y": size, "filepath": str(path)}),
        (render.image_settings, {"file_format": "PNG"}),
    ]
    before = [(owner, {name: getattr(owner, name) for name in values}) for owner, values in wanted]
    try:
        _set(wanted)
        bpy.ops.render.render(write_still=True)
    finally:
        _set(before)


def _set(settings: Sequence[tuple[Any, dict[str, Any]]]) -> None:
    for owner, values in settings:
        for name, value in values.items():
            setattr(owner, name, value)
