"""Chooses the densities that the section's colours span."""

from __future__ import annotations

import bpy

from ..core.errors import InsideOutError
from ..insideout_addon.scene.section import automatic_window, model_box
from ..insideout_addon.scene.splats import read_density
from .needs import NeedsModel


class INSIDEOUT_OT_section_window(NeedsModel, bpy.types.Operator):
    """Span the colours from air to the model's dense parts"""

    bl_idname = "insideout.section_window"
    bl_label = "Automatic Window"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def execute(self, context: bpy.types.Context) -> set[str]:
        settings = context.scene.insideout
        try:
            gaussians = read_density(settings.model)
        except InsideOutError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        window = automatic_window(gaussians, model_box(gaussians))
        settings.low, settings.high = window.low, window.high
        return {"FINISHED"}


CLASSES = (INSIDEOUT_OT_section_window,)
