"""The running job, or how the last one ended, in the panel where the user asked for it."""

from __future__ import annotations

import bpy

from ..insideout_addon.engine.job import job_running
from ..insideout_addon.engine.progress_text import headline
from .layout import shortened, wrapped


def draw_job(layout: bpy.types.UILayout, context: bpy.types.Context, panel: str) -> None:
    """Progress with a button to cancel, or the outcome; nothing if another panel's button was pressed last."""
    state = context.window_manager.insideout
    if state.panel != panel:
        return
    if job_running():
        _draw_progress(layout, state)
    elif state.error:
        wrapped(layout.box(), shortened(state.error), context, "CANCEL")
    elif state.message:
        wrapped(layout, f"{state.title}: {state.message[0].lower()}{state.message[1:]}", context)


def _draw_progress(layout: bpy.types.UILayout, state: bpy.types.PropertyGroup) -> None:
    box = layout.box()
    box.progress(factor=state.fraction, text=headline(state))
    # One line, cut short by Blender where it is long.
    box.label(text=state.message)
    layout.operator("insideout.cancel", icon="X")
