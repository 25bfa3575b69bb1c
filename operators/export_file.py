"""Saves a model as a .ply for other programs."""

from __future__ import annotations

from collections.abc import Generator

import bpy
from bpy.app.translations import pgettext_n as n_
from bpy.app.translations import pgettext_rpt as rpt_

from ..core.affine import Kept
from ..core.errors import InsideOutError
from ..insideout_addon.error_text import sentence
from ..insideout_addon.scene.exporting import export_in_steps, model_to_export
from ..insideout_addon.told_text import displayable
from .kept_density import KEPT_DENSITY
from .needs import nothing_in_work
from .saving import FILE_PATH, chosen_file
from .waiting import SavedInSteps

_CHANGED = n_("The model was edited or undone before it was exported; press the button again.")


class INSIDEOUT_OT_export_file(SavedInSteps, bpy.types.Operator):
    """Save the active model as a Gaussian .ply, as it was moved and edited; cuts count with Visible Only alone"""

    bl_idname = "insideout.export_file"
    bl_label = "Export File..."

    filename_ext = ".ply"
    filepath: FILE_PATH
    filter_glob: bpy.props.StringProperty(default="*.ply", options={"HIDDEN"})
    visible_only: bpy.props.BoolProperty(
        name="Visible Only",
        description="Leave out hidden background and what sections and Look hide; splats are cut at their centers",
        default=False,
    )
    density: KEPT_DENSITY

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if model_to_export(context) is None:
            cls.poll_message_set("Import a model first, or select one")
            return False
        return nothing_in_work(cls)

    def ask(self, context: bpy.types.Context) -> set[str]:
        if not self.filepath:
            self.filepath = bpy.path.clean_name(model_to_export(context).name) + self.filename_ext
        return super().ask(context)

    def steps(self, context: bpy.types.Context) -> Generator[float, None, set[str]]:
        model = model_to_export(context)
        name = model.name
        try:
            path = chosen_file(self.filepath)
            export = yield from export_in_steps(model, path, context, self.visible_only, Kept[self.density])
        except (InsideOutError, OSError) as error:
            self.report({"ERROR"}, sentence(error))
            return {"CANCELLED"}
        except ReferenceError:
            self.report({"ERROR"}, _CHANGED)
            return {"CANCELLED"}
        for warning in export.warnings:
            self.report({"WARNING"}, warning)
        told = rpt_("{count:,} splats of {model} saved as {file}")
        self.report({"INFO"}, told.format(count=export.splats, model=name, file=displayable(path.name)))
        return {"FINISHED"}


CLASSES = (INSIDEOUT_OT_export_file,)
