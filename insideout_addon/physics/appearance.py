"""Materials of pieces: the colours of their surfaces, smooth outside, rough where they are broken."""

from __future__ import annotations

import bpy

from ..scene.node_tree import STAMP_KEY, shader_builder, shared_material
from .meshes import COLOR

_ROUGHNESS = {"Outside": 0.6, "Broken": 0.95}


def piece_materials() -> tuple[bpy.types.Material, bpy.types.Material]:
    """The materials of outside and of broken faces, made on first use."""
    return _material("Outside"), _material("Broken")


def remove_unused_materials() -> None:
    """Takes away those that no mesh has any more."""
    names = tuple(f"InsideOut {kind}" for kind in _ROUGHNESS)
    ours = [material for material in bpy.data.materials if STAMP_KEY in material and material.name.startswith(names)]
    bpy.data.batch_remove([material for material in ours if material.users == 0 and material.library is None])


def _material(kind: str) -> bpy.types.Material:
    def build(material: bpy.types.Material) -> None:
        tree = shader_builder(material)
        own = tree.add("ShaderNodeVertexColor", layer_name=COLOR)
        surface = tree.add("ShaderNodeBsdfPrincipled", {"Base Color": own.outputs["Color"]})
        surface.inputs["Roughness"].default_value = _ROUGHNESS[kind]
        surface.inputs["Specular IOR Level"].default_value = 0.2
        tree.add("ShaderNodeOutputMaterial", {"Surface": surface.outputs[0]})
        material.roughness = _ROUGHNESS[kind]

    return shared_material(f"InsideOut {kind}", __file__, build)
