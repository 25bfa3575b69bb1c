"""Runs the engine on a capture: all stages or one."""

from __future__ import annotations

import bpy

from ..insideout_addon.engine.commands import start_run
from .needs import engine_is_free


class INSIDEOUT_OT_reconstruct(bpy.types.Operator):
    """Make the model from the capture; what is done already is not done again"""

    bl_idname = "insideout.reconstruct"
    bl_label = "Reconstruct"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not context.scene.insideout.capture:
            cls.poll_message_set("Choose a capture folder first")
            return False
        return engine_is_free(cls)

    def execute(self, context: bpy.types.Context) -> set[str]:
        return start_run(self, context.scene)


CLASSES = (INSIDEOUT_OT_reconstruct,)
