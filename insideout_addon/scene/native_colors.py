"""The node group that colours splats of another importer, such as Blender 5.3's own: these have no `display_color`."""

from __future__ import annotations

import bpy

from ...core.spherical_harmonics import C0
from .node_tree import Sockets, TreeBuilder, row, shared_group
from .splats import DISPLAY_COLOR

# IEC 61966-2-1, as in `core.srgb`.
_TOE, _SLOPE, _OFFSET, _GAMMA = 0.04045, 12.92, 0.055, 2.4


def colored_group() -> bpy.types.NodeTree:
    """The shared node group, built on first use: gives splats the colours that materials show, where they have none."""
    return shared_group("InsideOut Splat Colors", [row("Geometry", "Geometry")], _build_colored)


def _build_colored(b: TreeBuilder, given: Sockets) -> list[bpy.types.NodeSocket]:
    """Colours of the constant harmonic, 0.5 + C0·f, made linear."""
    geometry = given["Geometry"]
    base = b.add("FunctionNodeSeparateColor", {0: b.attribute("radiance:base", "FLOAT_COLOR")}).outputs
    linear = _linear_group()
    channels = [
        b.group(linear, {"Value": b.math("MULTIPLY_ADD", base[name], C0, 0.5)})[0] for name in ("Red", "Green", "Blue")
    ]
    color = b.add("FunctionNodeCombineColor", {**dict(enumerate(channels)), "Alpha": base["Alpha"]}).outputs[0]
    colored = b.stored(geometry, DISPLAY_COLOR, "FLOAT_COLOR", color)
    return [b.switch(b.exists(geometry, DISPLAY_COLOR), colored, geometry)]


def _linear_group() -> bpy.types.NodeTree:
    """One channel of a display colour, limited to 0..1, as scene-linear light."""
    value = [("Value", "NodeSocketFloat")]
    return shared_group("InsideOut Linear Channel", [row("Value", "Float")], _build_linear, value)


def _build_linear(b: TreeBuilder, given: Sockets) -> list[bpy.types.NodeSocket]:
    shown = b.math("MINIMUM", b.math("MAXIMUM", given["Value"], 0.0), 1.0)
    curve = b.math("POWER", b.math("DIVIDE", b.math("ADD", shown, _OFFSET), 1.0 + _OFFSET), _GAMMA)
    toe = b.math("DIVIDE", shown, _SLOPE)
    above = b.math("GREATER_THAN", shown, _TOE)
    return [b.math("MULTIPLY_ADD", above, b.math("SUBTRACT", curve, toe), toe)]
