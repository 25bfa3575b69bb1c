"""Saves how much there is of which density."""

from __future__ import annotations

import bpy
from bpy.app.translations import pgettext_rpt as rpt_
from bpy_extras.io_utils import ExportHelper

from ..core.errors import InsideOutError, SettingError
from ..insideout_addon.measure.histogram import save_histogram_csv
from ..insideout_addon.measure.of_scene import histogram_page, measure_histogram
from ..insideout_addon.measure.pdf import PAGE_KINDS, save_page
from ..insideout_addon.measure.typesetting import typesetter
from .needs import NeedsDensity
from .saving import FILE_PATH, chosen_file, sentence

_DOTS_PER_INCH = 200.0


class INSIDEOUT_OT_histogram_save(NeedsDensity, bpy.types.Operator, ExportHelper):
    """Save how much there is of which density: .png or .pdf for pictures, .csv for numbers"""

    bl_idname = "insideout.histogram_save"
    bl_label = "Save Histogram"

    filename_ext = ".png"
    # The user may type another; ExportHelper would append .png to it.
    check_extension = None
    filepath: FILE_PATH
    filter_glob: bpy.props.StringProperty(default="*.png;*.pdf;*.csv", options={"HIDDEN"})
    of: bpy.props.EnumProperty(
        name="Of",
        items=(
            ("SECTION", "Section", "Area on the section plane, mm²"),
            ("MODEL", "Model", "Volume of the whole model, mm³; takes some seconds"),
        ),
        default="MODEL",
    )

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            path = chosen_file(self.filepath)
            if path.suffix.lower() not in (*PAGE_KINDS, ".csv"):
                raise SettingError(f"{path.name}: histograms are saved as .png, .pdf or .csv; choose one of them.")
            histogram = measure_histogram(context.scene, self.of)
            if path.suffix.lower() == ".csv":
                save_histogram_csv(path, histogram)
            else:
                with typesetter() as letter:
                    save_page(path, histogram_page(context.scene, self.of, histogram, letter), _DOTS_PER_INCH)
        except (InsideOutError, OSError, ValueError) as error:
            self.report({"ERROR"}, sentence(error))
            return {"CANCELLED"}
        self.report({"INFO"}, rpt_("Saved {path}").format(path=path))
        return {"FINISHED"}


CLASSES = (INSIDEOUT_OT_histogram_save,)
