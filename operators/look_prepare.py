"""Works out what peeling and colouring by density need."""

from __future__ import annotations

from collections.abc import Generator

import bpy

from ..core.errors import InsideOutError
from ..insideout_addon.error_text import error_text
from ..insideout_addon.properties import COLOR_BY_ITEMS, COLOR_BY_TEXT
from ..insideout_addon.scene.look import apply_look, prepare_in_steps
from ..insideout_addon.scene.splats import shown_model, shows_density
from .needs import NeedsDensity, NeedsModel
from .waiting import InSteps


class INSIDEOUT_OT_look_prepare(NeedsDensity, InSteps, bpy.types.Operator):
    """Work out once how deep under the surface each splat lies, and how dense the model is there, to peel it by that"""

    bl_idname = "insideout.look_prepare"
    bl_label = "Prepare Peeling"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def steps(self, context: bpy.types.Context) -> Generator[float, None, set[str]]:
        try:
            yield from prepare_in_steps(shown_model(context.scene))
        except InsideOutError as error:
            self.report({"ERROR"}, error_text(error))
            return {"CANCELLED"}
        apply_look(context.scene)
        return {"FINISHED"}


class INSIDEOUT_OT_color_by(NeedsModel, InSteps, bpy.types.Operator):
    """Choose what the splats' colors stand for; export keeps their own"""

    bl_idname = "insideout.color_by"
    bl_label = "Color By"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    color_by: bpy.props.EnumProperty(name="Color By", description=COLOR_BY_TEXT, items=COLOR_BY_ITEMS)

    def steps(self, context: bpy.types.Context) -> Generator[float, None, set[str]]:
        model = shown_model(context.scene)
        try:
            if self.color_by == "DENSITY" and shows_density(model):
                yield from prepare_in_steps(model)
        except InsideOutError as error:
            self.report({"ERROR"}, error_text(error))
            return {"CANCELLED"}
        context.scene.insideout.color_by = self.color_by
        return {"FINISHED"}


CLASSES = (INSIDEOUT_OT_look_prepare, INSIDEOUT_OT_color_by)
