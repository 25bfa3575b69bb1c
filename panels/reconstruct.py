"""Reconstruct: run the engine and watch it."""

from __future__ import annotations

import bpy

from ..insideout_addon.engine.job import job_running
from ..insideout_addon.engine.progress_text import duration
from .job import draw_job
from .layout import SidebarPanel, wrapped

_STATE_ICONS = {"done": "CHECKMARK", "started": "PLAY", "skipped": "REMOVE"}


class INSIDEOUT_PT_reconstruct(SidebarPanel, bpy.types.Panel):
    bl_label = "Reconstruct"
    bl_idname = "INSIDEOUT_PT_reconstruct"
    bl_order = 2

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.layout, context.scene.insideout
        state = context.window_manager.insideout
        column = layout.column()
        column.use_property_split = True
        column.use_property_decorate = False
        column.enabled = not job_running()
        column.prop(settings, "preset")
        column.prop(settings, "stage")
        column.prop(settings, "run", text="Save to")
        column.prop(settings, "start_over")
        column.prop(settings, "import_when_done")
        if not (job_running() and state.panel == "reconstruct"):
            row = layout.row()
            row.scale_y = 1.3
            row.operator("insideout.reconstruct", icon="PLAY")
        draw_job(layout, context, "reconstruct")
        for stage in state.stages:
            text = f"{stage.name.capitalize()}  {duration(stage.seconds)}" if stage.seconds else stage.name.capitalize()
            layout.label(text=text, icon=_STATE_ICONS.get(stage.state, "DOT"))
            if stage.reason:
                wrapped(layout, stage.reason, context, "BLANK1")


CLASSES = (INSIDEOUT_PT_reconstruct,)
