"""Asks the engine how long each preset will take."""

from __future__ import annotations

import bpy

from ..insideout_addon.engine.commands import start_forecast
from .needs import engine_is_free


class INSIDEOUT_OT_forecast(bpy.types.Operator):
    """Time some steps on this machine with this capture: how long a reconstruction with each preset will take"""

    bl_idname = "insideout.forecast"
    bl_label = "Estimate Times"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not context.scene.insideout.capture:
            cls.poll_message_set("Choose a capture folder first")
            return False
        return engine_is_free(cls)

    def execute(self, context: bpy.types.Context) -> set[str]:
        return start_forecast(self, context.scene)


CLASSES = (INSIDEOUT_OT_forecast,)
