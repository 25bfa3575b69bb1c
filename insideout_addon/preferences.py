"""Preferences of the add-on: which Python runs the engine."""

from __future__ import annotations

import bpy

from .engine.environment import PACKAGE
from .remembered import forget


class InsideOutPreferences(bpy.types.AddonPreferences):
    """Shown in Preferences > Add-ons > InsideOut."""

    bl_idname = PACKAGE

    engine_python: bpy.props.StringProperty(
        name="Engine Python",
        description="A Python 3.11 in which the package insideout is installed; empty: found or made by itself",
        subtype="FILE_PATH",
        update=lambda preferences, context: forget(),
    )

    def draw(self, context: bpy.types.Context) -> None:
        self.layout.prop(self, "engine_python")


CLASSES = (InsideOutPreferences,)
