"""Saves the section as an image."""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy_extras.io_utils import ExportHelper

from ..core.errors import InsideOutError
from ..insideout_addon.scene.section import sample_section
from ..insideout_addon.scene.section_image import Window, save_figure, save_values


class INSIDEOUT_OT_section_save(bpy.types.Operator, ExportHelper):
    """Save the density on the plane as a PNG of real size"""

    bl_idname = "insideout.section_save"
    bl_label = "Save Section"

    filename_ext = ".png"
    filter_glob: bpy.props.StringProperty(default="*.png", options={"HIDDEN"})
    content: bpy.props.EnumProperty(
        name="Content",
        items=(
            ("COLOURS", "Colours", "As shown, with the colour bar"),
            ("VALUES", "Values", "16-bit grey, linear in density between Low and High"),
        ),
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return context.scene.insideout.plane is not None

    def execute(self, context: bpy.types.Context) -> set[str]:
        settings = context.scene.insideout
        save = save_figure if self.content == "COLOURS" else save_values
        try:
            values, plane = sample_section(context.scene)
            save(Path(self.filepath), values, Window(settings.low, settings.high), plane)
        except (InsideOutError, OSError, ValueError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"Saved {self.filepath}")
        return {"FINISHED"}


CLASSES = (INSIDEOUT_OT_section_save,)
