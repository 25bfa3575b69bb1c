"""Removes a section."""

from __future__ import annotations

import bpy

from ..insideout_addon.scene.section import active_section
from ..insideout_addon.scene.sections import remove_section
from .needs import nothing_in_work


class INSIDEOUT_OT_section_remove(bpy.types.Operator):
    """Take the chosen plane or box away, with its cut and its color bar"""

    bl_idname = "insideout.section_remove"
    bl_label = "Remove Section"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if active_section(context.scene) is None:
            cls.poll_message_set("There is no section to remove")
            return False
        return nothing_in_work(cls)

    def execute(self, context: bpy.types.Context) -> set[str]:
        remove_section(context.scene, active_section(context.scene))
        return {"FINISHED"}


CLASSES = (INSIDEOUT_OT_section_remove,)
