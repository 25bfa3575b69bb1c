"""Photos of an object by Cycles: a lens, soft lights, a shooting table; in a process of its own, without a window.

Runs inside Blender: `blender --background --factory-startup --python studio.py -- FOLDER`, or with the package bpy.
FOLDER holds scene.json and mesh.npz; photo after photo is written there as 0000.npy ..., (height, width, 3) uint8 sRGB.

scene.json:
    width, height, samples, seed; background: (3,) linear; table: height of the table in mm, or null for none;
    light: key, fill (directions), key_degrees (how wide the key light is), key_strength, fill_strength, sky_strength
    (radiance that each brings to a white matte level surface), glow (share of the table's light that comes from it);
    photos: a list of {poses: one or two camera-to-world matrices in OpenGL axes, mm; focal: pixels;
    aperture, focus: mm, or null}. With two poses the camera moves from the first to the second while the rows are
    read out from the top to the bottom.
mesh.npz: vertices (V, 3) mm, faces (F, 3), colors (V, 3) linear.
"""

import json
import os
import sys
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector

# Blender's lens works in metres; an object of about a metre keeps f-numbers and clipping in their usual range.
UNIT = 0.01
SENSOR_MM = 36.0
# The denoiser invents colours in the outermost pixels: so many more are rendered on each side, and cut off.
MARGIN = 8
TABLE_RADIUS = 60.0


def main(folder: Path) -> None:
    """Renders all photos of the scene in `folder`."""
    content = json.loads((folder / "scene.json").read_text(encoding="utf-8"))
    scene = _empty_scene(content)
    _add_object(scene, np.load(folder / "mesh.npz"))
    _add_lights(scene, content["light"])
    _add_background(scene, content)
    if content["table"] is not None:
        _add_table(scene, content)
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    starter = os.getppid()
    for index, photo in enumerate(content["photos"]):
        if os.getppid() != starter:
            # Whoever asked for the photos was killed.
            return
        scene.cycles.seed = (content["seed"] + index) % 2**31
        _place_camera(scene, camera, photo, content)
        pixels = _render(scene, folder / "photo.exr", content)
        with open(folder / "photo.tmp", "wb") as stream:
            np.save(stream, pixels)
        os.replace(folder / "photo.tmp", folder / f"{index:04d}.npy")


def _empty_scene(content: dict) -> bpy.types.Scene:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.preferences.addon_enable(module="cycles")
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.render.resolution_x, scene.render.resolution_y = (content[side] + 2 * MARGIN for side in ("width", "height"))
    scene.render.resolution_percentage = 100
    scene.render.use_persistent_data = True
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_mode = "RGB"
    scene.render.image_settings.color_depth = "32"
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.samples = content["samples"]
    cycles.use_adaptive_sampling = False
    cycles.max_bounces, cycles.caustics_reflective, cycles.caustics_refractive = 4, False, False
    cycles.pixel_filter_type, cycles.filter_width = "BLACKMAN_HARRIS", 1.5
    cycles.use_denoising = _can_denoise(cycles)
    return scene


def _can_denoise(cycles: bpy.types.PropertyGroup) -> bool:
    """Whether this build has Open Image Denoise, which is then chosen."""
    try:
        cycles.denoiser = "OPENIMAGEDENOISE"
    except TypeError:
        return False
    return True


