"""Makes the model whole again."""

from __future__ import annotations

import bpy

from ..insideout_addon.physics.breaking import make_whole
from ..insideout_addon.physics.whole import is_taken_apart
from ..insideout_addon.physics.world import give_gravity_back, is_left_over, release
from ..insideout_addon.scene.splats import shown_model
from .needs import nothing_in_work


class INSIDEOUT_OT_unbreak(bpy.types.Operator):
    """Remove pieces, bodies, cage and floor, and show the model whole where it was"""

    bl_idname = "insideout.unbreak"
    bl_label = "Back to Whole"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        model = shown_model(context.scene)
        if is_left_over(context.scene) or (model is not None and is_taken_apart(model, context.scene)):
            return nothing_in_work(cls)
        cls.poll_message_set("The model is whole already")
        return False

    def execute(self, context: bpy.types.Context) -> set[str]:
        scene, model = context.scene, shown_model(context.scene)
        if model is not None:
            make_whole(model, scene)
        if is_left_over(scene):
            release([], scene)
            give_gravity_back(scene)
        return {"FINISHED"}


CLASSES = (INSIDEOUT_OT_unbreak,)
