"""The running job, or how the last one ended, in the panel where the user asked for it."""

from __future__ import annotations

import bpy
from bpy.app.translations import pgettext_iface as iface_

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
        outcome = iface_(state.message)
        wrapped(layout, f"{iface_(state.title)}: {outcome[0].lower()}{outcome[1:]}", context)


def _draw_progress(layout: bpy.types.UILayout, state: bpy.types.PropertyGroup) -> None:
    box = layout.box()
    box.progress(factor=state.fraction, text=headline(state), translate=False)
    # One line, cut short by Blender where it is long.
    box.label(text=state.message)
    layout.operator("insideout.cancel", icon="X")
