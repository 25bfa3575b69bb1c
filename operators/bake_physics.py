"""Turns the motion of the model's bodies into keyframes."""

from __future__ import annotations

from collections.abc import Generator

import bpy
from bpy.app.translations import pgettext_rpt as rpt_
from bpy.props import IntProperty

from ..core.errors import InsideOutError
from ..insideout_addon.error_text import sentence
from ..insideout_addon.physics.baking import bake_in_steps
from ..insideout_addon.physics.world import simulated_in
from .needs import nothing_in_work
from .waiting import AskedInSteps


class INSIDEOUT_OT_bake_physics(AskedInSteps, bpy.types.Operator):
    """Write the motion of pieces, rigid and soft bodies as keyframes, and take the physics and its cache away"""

    bl_idname = "insideout.bake_physics"
    bl_label = "Bake to Keyframes..."
    bl_options = {"UNDO"}  # noqa: RUF012

    start: IntProperty(name="Start", description="First frame; 0 is the scene's", default=0, min=0)
    end: IntProperty(name="End", description="Last frame; 0 is the scene's", default=0, min=0)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not simulated_in(context.scene):
            cls.poll_message_set("Break the model, or make it rigid or soft, first")
            return False
        return nothing_in_work(cls)

    def ask(self, context: bpy.types.Context) -> set[str]:
        # Of this scene, whatever was baked before, unless whoever calls it says otherwise.
        given = self.properties.is_property_set
        self.start = self.start if given("start") else context.scene.frame_start
        self.end = self.end if given("end") else context.scene.frame_end
        return context.window_manager.invoke_props_dialog(self, confirm_text="Bake")

    def steps(self, context: bpy.types.Context) -> Generator[float, None, set[str]]:
        scene = context.scene
        start, end = self.start or scene.frame_start, self.end or scene.frame_end
        try:
            baked = yield from bake_in_steps(scene, start, end)
        except InsideOutError as error:
            self.report({"ERROR"}, sentence(error))
            return {"CANCELLED"}
        told = rpt_("Keyframes of {count} bodies, frames {start} to {end}")
        self.report({"INFO"}, told.format(count=len(baked), start=start, end=end))
        return {"FINISHED"}


CLASSES = (INSIDEOUT_OT_bake_physics,)
