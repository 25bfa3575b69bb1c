"""What Blender puts into each new file: a cube of two units, and a camera and a light made for it."""

from __future__ import annotations

import math
from itertools import product

import bpy
import numpy as np
from mathutils import Matrix, Vector

_CAMERA = Vector((7.358891, -6.925791, 4.958309))
_LIGHT = Vector((4.076245, 1.005454, 5.903862))
_CUBE_RADIUS = math.sqrt(3.0)
_CORNERS = sorted(product((-1.0, 1.0), repeat=3))


def is_startup_cube(thing: bpy.types.Object) -> bool:
    """Whether it is the cube, left as it came."""
    same = thing.type == "MESH" and thing.name == "Cube" and thing.matrix_world == Matrix.Identity(4)
    if not same or thing.modifiers or {material.name for material in thing.data.materials if material} - {"Material"}:
        return False
    # In Edit Mode the mesh is as it was before.
    thing.update_from_editmode()
    return sorted(tuple(vertex.co) for vertex in thing.data.vertices) == _CORNERS


def adapt_startup(scene: bpy.types.Scene, view_layer: bpy.types.ViewLayer, box: np.ndarray) -> None:
    """Hides the cube, which would stand in the model, and lets camera and light see a box (2, 3) as they saw it.

    What the user has moved stays.
    """
    center, radius = Vector(box.mean(axis=0)), 0.5 * float(np.linalg.norm(box[1] - box[0]))
    larger = radius / _CUBE_RADIUS
    for thing in scene.objects:
        if is_startup_cube(thing) and view_layer.objects.get(thing.name) == thing:
            thing.hide_render = True
            thing.hide_set(True, view_layer=view_layer)
        elif thing.type == "CAMERA" and (thing.location - _CAMERA).length < 1e-3:
            thing.location = center + larger * _CAMERA
            thing.data.clip_end = max(thing.data.clip_end, 40 * radius)
        elif thing.type == "LIGHT" and (thing.location - _LIGHT).length < 1e-3:
            thing.location = center + larger * _LIGHT
            # A sun is as bright from anywhere.
            if thing.data.type != "SUN":
                thing.data.energy *= larger**2
