"""Saves the section's contours in millimetres."""

from __future__ import annotations

import bpy
from bpy.app.translations import pgettext_n as n_
from bpy.app.translations import pgettext_rpt as rpt_
from bpy_extras.io_utils import ExportHelper

from ..core.errors import InsideOutError, SettingError
from ..insideout_addon.scene.contour_files import create_curve, save_csv, save_svg
from ..insideout_addon.scene.section import sample_section, section_as_seen
from ..insideout_addon.scene.section_image import section_contours, size_mm
from .needs import NeedsPlane
from .saving import FILE_PATH, chosen_file, sentence

_NO_EDGE = n_("The plane meets no edge at this density; move it, or change Contour.")


class INSIDEOUT_OT_contours_save(NeedsPlane, bpy.types.Operator, ExportHelper):
    """Save the outlines on the section plane, in mm: .svg for drawings, .csv for points"""

    bl_idname = "insideout.contours_save"
    bl_label = "Save Contours"

    filename_ext = ".svg"
    # The user may type .csv; ExportHelper would append .svg to it.
    check_extension = None
    filepath: FILE_PATH
    filter_glob: bpy.props.StringProperty(default="*.svg;*.csv", options={"HIDDEN"})

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            path = chosen_file(self.filepath)
            if path.suffix.lower() not in (".svg", ".csv"):
                raise SettingError(f"{path.name}: contours are saved as .svg or .csv; choose one of them.")
            values, plane = section_as_seen(context.scene)
            contours = section_contours(values, plane, context.scene.insideout.level)
            if not contours:
                self.report({"WARNING"}, _NO_EDGE)
                return {"CANCELLED"}
            if path.suffix.lower() == ".csv":
                save_csv(path, contours)
            else:
                save_svg(path, contours, *size_mm(plane))
        except (InsideOutError, OSError, ValueError) as error:
            self.report({"ERROR"}, sentence(error))
            return {"CANCELLED"}
        told = rpt_("{count} contours in mm saved as {file}")
        self.report({"INFO"}, told.format(count=len(contours), file=path.name))
        return {"FINISHED"}


class INSIDEOUT_OT_contours_curve(NeedsPlane, bpy.types.Operator):
    """Draw the outlines on the section plane as a curve object"""

    bl_idname = "insideout.contours_curve"
    bl_label = "Contours as Curve"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def execute(self, context: bpy.types.Context) -> set[str]:
        settings = context.scene.insideout
        try:
            values, plane = sample_section(context.scene)
        except (InsideOutError, ValueError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        contours = section_contours(values, plane, settings.level)
        if not contours:
            self.report({"WARNING"}, _NO_EDGE)
            return {"CANCELLED"}
        create_curve(contours, settings.model, context)
        return {"FINISHED"}


CLASSES = (INSIDEOUT_OT_contours_save, INSIDEOUT_OT_contours_curve)
