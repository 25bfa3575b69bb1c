"""Saves the section as an image."""

from __future__ import annotations

import bpy
from bpy.app.translations import pgettext_rpt as rpt_
from bpy_extras.io_utils import ExportHelper

from ..core.errors import InsideOutError
from ..insideout_addon.scene.importing import densities_are_relative
from ..insideout_addon.scene.section import section_as_seen
from ..insideout_addon.scene.section_image import Window, save_figures, save_values
from ..insideout_addon.scene.section_picture import forget_scan_unless_shown, picture_of
from ..insideout_addon.scene.splats import shown_model
from .needs import NeedsPlane
from .saving import FILE_PATH, chosen_file, sentence


class INSIDEOUT_OT_section_save(NeedsPlane, bpy.types.Operator, ExportHelper):
    """Save the density on the plane as a PNG of real size"""

    bl_idname = "insideout.section_save"
    bl_label = "Save Section"

    filename_ext = ".png"
    filepath: FILE_PATH
    filter_glob: bpy.props.StringProperty(default="*.png", options={"HIDDEN"})
    content: bpy.props.EnumProperty(
        name="Content",
        items=(
            ("COLOURS", "Colours", "The model's density with its colour bar"),
            ("COMPARISON", "Comparison", "The model, the CT on the same plane, and their difference"),
            ("VALUES", "Values", "16-bit grey, linear in density between Low and High"),
        ),
    )

    def execute(self, context: bpy.types.Context) -> set[str]:
        settings = context.scene.insideout
        kinds = ("MODEL", "CT", "DIFFERENCE") if self.content == "COMPARISON" else ("MODEL",)
        try:
            path = chosen_file(self.filepath)
            values, plane = section_as_seen(context.scene)
            window = Window(settings.low, settings.high)
            if self.content == "VALUES":
                model = shown_model(context.scene)
                save_values(path, values, window, plane, model is not None and densities_are_relative(model))
            else:
                pictures = [picture_of(values, plane, context.scene, kind) for kind in kinds]
                save_figures(path, pictures, window, plane)
                forget_scan_unless_shown()
        except (InsideOutError, OSError, ValueError) as error:
            self.report({"ERROR"}, sentence(error))
            return {"CANCELLED"}
        self.report({"INFO"}, rpt_("Saved {path}").format(path=path))
        return {"FINISHED"}


CLASSES = (INSIDEOUT_OT_section_save,)
