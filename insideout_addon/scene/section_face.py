"""The face of a section plane: where it lies, and the image on it. Pictures beside it have such a face, too."""

from __future__ import annotations

import bpy
import numpy as np

from .node_tree import shader_builder
from .section import SIZE_KEY, shown_planes

NAME = "InsideOut Section"
# The picture floats this part of its size above the cut, so that it does not fight with the caps for depth.
_LIFT = 1.5e-3


def face_mesh(size: float) -> bpy.types.Mesh:
    """A square; see `shape_face`."""
    mesh = bpy.data.meshes.new(NAME)
    _fill(mesh, size, [_LIFT * size], 0.0)
    return mesh


def shape_face(plane: bpy.types.Object, flip: bool, apart: float = 0.0, beside: float = 0.0) -> None:
    """Puts the picture onto the cut face: on its visible side, or on both faces where they are apart.

    Args:
        apart: how far, in units of the plane's own frame.
        beside: how far to the right of the plane's middle, in the same unit.
    """
    size = float(plane[SIZE_KEY])
    lift = _LIFT * size * (-1 if flip else 1)
    half = 0.5 * apart * (-1 if flip else 1)
    heights = [lift - half, half - lift] if apart > 0 else [lift]
    found = [plane.data.vertices[corner].co for corner in range(0, len(plane.data.vertices), 4)]
    wanted = [(beside - 0.5 * size, -0.5 * size, height) for height in heights]
    if len(found) != len(wanted) or not np.allclose(found, wanted):
        _fill(plane.data, size, heights, beside)


def hide_from_light(plane: bpy.types.Object) -> None:
    """Lets a picture neither light the scene nor throw a shadow."""
    for ray in ("diffuse", "glossy", "transmission", "volume_scatter", "shadow"):
        setattr(plane, f"visible_{ray}", False)


def paint(plane: bpy.types.Object, rgba: np.ndarray, keep: bool = False) -> None:
    """Puts (height, width, 4) float32 colours on a plane's image.

    Args:
        keep: saves them in the .blend with it.
    """
    image = face_image(plane)
    if tuple(image.size) != rgba.shape[1::-1]:
        image.scale(rgba.shape[1], rgba.shape[0])
    image.pixels.foreach_set(np.ascontiguousarray(rgba[::-1]).ravel())
    image.update()
    if keep:
        image.pack()


def face_image(plane: bpy.types.Object) -> bpy.types.Image:
    """The image that the plane shows; made anew where the user has taken it away, or has copied the scene."""
    found = _found_image(plane)
    if found is not None and not any(_found_image(other) == found for other in _other_faces(plane)):
        return found
    image = bpy.data.images.new(NAME, 8, 8, alpha=True)
    plane.data.materials.clear()
    plane.data.materials.append(_image_material(image))
    return image


def _fill(mesh: bpy.types.Mesh, size: float, heights: list[float], beside: float) -> None:
    half = 0.5 * size
    materials = list(mesh.materials)
    mesh.clear_geometry()
    corners = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    places = [(beside + x * half, y * half, height) for height in heights for x, y in corners]
    mesh.from_pydata(places, [], [tuple(range(4 * k, 4 * k + 4)) for k in range(len(heights))])
    layer = mesh.uv_layers.get("UVMap") or mesh.uv_layers.new(name="UVMap")
    layer.data.foreach_set("uv", [0, 0, 1, 0, 1, 1, 0, 1] * len(heights))
    if not len(mesh.materials):
        for material in materials:
            mesh.materials.append(material)
    mesh.update()


def _found_image(plane: bpy.types.Object) -> bpy.types.Image | None:
    for material in plane.data.materials:
        for node in material.node_tree.nodes if material is not None and material.node_tree is not None else ():
            if node.bl_idname == "ShaderNodeTexImage" and node.image is not None:
                return node.image
    return None


def _other_faces(plane: bpy.types.Object) -> list[bpy.types.Object]:
    """All scenes' section planes and pictures beside them but those that share this one's mesh, and its picture too."""
    planes = [section.object for scene in bpy.data.scenes for section in shown_planes(scene)]
    faces = [face for one in planes for face in (one, *one.children) if SIZE_KEY in face and face.type == "MESH"]
    return [other for other in faces if other.data != plane.data]


def _image_material(image: bpy.types.Image) -> bpy.types.Material:
    """Shows the image as it is, whatever the light; air lets the view through."""
    material = bpy.data.materials.new(NAME)
    material.surface_render_method = "BLENDED"
    build = shader_builder(material)
    texture = build.add("ShaderNodeTexImage", image=image, interpolation="Linear", extension="CLIP")
    clear = build.add("ShaderNodeBsdfTransparent")
    glow = build.add("ShaderNodeEmission", {"Color": texture.outputs["Color"], "Strength": 1.0})
    mix = build.add("ShaderNodeMixShader", {0: texture.outputs["Alpha"], 1: clear.outputs[0], 2: glow.outputs[0]})
    build.add("ShaderNodeOutputMaterial", {"Surface": mix.outputs[0]})
    return material
