"""Adds a section: a plane or a box."""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import ClassVar

import bpy
from bpy.app.translations import pgettext_n as n_

from ..core.errors import InsideOutError
from ..insideout_addon.error_text import error_text
from ..insideout_addon.scene.section import active_section
from ..insideout_addon.scene.section_live import live
from ..insideout_addon.scene.sections import add_box_in_steps, add_plane_in_steps
from .needs import NeedsModel
from .waiting import InSteps

_UNDONE = n_("The scene or its model changed before the section was there; press the button again.")


class _AddSection(NeedsModel, InSteps):
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012
    add: ClassVar[Callable[[bpy.types.Object, bpy.types.Context], Generator[float, None, bpy.types.Object]]]

    def steps(self, context: bpy.types.Context) -> Generator[float, None, set[str]]:
        """Adds a section and selects it, so that the ordinary gizmos move it."""
        try:
            added = yield from self.add(context.scene.insideout.model, context)
        except InsideOutError as error:
            self.report({"ERROR"}, error_text(error))
            return {"CANCELLED"}
        except ReferenceError:
            self.report({"ERROR"}, _UNDONE)
            return {"CANCELLED"}
        live.has_drawn(context.scene, active_section(context.scene))
        for other in context.view_layer.objects:
            other.select_set(other == added)
        context.view_layer.objects.active = added
        return {"FINISHED"}


class INSIDEOUT_OT_section_add(_AddSection, bpy.types.Operator):
    """Cut the model with one more plane that you can move and turn"""

    bl_idname = "insideout.section_add"
    bl_label = "Add Section Plane"
    add = staticmethod(add_plane_in_steps)


class INSIDEOUT_OT_section_add_box(_AddSection, bpy.types.Operator):
    """Take a box out of the model, or show only what is in it; you can move, turn and scale it"""

    bl_idname = "insideout.section_add_box"
    bl_label = "Add Section Box"
    add = staticmethod(add_box_in_steps)


CLASSES = (INSIDEOUT_OT_section_add, INSIDEOUT_OT_section_add_box)
