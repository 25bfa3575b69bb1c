"""Materials of pieces: the colours of their surfaces, smooth outside, rough where they are broken."""

from __future__ import annotations

import bpy

from ..scene.node_tree import shader_builder
from .meshes import COLOR

_ROUGHNESS = {"Outside": 0.6, "Broken": 0.95}


def piece_materials() -> tuple[bpy.types.Material, bpy.types.Material]:
    """The materials of outside and of broken faces, made on first use."""
    return _material("Outside"), _material("Broken")


def remove_unused_materials() -> None:
    """Takes away those that no mesh has any more."""
    for kind in _ROUGHNESS:
        material = bpy.data.materials.get(_name(kind))
        if material is not None and material.users == 0:
            bpy.data.materials.remove(material)


def _material(kind: str) -> bpy.types.Material:
    material = bpy.data.materials.get(_name(kind))
    if material is not None:
        return material
    material = bpy.data.materials.new(_name(kind))
    build = shader_builder(material)
    own = build.add("ShaderNodeVertexColor", layer_name=COLOR)
    surface = build.add("ShaderNodeBsdfPrincipled", {"Base Color": own.outputs["Color"]})
    surface.inputs["Roughness"].default_value = _ROUGHNESS[kind]
    surface.inputs["Specular IOR Level"].default_value = 0.2
    build.add("ShaderNodeOutputMaterial", {"Surface": surface.outputs[0]})
    material.roughness = _ROUGHNESS[kind]
    return material


def _name(kind: str) -> str:
    return f"InsideOut {kind}"
