"""Engine: which Python runs it."""

from __future__ import annotations

import bpy
from bpy.app.translations import pgettext_iface as iface_
from bpy.app.translations import pgettext_n as n_

from ..core.errors import SettingError
from ..insideout_addon.engine.environment import PACKAGE, EngineLocation, locate_engine
from ..insideout_addon.error_text import error_text
from ..insideout_addon.remembered import remembered
from .job import draw_job
from .layout import SidebarPanel, wrapped


class INSIDEOUT_PT_engine(SidebarPanel, bpy.types.Panel):
    bl_label = "Engine"
    bl_idname = "INSIDEOUT_PT_engine"
    bl_order = 0
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw_header_preset(self, context: bpy.types.Context) -> None:
        self.layout.label(text="", icon="CHECKMARK" if isinstance(_located(), EngineLocation) else "ERROR")

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        engine = _located()
        if isinstance(engine, str):
            wrapped(layout, engine, context, "ERROR")
        else:
            wrapped(layout, str(engine.python), context, "CHECKMARK")
            layout.label(text=iface_("From: {place}").format(place=iface_(engine.source)), translate=False)
            if engine.outdated:
                wrapped(layout, "It is of another version of InsideOut; make it again.", context, "ERROR")
            version = context.window_manager.insideout.engine_version
            if version:
                wrapped(layout, version, context)
            layout.operator("insideout.engine_check")
        layout.operator("insideout.engine_setup", icon="IMPORT")
        if not bpy.app.online_access:
            wrapped(layout, "Making it downloads packages: allow online access in Preferences > System.", context)
        layout.operator("preferences.addon_show", text="Set Path in Preferences").module = PACKAGE
        draw_job(layout, context, "engine")


@remembered
def _located() -> EngineLocation | str:
    """The engine, or why there is none."""
    try:
        return locate_engine() or n_(
            "No engine yet: models can be opened, not made. Press Make Environment, or set its path."
        )
    except SettingError as error:
        return error_text(error)


CLASSES = (INSIDEOUT_PT_engine,)
