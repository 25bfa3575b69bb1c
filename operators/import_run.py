"""Brings splats into the scene."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path

import bpy
from bpy.app.translations import pgettext_rpt as rpt_

from ..core.errors import InsideOutError
from ..insideout_addon.error_text import sentence
from ..insideout_addon.scene.importing import find_set, import_in_steps
from ..insideout_addon.told_text import displayable
from .needs import nothing_in_work
from .waiting import InSteps


class INSIDEOUT_OT_import_run(InSteps, bpy.types.Operator):
    """Import the chosen splats of the run, or any Gaussian .ply"""

    bl_idname = "insideout.import_run"
    bl_label = "Import"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    filepath: bpy.props.StringProperty(
        name="File",
        description="A Gaussian .ply; empty: of the scene's run",
        subtype="FILE_PATH",
        options={"SKIP_SAVE", "PATH_SUPPORTS_BLEND_RELATIVE"},
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return nothing_in_work(cls)

    def steps(self, context: bpy.types.Context) -> Generator[float, None, set[str]]:
        settings = context.scene.insideout
        source = bpy.path.abspath(self.filepath or settings.run)
        if not source:
            self.report({"ERROR"}, "Choose the folder of a run first, under Run Folder.")
            return {"CANCELLED"}
        try:
            path = find_set(Path(source), settings.which)
            name = path.stem if self.filepath else f"{Path(source).name} {settings.which}"
            importing = import_in_steps(path, displayable(name), context, settings.display, settings.view_dependent)
            splats = yield from importing
        except (InsideOutError, OSError) as error:
            self.report({"ERROR"}, sentence(error))
            return {"CANCELLED"}
        told = rpt_("{count:,} splats from {file}")
        self.report({"INFO"}, told.format(count=len(splats.data.points), file=displayable(path.name)))
        return {"FINISHED"}


CLASSES = (INSIDEOUT_OT_import_run,)
