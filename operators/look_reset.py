"""Takes back all that hides or colours the model's splats."""

from __future__ import annotations

import bpy

from ..insideout_addon.scene.look import show_all
from .needs import NeedsModel


class INSIDEOUT_OT_look_reset(NeedsModel, bpy.types.Operator):
    """Show all of the model again, in its own colors"""

    bl_idname = "insideout.look_reset"
    bl_label = "Show All"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def execute(self, context: bpy.types.Context) -> set[str]:
        show_all(context.scene)
        return {"FINISHED"}


CLASSES = (INSIDEOUT_OT_look_reset,)
