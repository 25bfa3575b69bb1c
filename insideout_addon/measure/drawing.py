"""Objects that drawings in the scene are made of."""

from __future__ import annotations

import bpy

from ..scene.node_tree import shader_builder, shared_material

_INK = "InsideOut Ink"
# Orange: between the viewport's dark grey and paper, and in no colour map of densities where it is dark.
_INK_COLOR = (1.0, 0.33, 0.02, 1.0)


def plain_object(
    name: str, data: bpy.types.ID | None, parent: bpy.types.Object, context: bpy.types.Context
) -> bpy.types.Object:
    """An object in its parent's frame that no light falls on and that throws no shadow."""
    thing = bpy.data.objects.new(name, data)
    context.collection.objects.link(thing)
    thing.parent = parent
    for ray in ("diffuse", "glossy", "transmission", "volume_scatter", "shadow"):
        setattr(thing, f"visible_{ray}", False)
    return thing


def ink_material() -> bpy.types.Material:
    """The shared material of lines and lettering, made on first use."""

    def build(material: bpy.types.Material) -> None:
        tree = shader_builder(material)
        glow = tree.add("ShaderNodeEmission", {"Color": _INK_COLOR})
        tree.add("ShaderNodeOutputMaterial", {"Surface": glow.outputs[0]})
        material.diffuse_color = _INK_COLOR

    return shared_material(_INK, __file__, build)


def vertex_color_material(name: str, attribute: str) -> bpy.types.Material:
    """The shared material that shows a colour attribute as it is, made on first use."""

    def build(material: bpy.types.Material) -> None:
        tree = shader_builder(material)
        own = tree.add("ShaderNodeAttribute", attribute_name=attribute, attribute_type="GEOMETRY")
        glow = tree.add("ShaderNodeEmission", {"Color": own.outputs["Color"]})
        tree.add("ShaderNodeOutputMaterial", {"Surface": glow.outputs[0]})

    return shared_material(name, __file__, build)
