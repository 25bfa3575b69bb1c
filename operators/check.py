"""Looks a capture folder over."""

from __future__ import annotations

import bpy

from ..insideout_addon.engine.commands import start_check
from .needs import engine_is_free


class INSIDEOUT_OT_check(bpy.types.Operator):
    """Look the capture over: what is there, and what is wrong with it"""

    bl_idname = "insideout.check"
    bl_label = "Check Capture"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not context.scene.insideout.capture:
            cls.poll_message_set("Choose a capture folder first")
            return False
        return engine_is_free(cls)

    def execute(self, context: bpy.types.Context) -> set[str]:
        return start_check(self, context.scene)


CLASSES = (INSIDEOUT_OT_check,)
