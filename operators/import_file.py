"""Brings any Gaussian .ply into the scene."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path

import bpy
from bpy.app.translations import pgettext_rpt as rpt_

from ..core.errors import InsideOutError
from ..insideout_addon.error_text import sentence
from ..insideout_addon.scene.importing import import_in_steps
from ..insideout_addon.told_text import displayable
from ..panels.model import draw_cost
from .needs import nothing_in_work
from .saving import FILE_PATH
from .waiting import OpenedInSteps


class INSIDEOUT_OT_import_file(OpenedInSteps, bpy.types.Operator):
    """Import the splats of a .ply from any program for 3D Gaussian splatting; without density they have no inside"""

    bl_idname = "insideout.import_file"
    bl_label = "Import File..."
    bl_options = {"UNDO"}  # noqa: RUF012

    filename_ext = ".ply"
    filepath: FILE_PATH
    filter_glob: bpy.props.StringProperty(default="*.ply", options={"HIDDEN"})

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return nothing_in_work(cls)

    def draw(self, context: bpy.types.Context) -> None:
        """Beside the file browser: how to show the file, and what that costs."""
        settings, column = context.scene.insideout, self.layout.column()
        column.prop(settings, "display")
        column.prop(settings, "view_dependent")
        path = Path(bpy.path.abspath(self.filepath))
        if path.suffix.lower() == ".ply":
            draw_cost(self.layout, path, settings, context)

    def steps(self, context: bpy.types.Context) -> Generator[float, None, set[str]]:
        settings, path = context.scene.insideout, Path(bpy.path.abspath(self.filepath))
        try:
            name, display = displayable(path.stem), settings.display
            importing = import_in_steps(path, name, context, display, settings.view_dependent)
            splats = yield from importing
        except (InsideOutError, OSError) as error:
            self.report({"ERROR"}, sentence(error))
            return {"CANCELLED"}
        told = rpt_("{count:,} splats from {file}")
        self.report({"INFO"}, told.format(count=len(splats.data.points), file=displayable(path.name)))
        return {"FINISHED"}


CLASSES = (INSIDEOUT_OT_import_file,)
