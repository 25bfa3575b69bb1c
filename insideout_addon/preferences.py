"""Preferences of the add-on: which Python runs the engine; and its assets."""

from __future__ import annotations

import bpy

from .engine.commands import forget_version
from .engine.environment import PACKAGE
from .remembered import forget


def _on_engine_changed(preferences: bpy.types.AddonPreferences, context: bpy.types.Context) -> None:
    forget()
    forget_version()


class InsideOutPreferences(bpy.types.AddonPreferences):
    """Shown in Preferences > Add-ons > InsideOut."""

    bl_idname = PACKAGE

    engine_python: bpy.props.StringProperty(
        name="Engine Python",
        description=(
            "A Python 3.11 in which the package insideout is installed; "
            "empty: the one that Make Environment made, or found"
        ),
        subtype="FILE_PATH",
        update=_on_engine_changed,
    )

    def draw(self, context: bpy.types.Context) -> None:
        self.layout.prop(self, "engine_python")
        self.layout.operator("insideout.assets_save", icon="ASSET_MANAGER")


CLASSES = (InsideOutPreferences,)
