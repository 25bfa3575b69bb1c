"""Reconstruct: run the engine and watch it."""

from __future__ import annotations

import bpy

from ..insideout_addon.engine.job import job_running
from .layout import SidebarPanel, duration, wrapped

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
        column.prop(settings, "import_when_done")
        if job_running():
            _draw_progress(layout, state, context)
        else:
            row = layout.row()
            row.scale_y = 1.3
            row.operator("insideout.reconstruct", icon="PLAY")
            if state.error:
                wrapped(layout.box(), state.error, context, "CANCEL")
            elif state.message:
                layout.label(text=f"{state.title}: {state.message.lower()}")
        for stage in state.stages:
            text = f"{stage.name.capitalize()}  {duration(stage.seconds)}" if stage.seconds else stage.name.capitalize()
            layout.label(text=text, icon=_STATE_ICONS.get(stage.state, "DOT"))
            if stage.reason:
                wrapped(layout, stage.reason, context, "BLANK1")


def _draw_progress(layout: bpy.types.UILayout, state: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    box = layout.box()
    what = " ".join(word for word in (state.stage.capitalize(), state.part) if word) or state.title
    box.progress(factor=state.fraction, text=f"{what}  {100 * state.fraction:.0f} %")
    details = []
    if state.seconds_left >= 0:
        details.append(f"{duration(state.seconds_left)} left in this stage")
    if state.iterations:
        details.append(f"iteration {state.iteration:,} of {state.iterations:,}")
    if state.splats:
        details.append(f"{state.splats:,} splats")
    if state.heldout_psnr:
        details.append(f"held-out PSNR {state.heldout_psnr:.1f} dB")
    if state.message:
        details.append(state.message)
    for text in details:
        wrapped(box, text, context)
    layout.operator("insideout.cancel", icon="X")


CLASSES = (INSIDEOUT_PT_reconstruct,)
