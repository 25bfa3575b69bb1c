"""The image on a section plane; pictures beside it have such a one, too."""

from __future__ import annotations

import bpy
import numpy as np

from .node_tree import shader_builder
from .section import SIZE_KEY, shown_sections

NAME = "InsideOut Section"


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


def _found_image(plane: bpy.types.Object) -> bpy.types.Image | None:
    for material in plane.data.materials:
        for node in material.node_tree.nodes if material is not None and material.node_tree is not None else ():
            if node.bl_idname == "ShaderNodeTexImage" and node.image is not None:
                return node.image
    return None


def _other_faces(plane: bpy.types.Object) -> list[bpy.types.Object]:
    """All scenes' section planes and other pictures but those that share this one's mesh, and its picture too."""
    things = [section.object for scene in bpy.data.scenes for section in shown_sections(scene)]
    faces = [face for one in things for face in (one, *one.children) if SIZE_KEY in face and face.type == "MESH"]
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
