"""Engine: which Python runs it."""

from __future__ import annotations

import bpy

from ..insideout_addon.engine.environment import PACKAGE, locate_engine
from .layout import SidebarPanel, wrapped


class INSIDEOUT_PT_engine(SidebarPanel, bpy.types.Panel):
    bl_label = "Engine"
    bl_idname = "INSIDEOUT_PT_engine"
    bl_order = 0
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw_header_preset(self, context: bpy.types.Context) -> None:
        self.layout.label(text="", icon="CHECKMARK" if locate_engine() else "ERROR")

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        engine = locate_engine()
        if engine is None:
            wrapped(layout, "No engine yet. It needs a Python 3.11 of its own with torch.", context, "ERROR")
        else:
            wrapped(layout, f"{engine.python}", context, "CHECKMARK")
            layout.label(text=f"From: {engine.source}")
            version = context.window_manager.insideout.engine_version
            if version:
                wrapped(layout, version, context)
            layout.operator("insideout.engine_check")
        row = layout.row()
        row.operator("insideout.engine_setup", icon="IMPORT")
        if not bpy.app.online_access:
            wrapped(layout, "Making it downloads packages: allow online access in Preferences > System.", context)
        layout.operator("preferences.addon_show", text="Set Path in Preferences").module = PACKAGE


CLASSES = (INSIDEOUT_PT_engine,)
