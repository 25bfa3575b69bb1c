"""Saves how much there is of which density."""

from __future__ import annotations

from collections.abc import Generator

import bpy
from bpy.app.translations import pgettext_rpt as rpt_

from ..core.errors import InsideOutError, SettingError
from ..core.steps import part_of_work
from ..insideout_addon.error_text import sentence
from ..insideout_addon.measure.histogram import save_histogram_csv
from ..insideout_addon.measure.of_scene import histogram_page, measure_histogram
from ..insideout_addon.measure.pdf import PAGE_KINDS, save_page_in_steps
from ..insideout_addon.measure.typesetting import typesetter
from ..insideout_addon.told_text import displayable
from .needs import NeedsDensity, is_relative
from .saving import FILE_PATH, chosen_file
from .waiting import SavedInSteps

_DOTS_PER_INCH = 200.0
# Share of the work that is done when it is known how much there is.
_COUNTED = 0.9


class INSIDEOUT_OT_histogram_save(NeedsDensity, SavedInSteps, bpy.types.Operator):
    """Save how much there is of which density: .png or .pdf for pictures, .csv for numbers"""

    bl_idname = "insideout.histogram_save"
    bl_label = "Save Histogram..."

    filename_ext = ".png"
    # The user may type another; ExportHelper would append .png to it.
    check_extension = None
    filepath: FILE_PATH
    filter_glob: bpy.props.StringProperty(default="*.png;*.pdf;*.csv", options={"HIDDEN"})
    of: bpy.props.EnumProperty(
        name="Of",
        description="What is counted",
        items=(
            ("SECTION", "Section", "Area on the section plane, mm²"),
            ("MODEL", "Model", "Volume of the whole model, mm³; takes some seconds"),
        ),
        default="MODEL",
    )

    def steps(self, context: bpy.types.Context) -> Generator[float, None, set[str]]:
        try:
            path = chosen_file(self.filepath)
            if path.suffix.lower() not in (*PAGE_KINDS, ".csv"):
                raise SettingError(
                    "{file}: histograms are saved as .png, .pdf or .csv; choose one of them.", file=path.name
                )
            histogram = yield from part_of_work(measure_histogram(context.scene, self.of), 0.0, _COUNTED)
            if path.suffix.lower() == ".csv":
                save_histogram_csv(path, histogram, is_relative(context))
            else:
                with typesetter() as letter:
                    page = histogram_page(context.scene, self.of, histogram, letter)
                yield from part_of_work(save_page_in_steps(path, page, _DOTS_PER_INCH), _COUNTED, 1.0)
        except (InsideOutError, OSError, ValueError) as error:
            self.report({"ERROR"}, sentence(error))
            return {"CANCELLED"}
        self.report({"INFO"}, rpt_("Saved {path}").format(path=displayable(path)))
        return {"FINISHED"}


CLASSES = (INSIDEOUT_OT_histogram_save,)
