"""Reads the scan that sections are to show."""

from __future__ import annotations

from collections.abc import Generator
from inspect import GEN_CREATED, getgeneratorstate

import bpy

from ..core.errors import InsideOutError
from ..insideout_addon.error_text import sentence
from ..insideout_addon.scene.ct_volume import kept_volume
from ..insideout_addon.scene.section_picture import show_without_scan, wants_scan
from ..insideout_addon.scene.splats import shown_model
from .waiting import InSteps


class INSIDEOUT_OT_scan_read(InSteps, bpy.types.Operator):
    """Read the CT scan that a section is to show, which may be gigabytes"""

    bl_idname = "insideout.scan_read"
    bl_label = "Read CT Scan"
    bl_options = {"INTERNAL"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not wants_scan(context.scene):
            cls.poll_message_set("No section is to show a scan that is not read yet")
            return False
        return True

    def steps(self, context: bpy.types.Context) -> Generator[float, None, set[str]]:
        scene = context.scene
        try:
            yield from kept_volume.of_in_steps(shown_model(scene))
        except GeneratorExit:
            show_without_scan(scene)
            raise
        except (InsideOutError, OSError, MemoryError) as error:
            show_without_scan(scene)
            self.report({"ERROR"}, sentence(error))
            return {"CANCELLED"}
        return {"FINISHED"}

    def cancel(self, context: bpy.types.Context) -> None:
        """Nothing of `steps` runs where it is closed before its first step; the scan would be read again and again."""
        not_begun = self._steps is not None and getgeneratorstate(self._steps) == GEN_CREATED
        InSteps.cancel(self, context)
        if not_begun:
            show_without_scan(context.scene)


CLASSES = (INSIDEOUT_OT_scan_read,)
