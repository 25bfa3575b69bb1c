"""Chooses the densities that the section's colours span."""

from __future__ import annotations

from collections.abc import Generator

import bpy
from bpy.app.translations import pgettext_n as n_

from ..core.errors import InsideOutError
from ..core.render.section_numpy import SectionSplats
from ..core.steps import part_of_work
from ..insideout_addon.error_text import error_text
from ..insideout_addon.scene.section import box_in_steps, use_found_window, window_in_steps
from ..insideout_addon.scene.splats import read_density
from .needs import NeedsModel
from .waiting import InSteps

# Shares of the work that are done when the model's box is found, and when its splats are known.
_BOXED, _KNOWN = 0.2, 0.5
_CHANGED = n_("The model changed before its window was found; press the button again.")


class INSIDEOUT_OT_section_window(NeedsModel, InSteps, bpy.types.Operator):
    """Span the colors from air to the model's dense parts"""

    bl_idname = "insideout.section_window"
    bl_label = "Automatic Window"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def steps(self, context: bpy.types.Context) -> Generator[float, None, set[str]]:
        try:
            gaussians = read_density(context.scene.insideout.model)
        except InsideOutError as error:
            self.report({"ERROR"}, error_text(error))
            return {"CANCELLED"}
        uid = context.scene.insideout.model.session_uid
        box = yield from part_of_work(box_in_steps(gaussians), 0.0, _BOXED)
        splats = yield from part_of_work(SectionSplats.in_steps(gaussians), _BOXED, _KNOWN)
        window = yield from part_of_work(window_in_steps(splats, box), _KNOWN, 1.0)
        model = context.scene.insideout.model
        if model is None or model.session_uid != uid:
            self.report({"ERROR"}, _CHANGED)
            return {"CANCELLED"}
        use_found_window(context.scene.insideout, window, model)
        return {"FINISHED"}


CLASSES = (INSIDEOUT_OT_section_window,)
