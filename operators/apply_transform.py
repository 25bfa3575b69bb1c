"""Turns what was done to a model as an object into its splats."""

from __future__ import annotations

import math
from collections.abc import Generator

import bpy
from bpy.app.translations import pgettext_rpt as rpt_

from ..core.affine import Kept
from ..core.errors import InsideOutError
from ..insideout_addon.error_text import error_text
from ..insideout_addon.measure.after_transform import measure_again
from ..insideout_addon.scene.look import apply_look
from ..insideout_addon.scene.placement import apply_in_steps, denser_by, is_scaled
from ..insideout_addon.scene.splats import is_splats, shows_density
from .kept_density import KEPT_DENSITY
from .needs import nothing_in_work
from .waiting import AskedInSteps


class INSIDEOUT_OT_apply_transform(AskedInSteps, bpy.types.Operator):
    """Move, turn and stretch the splats themselves, with their shapes and colors; Blender's own Apply moves points"""

    bl_idname = "insideout.apply_transform"
    bl_label = "Transform to Splats..."
    bl_options = {"UNDO"}  # noqa: RUF012

    density: KEPT_DENSITY

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        active = context.view_layer.objects.active
        if not is_splats(active) or context.mode != "OBJECT":
            cls.poll_message_set("Select a model in Object Mode first")
            return False
        if active.library is not None or active.data.library is not None:
            cls.poll_message_set("The model is linked from another file; make it local first")
            return False
        return nothing_in_work(cls)

    def ask(self, context: bpy.types.Context) -> set[str]:
        context.view_layer.update()
        model = context.view_layer.objects.active
        if not (shows_density(model) and is_scaled(model)):
            return self.execute(context)
        return context.window_manager.invoke_props_dialog(self)

    def steps(self, context: bpy.types.Context) -> Generator[float, None, set[str]]:
        context.view_layer.update()
        model = context.view_layer.objects.active
        try:
            moved = yield from apply_in_steps(model, Kept[self.density])
            apply_look(context.scene)
        except InsideOutError as error:
            self.report({"ERROR"}, error_text(error))
            return {"CANCELLED"}
        denser = denser_by(moved, Kept[self.density])
        if shows_density(model) and not math.isclose(denser, 1.0, rel_tol=1e-5):
            told = rpt_("Densities are {factor:.3g} times as high now; Low, High, Contour and Look stay as set")
            self.report({"INFO"}, told.format(factor=denser))
        if measure_again(model, moved, context):
            self.report({"INFO"}, "The walls are of another thickness now; press Wall Thickness again")
        return {"FINISHED"}


CLASSES = (INSIDEOUT_OT_apply_transform,)
