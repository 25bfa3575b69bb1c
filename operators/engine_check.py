"""Asks the engine who it is."""

from __future__ import annotations

import bpy

from ..insideout_addon.engine.commands import start_version
from .needs import engine_is_free


class INSIDEOUT_OT_engine_check(bpy.types.Operator):
    """Start the engine once and show its version"""

    bl_idname = "insideout.engine_check"
    bl_label = "Try Engine"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return engine_is_free(cls)

    def execute(self, context: bpy.types.Context) -> set[str]:
        return start_version(self)


CLASSES = (INSIDEOUT_OT_engine_check,)
