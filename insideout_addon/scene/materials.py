"""Materials of splats: their own colour, partly lit so that shape reads."""

from __future__ import annotations

import math

import bpy

from .node_tree import TreeBuilder, shader_builder, shared_material
from .splats import DISPLAY_COLOR

# Half axes, in standard deviations, of the ellipsoids that soft splats are drawn in, where they are made to end.
SOFT_SIZE = 2.4
# Photos carry the light they were taken in; full shading on top would light the object twice.
_SHADING, _SOFT_SHADING = 0.55, 0.35


def splat_material(kind: str) -> bpy.types.Material:
    """The shared material, made on first use.

    Args:
        kind: "Splats" (colours of the geometry itself), "Solid Splats" or "Soft Splats" (colours of instances).
    """

    def build(material: bpy.types.Material) -> None:
        tree = shader_builder(material)
        if kind == "Soft Splats":
            _build_soft(tree)
        else:
            _build_solid(tree, "GEOMETRY" if kind == "Splats" else "INSTANCER")
        material.diffuse_color = (0.75, 0.72, 0.68, 1.0)
        material.roughness = 0.6

    return shared_material(f"InsideOut {kind}", __file__, build)


def _build_solid(build: TreeBuilder, source: str) -> None:
    own = build.add("ShaderNodeAttribute", attribute_name=DISPLAY_COLOR, attribute_type=source)
    build.add("ShaderNodeOutputMaterial", {"Surface": _colored(build, own.outputs["Color"], _SHADING)})


def _build_soft(build: TreeBuilder) -> None:
    """Opacity as in 3D Gaussian splatting: peak opacity · exp(-½ m²), m the ray's least Mahalanobis distance.

    Object coordinates of an instance are those of the unit ball; where the ray enters does not matter. A ray is let
    through or stopped at random, as likely as the opacity says: on average the same as blending, and it ends at
    the first splat that stops it instead of going through all behind.
    """
    own = build.add("ShaderNodeAttribute", attribute_name=DISPLAY_COLOR, attribute_type="INSTANCER")
    place = build.add("ShaderNodeTexCoord").outputs["Object"]
    geometry = build.add("ShaderNodeNewGeometry")
    ray = build.add(
        "ShaderNodeVectorTransform",
        {0: geometry.outputs["Incoming"]},
        vector_type="VECTOR",
        convert_from="WORLD",
        convert_to="OBJECT",
    ).outputs[0]
    along = build.vector("DOT_PRODUCT", place, ray)
    nearest = build.math(
        "SUBTRACT",
        build.vector("DOT_PRODUCT", place, place),
        build.math("DIVIDE", build.math("MULTIPLY", along, along), build.vector("DOT_PRODUCT", ray, ray)),
    )
    falloff = build.math("EXPONENT", build.math("MULTIPLY", nearest, -0.5 * SOFT_SIZE**2))
    front = build.math("SUBTRACT", 1.0, geometry.outputs["Backfacing"])
    rim = math.exp(-0.5 * SOFT_SIZE**2)
    profile = build.math("DIVIDE", build.math("SUBTRACT", falloff, rim), 1.0 - rim)
    opacity = build.math("MULTIPLY", build.math("MULTIPLY", own.outputs["Alpha"], profile), front)
    chance = build.add(
        "ShaderNodeTexWhiteNoise", {0: build.vector("SCALE", geometry.outputs["Position"], 997.0)}
    ).outputs[0]
    alpha = build.math("LESS_THAN", chance, opacity)
    clear = build.add("ShaderNodeBsdfTransparent").outputs[0]
    mixed = build.add(
        "ShaderNodeMixShader", {0: alpha, 1: clear, 2: _colored(build, own.outputs["Color"], _SOFT_SHADING)}
    )
    build.add("ShaderNodeOutputMaterial", {"Surface": mixed.outputs[0]})


def _colored(build: TreeBuilder, color: bpy.types.NodeSocket, shading: float) -> bpy.types.NodeSocket:
    lit = build.add("ShaderNodeBsdfDiffuse", {"Color": color, "Roughness": 0.5})
    own = build.add("ShaderNodeEmission", {"Color": color, "Strength": 1.0})
    mix = build.add("ShaderNodeMixShader", {0: shading, 1: own.outputs[0], 2: lit.outputs[0]}, label="Unlit to lit")
    return mix.outputs[0]
