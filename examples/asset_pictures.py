"""Renders the pictures that the asset browser shows of InsideOut's node groups and materials.

python examples/asset_pictures.py -- --out insideout_addon/assets/pictures
"""

from __future__ import annotations

import argparse
import importlib
import math
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import bpy
import numpy as np
from mathutils import Matrix, Vector

sys.path.insert(0, str(Path(__file__).resolve().parent))
from load_insideout import folder_for_files, open_empty_file, run_script, script_arguments

_SIZE, _SAMPLES = 192, 64
_TOWARDS_CAMERA = Vector((-0.55, -1.0, 0.55)).normalized()
# Of a box whose near corner shows, and of a plane that is seen at a slant.
_BOX = Matrix.Translation((0.75, 0.7, -0.75))
_PLANE = Vector((-0.1, -0.5, 0.9)).to_track_quat("Z", "Y").to_matrix().to_4x4()


def main(package: ModuleType) -> int:
    parser = argparse.ArgumentParser(prog="asset_pictures.py", description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder of the pictures, a folder in it for each kind")
    out = folder_for_files(parser.parse_args(script_arguments()).out)
    scenes = _Scenes(package)
    for asset in importlib.import_module(f"{package.__name__}.insideout_addon.assets.library").ASSETS:
        open_empty_file()
        _stage()
        scenes.of(asset)()
        picture = out / asset.picture.parent.name / asset.picture.name
        bpy.context.scene.render.filepath = str(picture)
        bpy.ops.render.render(write_still=True)
        print(f"Saved {picture}")
    return 0


class _Scenes:
    """What each picture shows, about a unit in radius, around the origin."""

    def __init__(self, package: ModuleType) -> None:
        def module(name: str) -> ModuleType:
            return importlib.import_module(f"{package.__name__}.{name}")

        self.core, self.splats = module("core.gaussians"), module("insideout_addon.scene.splats")
        self.display, self.nodes = module("insideout_addon.scene.display"), module("insideout_addon.scene.node_tree")
        self.cutting, self.harmonics = module("insideout_addon.scene.cutting"), module("core.spherical_harmonics")

    def of(self, asset: object) -> Callable[[], None]:
        """What makes the scene of an asset."""
        scenes = {
            "node_groups/splats": lambda: self._show(self._ball()),
            "node_groups/section_cut": lambda: self._cut(self._ball(), "PLANE"),
            "node_groups/cut_splats": lambda: self._cut(self._one(), "PLANE"),
            "node_groups/clipped_splats": lambda: self._cut(self._one(), "BOX"),
            "node_groups/splat_colors": lambda: self._show(self._ball(hollow=True, size=0.05), ellipsoids=False),
            "materials/splats": lambda: self._show(self._ball(hollow=True), ellipsoids=False),
            "materials/solid_splats": lambda: self._show(self._ball(hollow=True)),
            "materials/soft_splats": lambda: self._show(self._ball(hollow=True), Soft=True),
            "materials/outside": lambda: _mesh_ball(asset.build()),
            "materials/broken": lambda: _mesh_ball(asset.build(), rough=True),
        }
        return scenes[f"{asset.picture.parent.name}/{asset.picture.stem}"]

    def _ball(self, hollow: bool = False, size: float = 0.09) -> bpy.types.Object:
        """A ball of splats, coloured by where they are."""
        rng = np.random.default_rng(0)
        directions = rng.normal(size=(2600, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        radius = np.full(len(directions), 0.9) if hollow else 0.95 * np.cbrt(rng.uniform(size=len(directions)))
        return self._create(directions * radius[:, None], size * rng.uniform(0.4, 1.0, directions.shape))

    def _one(self) -> bpy.types.Object:
        return self._create(np.zeros((1, 3)), np.array([[0.62, 0.42, 0.5]]))

    def _create(self, means: np.ndarray, scales: np.ndarray) -> bpy.types.Object:
        quats = np.random.default_rng(1).normal(size=(len(means), 4)) if len(means) > 1 else [[0.95, 0.1, 0.2, 0.2]]
        colors = np.clip(0.5 + 0.45 * means[:, [2, 0, 1]] * (1, 0.8, -1), 0.05, 1.0)
        sh = self.harmonics.rgb_to_sh(colors)[:, None] if len(means) > 1 else [[[0.9, 0.1, -0.9]]]
        gaussians = self.core.GaussianSet.create(means, scales, quats=quats, sh=sh, opacities=0.95)
        return self.splats.create_splats(gaussians, "splats", bpy.context)

    def _show(self, splats: bpy.types.Object, ellipsoids: bool = True, Soft: bool = False, **inputs: object) -> None:
        modifier = self.display.show_splats(splats, ellipsoids)
        for name, value in {"Soft": Soft, "Detail": 4, **inputs}.items():
            self.nodes.set_modifier_input(modifier, name, value)

    def _cut(self, splats: bpy.types.Object, shape: str) -> None:
        """The half, or the corner, that the camera looks at taken away."""
        thing = bpy.data.objects.new("section", None)
        bpy.context.collection.objects.link(thing)
        box = shape == "BOX"
        thing.matrix_world = _BOX if box else _PLANE
        bpy.context.view_layer.update()
        modifier = splats.modifiers.new("cut", "NODES")
        modifier.node_group = self.cutting.cut_group()
        for name, value in {"Section": thing, "Box": box, "Flip": False, "Slot": 0}.items():
            self.nodes.set_modifier_input(modifier, name, value)
        self._show(splats, Cut=True)


def _mesh_ball(material: bpy.types.Material, rough: bool = False) -> None:
    bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=5, radius=0.95)
    mesh = bpy.context.object.data
    places = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", places)
    places = places.reshape(-1, 3)
    shade = 0.5 + 0.4 * places[:, [2, 0, 1]] * (1, 0.8, -1)
    if rough:
        rings = 0.5 + 0.5 * np.cos(16 * np.linalg.norm(places[:, [0, 2]], axis=1))
        shade = rings[:, None] * (0.85, 0.4, 0.15) + (0.1, 0.05, 0.15)
    colors = np.column_stack([np.clip(shade, 0, 1), np.ones(len(shade))]).astype(np.float32)
    mesh.attributes.new("Color", "FLOAT_COLOR", "POINT").data.foreach_set("color", colors.ravel())
    mesh.polygons.foreach_set("use_smooth", [not rough] * len(mesh.polygons))
    mesh.materials.append(material)


def _stage() -> None:
    """Camera, light and Cycles."""
    scene = bpy.context.scene
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.data.lens = 85.0
    camera.location = 6.0 * _TOWARDS_CAMERA
    camera.rotation_euler = (-_TOWARDS_CAMERA).to_track_quat("-Z", "Y").to_euler()
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.energy, sun.data.angle = 3.0, math.radians(15)
    sun.rotation_euler = Vector((0.4, 0.7, -1.0)).to_track_quat("-Z", "Y").to_euler()
    for thing in (camera, sun):
        scene.collection.objects.link(thing)
    scene.camera = camera
    scene.world = bpy.data.worlds.new("world")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.5, 0.5, 0.5, 1.0)
    scene.view_settings.view_transform = "Standard"
    scene.render.engine, scene.cycles.device, scene.cycles.samples = "CYCLES", "CPU", _SAMPLES
    scene.cycles.use_denoising, scene.cycles.transparent_max_bounces = False, 64
    scene.render.film_transparent = True
    scene.render.resolution_x = scene.render.resolution_y = _SIZE
    scene.render.image_settings.file_format, scene.render.image_settings.color_mode = "PNG", "RGBA"


if __name__ == "__main__":
    run_script(main)
