"""Objects that drawings in the scene are made of."""

from __future__ import annotations

import math

import bpy
from mathutils import Matrix

from ..scene.linking import open_collection
from ..scene.node_tree import shader_builder, shared_material

_CASED, _CASING = "InsideOut Cased Line", "InsideOut Casing"
# White with black around it is in no colour map side by side, so it is read over any of them and over any photo.
_LIGHT, _DARK = (1.0, 1.0, 1.0, 1.0), (0.0, 0.0, 0.0, 1.0)
# How far what is light reaches from the middle of a cased line as it is seen, in parts of its radius.
_CORE = 0.42
# How far the casing of lettering reaches around it, in parts of its size.
_CASING_WIDTH = 0.09


def plain_object(
    name: str, data: bpy.types.ID | None, parent: bpy.types.Object, context: bpy.types.Context
) -> bpy.types.Object:
    """An object in its parent's frame that no light falls on and that throws no shadow."""
    thing = bpy.data.objects.new(name, data)
    open_collection(context).objects.link(thing)
    thing.parent = parent
    for ray in ("diffuse", "glossy", "transmission", "volume_scatter", "shadow"):
        setattr(thing, f"visible_{ray}", False)
    return thing


def cased_text(
    name: str, letters: bpy.types.TextCurve, parent: bpy.types.Object, frame: Matrix, context: bpy.types.Context
) -> bpy.types.Object:
    """Light lettering in a frame of its parent, with the same behind it in bolder, dark letters: what is under it may
    be of any colour. Neither can be selected."""
    letters.materials.append(_glowing(f"{_CASED} Text", _LIGHT))
    label = plain_object(f"{name} Text", letters, parent, context)
    label.matrix_local, label.hide_select = frame, True
    bolder = letters.copy()
    bolder.materials[0] = _glowing(_CASING, _DARK)
    bolder.bevel_depth = _CASING_WIDTH * letters.size
    casing = plain_object(f"{name} Casing", bolder, label, context)
    casing.hide_select = True
    # A bevel is as deep as it is wide.
    casing.location.z = -1.2 * bolder.bevel_depth
    return label


def cased_material() -> bpy.types.Material:
    """The shared material of lines over pictures, made on first use: light, with a dark rim on both sides.

    For curves with a round bevel. Which part of the tube is rim is told by where it is seen, not by how it is turned:
    for the normal n and the way to the viewer v, without its part along the line, |n·v| is 1 in the middle of what is
    seen and 0 at its edges.
    """

    def build(material: bpy.types.Material) -> None:
        tree = shader_builder(material)
        seen = tree.add("ShaderNodeNewGeometry").outputs
        # Blender lays u along a curve and v around it.
        along = tree.add("ShaderNodeTangent", direction_type="UV_MAP", uv_map="UVMap").outputs[0]
        lengthways = tree.vector("SCALE", along, tree.vector("DOT_PRODUCT", seen["Incoming"], along))
        across = tree.vector("NORMALIZE", tree.vector("SUBTRACT", seen["Incoming"], lengthways))
        facing = tree.math("ABSOLUTE", tree.vector("DOT_PRODUCT", seen["Normal"], across))
        core = tree.math("GREATER_THAN", facing, math.sqrt(1 - _CORE**2))
        glow = tree.add("ShaderNodeEmission", {"Color": _LIGHT, "Strength": core})
        tree.add("ShaderNodeOutputMaterial", {"Surface": glow.outputs[0]})
        material.diffuse_color = _LIGHT

    return shared_material(_CASED, __file__, build)


def _glowing(name: str, color: tuple[float, float, float, float]) -> bpy.types.Material:
    def build(material: bpy.types.Material) -> None:
        tree = shader_builder(material)
        glow = tree.add("ShaderNodeEmission", {"Color": color})
        tree.add("ShaderNodeOutputMaterial", {"Surface": glow.outputs[0]})
        material.diffuse_color = color

    return shared_material(name, __file__, build)


def vertex_color_material(name: str, attribute: str) -> bpy.types.Material:
    """The shared material that shows a colour attribute as it is, made on first use."""

    def build(material: bpy.types.Material) -> None:
        tree = shader_builder(material)
        own = tree.add("ShaderNodeAttribute", attribute_name=attribute, attribute_type="GEOMETRY")
        glow = tree.add("ShaderNodeEmission", {"Color": own.outputs["Color"]})
        tree.add("ShaderNodeOutputMaterial", {"Surface": glow.outputs[0]})

    return shared_material(name, __file__, build)
