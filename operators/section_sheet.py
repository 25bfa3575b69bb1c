"""Saves evenly spaced sections on one sheet."""

from __future__ import annotations

from collections.abc import Generator

import bpy
from bpy.app.translations import pgettext_rpt as rpt_

from ..core.errors import InsideOutError, SettingError
from ..core.steps import part_of_work
from ..insideout_addon.error_text import sentence
from ..insideout_addon.measure.of_scene import sheet_page
from ..insideout_addon.measure.pdf import PAGE_KINDS, save_page_in_steps
from ..insideout_addon.measure.typesetting import typesetter
from ..insideout_addon.told_text import displayable
from .needs import NeedsDensity
from .saving import FILE_PATH, chosen_file
from .waiting import SavedInSteps

# Share of the work that is done when the page is drawn.
_DRAWN = 0.7


class INSIDEOUT_OT_section_sheet(NeedsDensity, SavedInSteps, bpy.types.Operator):
    """Save evenly spaced sections through the model on one sheet in one scale, for a report: .pdf or .png"""

    bl_idname = "insideout.section_sheet"
    bl_label = "Save Section Sheet..."
    bl_options = {"PRESET"}  # noqa: RUF012

    filename_ext = ".pdf"
    # The user may type .png; ExportHelper would append .pdf to it.
    check_extension = None
    filepath: FILE_PATH
    filter_glob: bpy.props.StringProperty(default="*.pdf;*.png", options={"HIDDEN"})
    axis: bpy.props.EnumProperty(
        name="Along",
        description="The direction in which sections follow each other",
        items=(
            ("X", "X", "Sections at right angles to the model's x"),
            ("Y", "Y", "Sections at right angles to the model's y"),
            ("Z", "Z", "Sections at right angles to the model's z, the scanner's axis"),
            ("PLANE", "Section Plane", "Sections parallel to the section plane"),
        ),
        default="Z",
    )
    count: bpy.props.IntProperty(name="Sections", description="How many", default=12, min=1, max=100)
    real_size: bpy.props.BoolProperty(
        name="Real Size", description="Scale 1:1 on paper as large as it takes, else the largest scale that fits on A4"
    )
    dots_per_inch: bpy.props.FloatProperty(
        name="Resolution (dpi)", description="Dots per inch of paper", default=200.0, min=50.0, max=600.0
    )

    def steps(self, context: bpy.types.Context) -> Generator[float, None, set[str]]:
        try:
            path = chosen_file(self.filepath)
            if path.suffix.lower() not in PAGE_KINDS:
                raise SettingError(
                    "{file}: section sheets are saved as .pdf or .png; choose one of them.", file=path.name
                )
            with typesetter() as letter:
                drawing = sheet_page(context.scene, self.axis, self.count, letter, self.dots_per_inch, self.real_size)
                page = yield from part_of_work(drawing, 0.0, _DRAWN)
            yield from part_of_work(save_page_in_steps(path, page, self.dots_per_inch), _DRAWN, 1.0)
        except (InsideOutError, OSError, ValueError) as error:
            self.report({"ERROR"}, sentence(error))
            return {"CANCELLED"}
        told = rpt_("1 section saved as {file}") if self.count == 1 else rpt_("{count} sections saved as {file}")
        self.report({"INFO"}, told.format(count=self.count, file=displayable(path.name)))
        return {"FINISHED"}


CLASSES = (INSIDEOUT_OT_section_sheet,)
