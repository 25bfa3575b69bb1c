"""Adds a section: a plane or a box."""

from __future__ import annotations

from collections.abc import Callable

import bpy

from ..core.errors import InsideOutError
from ..insideout_addon.scene.sections import add_section_box, add_section_plane
from .needs import NeedsModel


class _AddSection(NeedsModel):
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def _choose(
        self, add: Callable[[bpy.types.Object, bpy.types.Context], bpy.types.Object], context: bpy.types.Context
    ) -> set[str]:
        """Adds a section and selects it, so that the ordinary gizmos move it."""
        try:
            added = add(context.scene.insideout.model, context)
        except InsideOutError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        for other in context.view_layer.objects:
            other.select_set(other == added)
        context.view_layer.objects.active = added
        return {"FINISHED"}


class INSIDEOUT_OT_section_add(_AddSection, bpy.types.Operator):
    """Cut the model with one more plane that you can move and turn"""

    bl_idname = "insideout.section_add"
    bl_label = "Add Section Plane"

    def execute(self, context: bpy.types.Context) -> set[str]:
        return self._choose(add_section_plane, context)


class INSIDEOUT_OT_section_add_box(_AddSection, bpy.types.Operator):
    """Take a box out of the model, or show only what is in it; you can move, turn and scale it"""

    bl_idname = "insideout.section_add_box"
    bl_label = "Add Section Box"

    def execute(self, context: bpy.types.Context) -> set[str]:
        return self._choose(add_section_box, context)


CLASSES = (INSIDEOUT_OT_section_add, INSIDEOUT_OT_section_add_box)