def _add_object(scene: bpy.types.Scene, arrays: dict) -> None:
    vertices, faces = arrays["vertices"], arrays["faces"]
    mesh = bpy.data.meshes.new("object")
    mesh.vertices.add(len(vertices))
    mesh.vertices.foreach_set("co", (UNIT * vertices).astype(np.float32).ravel())
    mesh.loops.add(3 * len(faces))
    mesh.loops.foreach_set("vertex_index", faces.astype(np.int32).ravel())
    mesh.polygons.add(len(faces))
    mesh.polygons.foreach_set("loop_start", np.arange(0, 3 * len(faces), 3, dtype=np.int32))
    mesh.polygons.foreach_set("use_smooth", np.ones(len(faces), bool))
    mesh.update(calc_edges=True)
    colors = np.column_stack([arrays["colors"], np.ones(len(vertices))]).astype(np.float32)
    mesh.attributes.new("paint", "FLOAT_COLOR", "POINT").data.foreach_set("color", colors.ravel())
    material, nodes = _material("paint")
    surface = nodes.nodes.new("ShaderNodeBsdfPrincipled")
    surface.inputs["Roughness"].default_value = 0.55
    surface.inputs["Specular IOR Level"].default_value = 0.2
    paint = nodes.nodes.new("ShaderNodeAttribute")
    paint.attribute_name = "paint"
    nodes.links.new(paint.outputs["Color"], surface.inputs["Base Color"])
    nodes.links.new(surface.outputs[0], nodes.nodes["out"].inputs["Surface"])
    mesh.materials.append(material)
    scene.collection.objects.link(bpy.data.objects.new("object", mesh))


def _material(name: str) -> tuple:
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    material.node_tree.nodes.clear()
    material.node_tree.nodes.new("ShaderNodeOutputMaterial").name = "out"
    return material, material.node_tree


def _add_lights(scene: bpy.types.Scene, light: dict) -> None:
    """Suns: far enough away that the empty table is equally bright everywhere."""
    for name, degrees in (("key", light["key_degrees"]), ("fill", 60.0)):
        direction = Vector(light[name]).normalized()
        sun = bpy.data.lights.new(name, "SUN")
        sun.energy = np.pi * light[f"{name}_strength"] / direction.z
        sun.angle = np.radians(degrees)
        lamp = bpy.data.objects.new(name, sun)
        lamp.rotation_euler = direction.to_track_quat("Z", "Y").to_euler()
        scene.collection.objects.link(lamp)


def _add_background(scene: bpy.types.Scene, content: dict) -> None:
    """A sky of one brightness that the camera sees in the background's colour."""
    world = bpy.data.worlds.new("sky")
    scene.world = world
    world.use_nodes = True
    nodes = world.node_tree.nodes
    nodes.clear()
    sky, seen = nodes.new("ShaderNodeBackground"), nodes.new("ShaderNodeBackground")
    sky.inputs["Color"].default_value = (1, 1, 1, 1)
    sky.inputs["Strength"].default_value = content["light"]["sky_strength"]
    seen.inputs["Color"].default_value = (*content["background"], 1)
    path, mix, out = (nodes.new(f"ShaderNode{kind}") for kind in ("LightPath", "MixShader", "OutputWorld"))
    for output, target in (
        (path.outputs["Is Camera Ray"], mix.inputs[0]),
        (sky.outputs[0], mix.inputs[1]),
        (seen.outputs[0], mix.inputs[2]),
        (mix.outputs[0], out.inputs["Surface"]),
    ):
        world.node_tree.links.new(output, target)


def _add_table(scene: bpy.types.Scene, content: dict) -> None:
    """A matte round table without an edge in sight, partly lit from inside, as bright as the background."""
    mesh = bpy.data.meshes.new("table")
    around = np.linspace(0, 2 * np.pi, 128, endpoint=False)
    rim = [(TABLE_RADIUS * np.cos(a), TABLE_RADIUS * np.sin(a), UNIT * content["table"]) for a in around]
    mesh.from_pydata(rim, [], [range(len(rim))])
    light = content["light"]
    arriving = sum(light[f"{name}_strength"] for name in ("key", "fill", "sky"))
    material, nodes = _material("table")
    matte, glow, add = (nodes.nodes.new(f"ShaderNode{kind}") for kind in ("BsdfDiffuse", "Emission", "AddShader"))
    color = np.array(content["background"])
    matte.inputs["Color"].default_value = (*((1 - light["glow"]) * color / arriving), 1)
    glow.inputs["Color"].default_value = (*(light["glow"] * color), 1)
    nodes.links.new(matte.outputs[0], add.inputs[0])
    nodes.links.new(glow.outputs[0], add.inputs[1])
    nodes.links.new(add.outputs[0], nodes.nodes["out"].inputs["Surface"])
    mesh.materials.append(material)
    scene.collection.objects.link(bpy.data.objects.new("table", mesh))


