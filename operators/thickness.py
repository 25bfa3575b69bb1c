"""Measures the walls on the section."""

from __future__ import annotations

from collections.abc import Generator

import bpy
from bpy.app.translations import pgettext_rpt as rpt_

from ..core.errors import InsideOutError
from ..core.steps import part_of_work
from ..insideout_addon.error_text import error_text, sentence
from ..insideout_addon.measure.of_scene import measure_walls
from ..insideout_addon.measure.thickness import ThicknessFigures
from ..insideout_addon.measure.thickness_map import create_thickness_map
from ..insideout_addon.scene.contour_files import save_csv_in_steps
from ..insideout_addon.told_text import displayable
from .needs import NeedsPlane
from .saving import FILE_PATH, chosen_file
from .waiting import InSteps, SavedInSteps

# Share of the work that is done when the walls are measured.
_MEASURED = 0.9


class INSIDEOUT_OT_thickness(NeedsPlane, InSteps, bpy.types.Operator):
    """Color the outlines on the section plane by how thick the wall is: the largest circle that fits in there"""

    bl_idname = "insideout.thickness"
    bl_label = "Wall Thickness"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def steps(self, context: bpy.types.Context) -> Generator[float, None, set[str]]:
        try:
            walls = yield from measure_walls(context.scene)
        except (InsideOutError, ValueError) as error:
            self.report({"ERROR"}, error_text(error))
            return {"CANCELLED"}
        create_thickness_map(walls, context.scene.insideout.model, context)
        self.report({"INFO"}, told(walls.figures))
        return {"FINISHED"}


class INSIDEOUT_OT_thickness_save(NeedsPlane, SavedInSteps, bpy.types.Operator):
    """Save the contours on the section plane with the wall's thickness at each point, in mm"""

    bl_idname = "insideout.thickness_save"
    bl_label = "Save Thickness..."

    filename_ext = ".csv"
    filepath: FILE_PATH
    filter_glob: bpy.props.StringProperty(default="*.csv", options={"HIDDEN"})

    def steps(self, context: bpy.types.Context) -> Generator[float, None, set[str]]:
        try:
            path = chosen_file(self.filepath)
            walls = yield from part_of_work(measure_walls(context.scene), 0.0, _MEASURED)
            yield from part_of_work(save_csv_in_steps(path, walls.contours, walls.thickness), _MEASURED, 1.0)
        except (InsideOutError, OSError, ValueError) as error:
            self.report({"ERROR"}, sentence(error))
            return {"CANCELLED"}
        saved = rpt_("{figures}; saved as {file}")
        self.report({"INFO"}, saved.format(figures=told(walls.figures), file=displayable(path.name)))
        return {"FINISHED"}


def told(figures: ThicknessFigures) -> str:
    """Thickness in one line."""
    text = rpt_("Walls {least} to {most} mm thick, mean {mean}, median {median}, along {share} of the contours")
    return text.format(**figures.texts(), share=f"{100 * figures.measured:.0f} %")


CLASSES = (INSIDEOUT_OT_thickness, INSIDEOUT_OT_thickness_save)
