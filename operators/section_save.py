"""Saves the section as an image."""

from __future__ import annotations

from collections.abc import Generator

import bpy
from bpy.app.translations import pgettext_rpt as rpt_

from ..core.errors import InsideOutError
from ..core.steps import part_of_work
from ..insideout_addon.error_text import sentence
from ..insideout_addon.scene.importing import densities_are_relative
from ..insideout_addon.scene.section import seen_in_steps
from ..insideout_addon.scene.section_image import Window, save_figures_in_steps, save_values
from ..insideout_addon.scene.section_picture import (
    forget_scan_unless_shown,
    only_scan_is_relative,
    picture_of,
    scan_in_steps,
)
from ..insideout_addon.scene.splats import shown_model
from ..insideout_addon.told_text import displayable
from .needs import NeedsPlane
from .saving import FILE_PATH, chosen_file
from .waiting import SavedInSteps

# Shares of the work that are done when the model is cut, the scan is read and cut, and all pictures are coloured.
_CUT, _SCANNED, _COLOURED = 0.2, 0.6, 0.7


class INSIDEOUT_OT_section_save(NeedsPlane, SavedInSteps, bpy.types.Operator):
    """Save the density on the plane as a PNG of real size"""

    bl_idname = "insideout.section_save"
    bl_label = "Save Section..."

    filename_ext = ".png"
    filepath: FILE_PATH
    filter_glob: bpy.props.StringProperty(default="*.png", options={"HIDDEN"})
    content: bpy.props.EnumProperty(
        name="Content",
        description="What is saved of the section",
        items=(
            ("COLOURS", "Colors", "The model's density with its color bar"),
            ("COMPARISON", "Comparison", "The model, the CT on the same plane, and their difference"),
            ("VALUES", "Values", "16-bit gray, linear in density between Low and High"),
        ),
    )

    def steps(self, context: bpy.types.Context) -> Generator[float, None, set[str]]:
        # Before any break: an undo there leaves no references.
        window = Window(context.scene.insideout.low, context.scene.insideout.high)
        kinds = ("MODEL", "CT", "DIFFERENCE") if self.content == "COMPARISON" else ("MODEL",)
        without = self.content == "COMPARISON" and only_scan_is_relative(shown_model(context.scene))
        if without:
            kinds = ("MODEL", "CT")
        try:
            path = chosen_file(self.filepath)
            values, plane = yield from part_of_work(seen_in_steps(context.scene), 0.0, _CUT)
            if self.content == "VALUES":
                model = shown_model(context.scene)
                save_values(path, values, window, plane, model is not None and densities_are_relative(model))
            else:
                scanned, pictures = None, []
                if self.content == "COMPARISON":
                    scanning = scan_in_steps(plane, shown_model(context.scene))
                    scanned = yield from part_of_work(scanning, _CUT, _SCANNED)
                for kind in kinds:
                    pictures.append(picture_of(values, plane, context.scene, kind, scanned))
                    yield _SCANNED + (_COLOURED - _SCANNED) * len(pictures) / len(kinds)
                saving = save_figures_in_steps(path, pictures, window, plane)
                yield from part_of_work(saving, _COLOURED, 1.0)
        except (InsideOutError, OSError, ValueError) as error:
            self.report({"ERROR"}, sentence(error))
            return {"CANCELLED"}
        finally:
            forget_scan_unless_shown()
        if without:
            said = rpt_("Saved {path} without a difference: gray values of the CT have no unit")
            self.report({"WARNING"}, said.format(path=displayable(path)))
        else:
            self.report({"INFO"}, rpt_("Saved {path}").format(path=displayable(path)))
        return {"FINISHED"}


CLASSES = (INSIDEOUT_OT_section_save,)
