"""Looks at one place of the model."""

from __future__ import annotations

import bpy

from ..core.errors import InsideOutError
from ..insideout_addon.error_text import error_text
from ..insideout_addon.measure.probe import probe
from ..insideout_addon.measure.probe_result import keep_probe, told
from ..insideout_addon.measure.rulers import place_in_model
from ..insideout_addon.scene.following import as_shown
from ..insideout_addon.scene.importing import lengths_are_arbitrary
from ..insideout_addon.scene.section_picture import density_unit
from ..insideout_addon.scene.splats import read_splats, shown_model
from .needs import NeedsModel


class INSIDEOUT_OT_probe(NeedsModel, bpy.types.Operator):
    """Tell density, color and the nearest splat at the 3D cursor"""

    bl_idname = "insideout.probe"
    bl_label = "Probe at Cursor"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    point: bpy.props.FloatVectorProperty(
        name="Point (mm)",
        description="Where, in mm in the model's frame; if not given, at the 3D cursor",
        size=3,
        options={"SKIP_SAVE"},
    )

    def execute(self, context: bpy.types.Context) -> set[str]:
        scene = context.scene
        model = shown_model(scene)
        try:
            given = self.properties.is_property_set("point")
            place = self.point if given else place_in_model(model, scene.cursor.location)
            found = probe(as_shown(model, read_splats(model)), place)
        except InsideOutError as error:
            self.report({"ERROR"}, error_text(error))
            return {"CANCELLED"}
        keep_probe(scene, model, found)
        self.report({"INFO"}, told(found, not lengths_are_arbitrary(model), density_unit(scene)))
        return {"FINISHED"}


CLASSES = (INSIDEOUT_OT_probe,)
