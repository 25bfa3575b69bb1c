"""Adds the section plane."""

from __future__ import annotations

import bpy

from ..insideout_addon.scene.section import add_section_plane
from ..insideout_addon.scene.splats import shown_model


class INSIDEOUT_OT_section_add(bpy.types.Operator):
    """Cut the model with a plane that you can move and turn"""

    bl_idname = "insideout.section_add"
    bl_label = "Add Section Plane"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return shown_model(context.scene) is not None

    def execute(self, context: bpy.types.Context) -> set[str]:
        plane = add_section_plane(context.scene.insideout.model, context)
        for other in context.view_layer.objects:
            other.select_set(other == plane)
        context.view_layer.objects.active = plane
        return {"FINISHED"}


CLASSES = (INSIDEOUT_OT_section_add,)