def _place_camera(scene: bpy.types.Scene, camera: bpy.types.Object, photo: dict, content: dict) -> None:
    lens = camera.data
    lens.sensor_fit, lens.sensor_width = "HORIZONTAL", SENSOR_MM
    lens.lens = photo["focal"] * SENSOR_MM / (content["width"] + 2 * MARGIN)
    lens.clip_end = 1000.0
    lens.dof.use_dof = photo["aperture"] is not None
    if lens.dof.use_dof:
        lens.dof.focus_distance = UNIT * photo["focus"]
        # Cycles takes the lens in millimetres and the scene in metres: f-number = focal length / diameter.
        lens.dof.aperture_fstop = 1e-3 * lens.lens / (UNIT * photo["aperture"])
    poses = [_matrix(pose) for pose in photo["poses"]]
    camera.rotation_mode = "QUATERNION"
    camera.animation_data_clear()
    scene.frame_set(1)
    moving = len(poses) == 2
    scene.render.use_motion_blur = moving
    if moving:
        _move_camera(scene, camera, poses, None if photo["open"] else content["height"])
    else:
        camera.matrix_world = poses[0]


def _move_camera(scene: bpy.types.Scene, camera: bpy.types.Object, poses: list, height: int | None) -> None:
    """Row j of H is read at j / (H - 1) of the way; without a height all see all of the way. Cycles reads row i of all
    N, margins too, at (i + 1) / N of its shutter, which lasts from half a frame before the frame to half a frame after
    it."""
    scene.render.motion_blur_shutter, scene.render.motion_blur_position = 1.0, "CENTER"
    scene.cycles.rolling_shutter_type = "NONE" if height is None else "TOP"
    scene.cycles.rolling_shutter_duration = 0.0
    ends = (0.0, 1.0)
    if height is not None:
        rows = max(height - 1, 1)
        ends = -(MARGIN + 1) / rows, (height - 1 + MARGIN) / rows
    first, last = poses[0].to_quaternion(), poses[1].to_quaternion()
    last.make_compatible(first)
    for frame, share in zip((0.5, 1.5), ends, strict=True):
        camera.location = poses[0].translation.lerp(poses[1].translation, share)
        camera.rotation_quaternion = (first * (1 - share) + last * share).normalized()
        camera.keyframe_insert("location", frame=frame)
        camera.keyframe_insert("rotation_quaternion", frame=frame)
    for curve in _curves(camera):
        for key in curve.keyframe_points:
            key.interpolation = "LINEAR"


def _curves(camera: bpy.types.Object) -> list:
    action = camera.animation_data.action
    if hasattr(action, "fcurves"):
        return list(action.fcurves)
    return list(action.layers[0].strips[0].channelbags[0].fcurves)


def _matrix(pose: list) -> Matrix:
    matrix = Matrix(pose)
    matrix.translation *= UNIT
    return matrix


def _render(scene: bpy.types.Scene, path: Path, content: dict) -> np.ndarray:
    """(height, width, 3) uint8 sRGB: what arrives, with no tone curve."""
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name = "Non-Color"
    flat = np.empty(image.size[0] * image.size[1] * image.channels, np.float32)
    image.pixels.foreach_get(flat)
    linear = flat.reshape(image.size[1], image.size[0], -1)[::-1, :, :3]
    bpy.data.images.remove(image)
    linear = np.clip(linear[MARGIN:-MARGIN, MARGIN:-MARGIN], 0, 1)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)
    return np.round(255 * encoded).astype(np.uint8)


if __name__ == "__main__":
    main(Path(sys.argv[sys.argv.index("--") + 1]))
