"""What is asked where a model that was scaled is exported, or its scale made one of the splats."""

from __future__ import annotations

import bpy

from ..core.affine import Kept

KEPT_DENSITY = bpy.props.EnumProperty(
    name="Density",
    description="What stays the same if the object was scaled",
    items=(
        (Kept.MATERIAL.name, "Material", "As sections show it: a larger object of the same material"),
        (Kept.LINE_INTEGRALS.name, "Line Integrals", "What the X-rays measured: the scale corrects a wrong size"),
    ),
)
