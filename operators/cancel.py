"""Stops the engine."""

from __future__ import annotations

import bpy

from ..insideout_addon.engine.job import cancel_job, job_running


class INSIDEOUT_OT_cancel(bpy.types.Operator):
    """Stop within a second; checkpoints stay, so the run can go on later"""

    bl_idname = "insideout.cancel"
    bl_label = "Cancel"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not job_running():
            cls.poll_message_set("The engine does nothing now")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        cancel_job()
        return {"FINISHED"}


CLASSES = (INSIDEOUT_OT_cancel,)
