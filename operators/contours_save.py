"""Saves the section's contours in millimetres."""

from __future__ import annotations

from collections.abc import Generator

import bpy
from bpy.app.translations import pgettext_n as n_
from bpy.app.translations import pgettext_rpt as rpt_

from ..core.errors import InsideOutError, SettingError
from ..core.steps import part_of_work
from ..insideout_addon.error_text import error_text, sentence
from ..insideout_addon.scene.contour_files import curve_in_steps, save_csv_in_steps, save_svg_in_steps
from ..insideout_addon.scene.section import sample_in_steps, seen_in_steps
from ..insideout_addon.scene.section_image import contours_in_steps, size_mm
from ..insideout_addon.scene.splats import shown_model
from ..insideout_addon.told_text import displayable
from .needs import NeedsPlane
from .saving import FILE_PATH, chosen_file
from .waiting import InSteps, SavedInSteps

_NO_EDGE = n_("The plane meets no edge at this density; move it, or change Contour.")
_UNDONE = n_("The curve was undone before its end; press the button again.")
# Shares of the work that are done when the model is cut, and its outlines are found.
_CUT, _FOUND = 0.3, 0.7


class INSIDEOUT_OT_contours_save(NeedsPlane, SavedInSteps, bpy.types.Operator):
    """Save the outlines on the section plane, in mm: .svg for drawings, .csv for points"""

    bl_idname = "insideout.contours_save"
    bl_label = "Save Contours..."

    filename_ext = ".svg"
    # The user may type .csv; ExportHelper would append .svg to it.
    check_extension = None
    filepath: FILE_PATH
    filter_glob: bpy.props.StringProperty(default="*.svg;*.csv", options={"HIDDEN"})

    def steps(self, context: bpy.types.Context) -> Generator[float, None, set[str]]:
        # What is asked for now counts; an undo in a break leaves no settings that could be asked later.
        level = context.scene.insideout.level
        try:
            path = chosen_file(self.filepath)
            if path.suffix.lower() not in (".svg", ".csv"):
                raise SettingError("{file}: contours are saved as .svg or .csv; choose one of them.", file=path.name)
            values, plane = yield from part_of_work(seen_in_steps(context.scene), 0.0, _CUT)
            contours = yield from part_of_work(contours_in_steps(values, plane, level), _CUT, _FOUND)
            if not contours:
                self.report({"WARNING"}, _NO_EDGE)
                return {"CANCELLED"}
            if path.suffix.lower() == ".csv":
                saving = save_csv_in_steps(path, contours)
            else:
                saving = save_svg_in_steps(path, contours, *size_mm(plane))
            yield from part_of_work(saving, _FOUND, 1.0)
        except (InsideOutError, OSError, ValueError) as error:
            self.report({"ERROR"}, sentence(error))
            return {"CANCELLED"}
        told = rpt_("{count} contours in mm saved as {file}")
        self.report({"INFO"}, told.format(count=len(contours), file=displayable(path.name)))
        return {"FINISHED"}


class INSIDEOUT_OT_contours_curve(NeedsPlane, InSteps, bpy.types.Operator):
    """Draw the outlines on the section plane as a curve object"""

    bl_idname = "insideout.contours_curve"
    bl_label = "Contours as Curve"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def steps(self, context: bpy.types.Context) -> Generator[float, None, set[str]]:
        # By their values: an undo in a break leaves no references.
        level, model = context.scene.insideout.level, shown_model(context.scene)
        model_uid = 0 if model is None else model.session_uid
        try:
            values, plane = yield from part_of_work(sample_in_steps(context.scene), 0.0, _CUT)
            contours = yield from part_of_work(contours_in_steps(values, plane, level), _CUT, _FOUND)
            if not contours:
                self.report({"WARNING"}, _NO_EDGE)
                return {"CANCELLED"}
            yield from part_of_work(curve_in_steps(contours, model_uid, context), _FOUND, 1.0)
        except (InsideOutError, ValueError) as error:
            self.report({"ERROR"}, error_text(error))
            return {"CANCELLED"}
        except ReferenceError:
            self.report({"ERROR"}, _UNDONE)
            return {"CANCELLED"}
        return {"FINISHED"}


CLASSES = (INSIDEOUT_OT_contours_save, INSIDEOUT_OT_contours_curve)
