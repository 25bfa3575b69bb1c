"""Looks a capture folder over."""

from __future__ import annotations

import bpy

from ..insideout_addon.engine.commands import start_check
from ..insideout_addon.engine.job import job_running


class INSIDEOUT_OT_check(bpy.types.Operator):
    """Look the capture over: what is there, and what is wrong with it"""

    bl_idname = "insideout.check"
    bl_label = "Check Capture"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return bool(context.scene.insideout.capture) and not job_running()

    def execute(self, context: bpy.types.Context) -> set[str]:
        return start_check(self, context.scene)


CLASSES = (INSIDEOUT_OT_check,)
