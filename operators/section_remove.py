"""Removes the section plane."""

from __future__ import annotations

import bpy

from ..insideout_addon.scene.section import remove_section, shown_plane


class INSIDEOUT_OT_section_remove(bpy.types.Operator):
    """Make the model whole again and take the plane and its colour bar away"""

    bl_idname = "insideout.section_remove"
    bl_label = "Remove Section Plane"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return shown_plane(context.scene) is not None

    def execute(self, context: bpy.types.Context) -> set[str]:
        remove_section(context.scene)
        return {"FINISHED"}


CLASSES = (INSIDEOUT_OT_section_remove,)
