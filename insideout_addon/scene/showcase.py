"""A scene that shows a run at its best: cut half way open if it has an inside, softly lit, on a plain backdrop."""

from __future__ import annotations

import math
from pathlib import Path

import bpy
import numpy as np
from mathutils import Vector

from .color_bar import set_ink
from .importing import find_set, import_splats
from .paths import free_path
from .section import turned_box
from .sections import add_section_plane
from .splats import read_density, shows_density

# Seen from the left of the cut, so that the outside shows beside the cut face.
_AZIMUTH, _ELEVATION = math.radians(-50.0), math.radians(16.0)
_BACKDROP = (0.80, 0.79, 0.77)


def build_showcase(
    run: Path,
    context: bpy.types.Context,
    which: str = "fused",
    display: str = "ELLIPSOIDS",
    view_dependent: bool = False,
) -> bpy.types.Object:
    """Imports a run's splats, adds the section plane half way in, a camera, light and a backdrop.

    A model of photos alone stays whole: it has no density to show.

    Args:
        which, display, view_dependent: as the scene's settings of these names.

    Returns:
        The splats.

    Raises:
        GaussianFileError: the run holds no such splats.
    """
    run = Path(run)
    splats = import_splats(find_set(run, which), f"InsideOut {which}", context, display, view_dependent)
    cut = shows_density(splats)
    if cut:
        add_section_plane(splats, context)
        set_ink(0.02)
    box = turned_box(read_density(splats), splats.matrix_world.to_quaternion())
    scene = context.scene
    scene.camera = _camera(box, context, beside=0.11 if cut else 0.0)
    _lights(box, context)
    _backdrop(box, context)
    _world(scene)
    _viewports(box)
    return splats


def render_settings(scene: bpy.types.Scene, size: int, samples: int) -> None:
    """Cycles on the CPU at `size` x `size` pixels, denoised, colours as photographed."""
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples = samples
    scene.cycles.use_denoising = True
    scene.cycles.use_adaptive_sampling = True
    scene.cycles.adaptive_threshold = 0.1
    scene.cycles.max_bounces = 3
    scene.cycles.transparent_max_bounces = 192
    scene.render.resolution_x = scene.render.resolution_y = size
    scene.render.resolution_percentage = 100
    scene.render.image_settings.file_format = "PNG"


def save_blend(scene: bpy.types.Scene, path: Path, run: Path) -> Path:
    """Saves the .blend with paths relative to it, so that the folder can be moved.

    Returns:
        Where: `path`, or beside it under a free name, for a .blend that is there may hold somebody's work.
    """
    path = free_path(Path(path).resolve())
    path.parent.mkdir(parents=True, exist_ok=True)
    # Saving makes it relative: see `sources`.
    scene.insideout.run = str(Path(run).resolve())
    bpy.ops.wm.save_as_mainfile(filepath=str(path), compress=True)
    return path


def _camera(box: np.ndarray, context: bpy.types.Context, beside: float) -> bpy.types.Object:
    """Sees the box; `beside` is how much farther right it looks, in parts of the box."""
    data = bpy.data.cameras.new("InsideOut Camera")
    data.lens = 85.0
    camera = bpy.data.objects.new("InsideOut Camera", data)
    context.collection.objects.link(camera)
    extent = box[1] - box[0]
    radius = 0.5 * float(np.linalg.norm(extent))
    distance = 0.97 * radius / math.sin(0.5 * data.angle)
    data.clip_start, data.clip_end = distance / 100, distance * 20
    towards = Vector(
        (
            math.sin(_AZIMUTH) * math.cos(_ELEVATION),
            -math.cos(_AZIMUTH) * math.cos(_ELEVATION),
            math.sin(_ELEVATION),
        )
    )
    # The colour bar stands to the right of the cut; a little to the right is the middle of both.
    middle = Vector(box.mean(axis=0)) + Vector((beside * float(extent.max()), 0.0, -0.02 * float(extent[2])))
    camera.location = middle + distance * towards
    camera.rotation_euler = (-towards).to_track_quat("-Z", "Y").to_euler()
    return camera


def _lights(box: np.ndarray, context: bpy.types.Context) -> None:
    middle = Vector(box.mean(axis=0))
    size = float(np.linalg.norm(box[1] - box[0]))
    # Direction from the model, area, power a square of the size: key, fill, rim.
    for name, direction, spread, power in (
        ("Key", (-0.9, -1.3, 1.5), 1.2, 23.0),
        ("Fill", (1.6, -1.0, 0.6), 1.6, 8.0),
        ("Rim", (0.4, 1.5, 1.4), 1.0, 18.0),
    ):
        data = bpy.data.lights.new(f"InsideOut {name}", "AREA")
        data.shape, data.size, data.energy = "DISK", spread * size, power * size**2
        light = bpy.data.objects.new(data.name, data)
        context.collection.objects.link(light)
        offset = Vector(direction).normalized() * 1.8 * size
        light.location = middle + offset
        light.rotation_euler = (-offset).to_track_quat("-Z", "Y").to_euler()


def _backdrop(box: np.ndarray, context: bpy.types.Context) -> None:
    """A floor that turns up into a wall without an edge."""
    size = float(np.linalg.norm(box[1] - box[0]))
    middle, floor = box.mean(axis=0), float(box[0, 2])
    bend, depth, side = 1.5 * size, 2.6 * size, 12 * size
    profile = [(-10 * size, 0.0), (depth - bend, 0.0)]
    for angle in np.linspace(0, math.pi / 2, 24)[1:]:
        profile.append((depth - bend + bend * math.sin(angle), bend * (1 - math.cos(angle))))
    profile.append((depth, 10 * size))
    vertices = [(middle[0] + x, middle[1] + y, floor + z) for y, z in profile for x in (-side, side)]
    faces = [(2 * i, 2 * i + 1, 2 * i + 3, 2 * i + 2) for i in range(len(profile) - 1)]
    mesh = bpy.data.meshes.new("InsideOut Backdrop")
    mesh.from_pydata(vertices, [], faces)
    mesh.polygons.foreach_set("use_smooth", [True] * len(faces))
    material = bpy.data.materials.new("InsideOut Backdrop")
    material.use_nodes = True
    surface = material.node_tree.nodes["Principled BSDF"]
    surface.inputs["Base Color"].default_value = (*_BACKDROP, 1.0)
    surface.inputs["Roughness"].default_value = 0.9
    mesh.materials.append(material)
    backdrop = bpy.data.objects.new("InsideOut Backdrop", mesh)
    backdrop.hide_select = True
    context.collection.objects.link(backdrop)


def _world(scene: bpy.types.Scene) -> None:
    world = bpy.data.worlds.new("InsideOut World")
    world.use_nodes = True
    background = world.node_tree.nodes["Background"]
    background.inputs["Color"].default_value = (0.95, 0.97, 1.0, 1.0)
    background.inputs["Strength"].default_value = 0.35
    scene.world = world


def _viewports(box: np.ndarray) -> None:
    """The saved file opens through the camera, in colour."""
    extent = float(np.linalg.norm(box[1] - box[0]))
    for screen in bpy.data.screens:
        for area in screen.areas:
            if area.type == "VIEW_3D":
                space = area.spaces.active
                space.shading.type = "MATERIAL"
                space.clip_start, space.clip_end = extent / 500, max(space.clip_end, 50 * extent)
                space.show_region_ui = True
                space.region_3d.view_perspective = "CAMERA"
