"""Objects that drawings in the scene are made of."""

from __future__ import annotations

import math
from collections.abc import Sequence

import bpy
from mathutils import Matrix

from ..scene.linking import open_collection
from ..scene.node_tree import shader_builder, shared_material

_CASED, _CASING = "InsideOut Cased Line", "InsideOut Casing"
# On what is drawn below another object: with that it goes, and what a user has parented there stays.
_PART_KEY = "insideout_part"
# Older files know those by how their names begin.
_PART_NAMES = ("InsideOut Measure Text", "InsideOut Measure Casing", "InsideOut Thickness Legend")
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


def add_part(
    name: str, data: bpy.types.ID, parent: bpy.types.Object, frame: Matrix, context: bpy.types.Context
) -> bpy.types.Object:
    """A part of what is drawn, in a frame of its parent; it cannot be selected."""
    part = plain_object(name, data, parent, context)
    part.matrix_local, part.hide_select = frame, True
    part[_PART_KEY] = True
    return part


def parts_of(drawn: bpy.types.Object) -> list[bpy.types.Object]:
    """What was drawn below an object, and nothing that a user has parented there."""
    own = [child for child in drawn.children if _PART_KEY in child or child.name.startswith(_PART_NAMES)]
    return [*own, *(part for child in own for part in parts_of(child))]


def remove_drawn(things: Sequence[bpy.types.Object], heir: bpy.types.Object) -> None:
    """Deletes what was drawn, with what nothing else uses of it; what a user has parented to it stays where it is.

    Args:
        heir: gets that; in its frame are those of the things that are not parts of others.
    """
    for thing in things:
        for child in thing.children:
            if child not in things:
                _hand_over(child, thing, things, heir)
    data = {thing.data for thing in things} - {None}
    bpy.data.batch_remove(things)
    bpy.data.batch_remove([each for each in data if each.users == 0 and each.library is None])


def _hand_over(
    child: bpy.types.Object, parent: bpy.types.Object, gone: Sequence[bpy.types.Object], heir: bpy.types.Object
) -> None:
    if child.parent_type != "OBJECT":
        # On vertices, which the heir does not have.
        place = child.matrix_world.copy()
        child.parent = None
        child.matrix_world = place
        return
    frame = place_in_parent(parent)
    while parent.parent in gone:
        parent = parent.parent
        frame = place_in_parent(parent) @ frame
    inverse = frame @ child.matrix_parent_inverse
    child.parent = heir
    child.matrix_parent_inverse = inverse


def place_in_parent(thing: bpy.types.Object) -> Matrix:
    """Where an object is in its parent's frame, also where Blender has not worked it out since it was changed."""
    return thing.matrix_parent_inverse @ thing.matrix_basis


def cased_text(
    name: str, letters: bpy.types.TextCurve, parent: bpy.types.Object, frame: Matrix, context: bpy.types.Context
) -> bpy.types.Object:
    """Light lettering in a frame of its parent, with the same behind it in bolder, dark letters: what is under it may
    be of any colour. Neither can be selected."""
    letters.materials.append(_glowing(f"{_CASED} Text", _LIGHT))
    label = add_part(f"{name} Text", letters, parent, frame, context)
    bolder = letters.copy()
    bolder.materials[0] = _glowing(_CASING, _DARK)
    bolder.bevel_depth = _CASING_WIDTH * letters.size
    # A bevel is as deep as it is wide.
    behind = Matrix.Translation((0.0, 0.0, -1.2 * bolder.bevel_depth))
    add_part(f"{name} Casing", bolder, label, behind, context)
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
