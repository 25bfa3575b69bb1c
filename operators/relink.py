"""Finds the file again that a model was imported from."""

from __future__ import annotations

import os
from collections.abc import Generator
from pathlib import Path

import bpy
from bpy.app.translations import pgettext_n as n_
from bpy.app.translations import pgettext_rpt as rpt_

from ..core.errors import InsideOutError
from ..insideout_addon.error_text import sentence
from ..insideout_addon.remembered import forget
from ..insideout_addon.scene.paths import blend_relative
from ..insideout_addon.scene.section_live import live
from ..insideout_addon.scene.sources import relink_in_steps, run_of, source_name
from ..insideout_addon.scene.splats import shown_model
from ..insideout_addon.told_text import displayable
from .needs import nothing_in_work
from .saving import FILE_PATH
from .waiting import AskedInSteps

_UNDONE = n_("The model was undone before it was relinked; press the button again.")


class INSIDEOUT_OT_relink(AskedInSteps, bpy.types.Operator):
    """Choose where the run folder, or the file, of the model is now; the model itself is in the .blend and stays"""

    bl_idname = "insideout.relink"
    bl_label = "Relink..."
    bl_options = {"UNDO"}  # noqa: RUF012

    filepath: FILE_PATH
    filter_glob: bpy.props.StringProperty(default="*.ply", options={"HIDDEN"})
    other_model: bpy.props.BoolProperty(
        name="Any Model",
        description="Also a file that is not the one this model was imported from",
        default=False,
        options={"SKIP_SAVE"},
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        model = shown_model(context.scene)
        if model is None or model.library is not None or not source_name(model):
            cls.poll_message_set("Import a model of a run, or a .ply, first")
            return False
        return nothing_in_work(cls)

    def ask(self, context: bpy.types.Context) -> set[str]:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def steps(self, context: bpy.types.Context) -> Generator[float, None, set[str]]:
        model = shown_model(context.scene)
        place = Path(bpy.path.abspath(self.filepath))
        if not self.filepath or not os.path.exists(place):
            told = rpt_("{path}: is not there; choose the run folder, or the .ply.")
            self.report({"ERROR"}, told.format(path=displayable(self.filepath) or rpt_("No file")))
            return {"CANCELLED"}
        name = model.name
        try:
            path, others = yield from relink_in_steps(model, place, self.other_model)
        except (InsideOutError, OSError) as error:
            self.report({"ERROR"}, sentence(error))
            return {"CANCELLED"}
        except ReferenceError:
            self.report({"ERROR"}, _UNDONE)
            return {"CANCELLED"}
        settings = context.scene.insideout
        if settings.run and not os.path.exists(bpy.path.abspath(settings.run)):
            settings.run = blend_relative(run_of(path))
        forget()
        # Sections of the CT, which was out of reach, are drawn again; custom properties alone tell nobody.
        for scene in {context.scene, *(window.scene for window in context.window_manager.windows)}:
            live.mark(scene)
        told = rpt_("{model} is from {path}, and {count} more of its run") if others else rpt_("{model} is from {path}")
        self.report({"INFO"}, told.format(model=name, path=displayable(path), count=others))
        return {"FINISHED"}


CLASSES = (INSIDEOUT_OT_relink,)
