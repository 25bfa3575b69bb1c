"""Places points and measures between them."""

from __future__ import annotations

import bpy
from bpy.app.translations import pgettext_rpt as rpt_

from ..core.errors import InsideOutError
from ..insideout_addon.error_text import error_text
from ..insideout_addon.measure.rulers import (
    TEXT_KEY,
    add_point,
    add_ruler,
    is_measured,
    measured_model,
    place_in_model,
    selected_points,
    tell_copies_apart,
)
from ..insideout_addon.scene.splats import shown_model
from .needs import NeedsModel, nothing_in_work


class INSIDEOUT_OT_point_add(NeedsModel, bpy.types.Operator):
    """Put a point at the 3D cursor, to measure from"""

    bl_idname = "insideout.point_add"
    bl_label = "Add Point"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    location: bpy.props.FloatVectorProperty(
        name="Location (mm)",
        description="Where, in mm in the model's frame; if not given, at the 3D cursor",
        size=3,
        options={"SKIP_SAVE"},
    )

    def execute(self, context: bpy.types.Context) -> set[str]:
        model = shown_model(context.scene)
        # Before there is a newer one.
        tell_copies_apart(context.scene)
        try:
            given = self.properties.is_property_set("location")
            place = self.location if given else place_in_model(model, context.scene.cursor.location)
            point = add_point(model, place, context)
        except InsideOutError as error:
            self.report({"ERROR"}, error_text(error))
            return {"CANCELLED"}
        # With the model's points before it, to be measured together; what is measured already is done with.
        points = [other for other in selected_points(context) if other.parent == model]
        done = is_measured(points, context.scene)
        for other in context.view_layer.objects:
            if done or other not in points:
                other.select_set(False)
        point.select_set(True)
        context.view_layer.objects.active = point
        return {"FINISHED"}


class INSIDEOUT_OT_measure(bpy.types.Operator):
    """Measure the selected points in the order they were added: distance of two, angle and area of three, else area"""

    bl_idname = "insideout.measure"
    bl_label = "Measure Points"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if shown_model(context.scene) is None or len(selected_points(context)) < 2:
            cls.poll_message_set("Add two points or more, and select them")
            return False
        return nothing_in_work(cls)

    def execute(self, context: bpy.types.Context) -> set[str]:
        tell_copies_apart(context.scene)
        points, shown = selected_points(context), shown_model(context.scene)
        try:
            ruler, _ = add_ruler(measured_model(points, shown), points, context)
        except InsideOutError as error:
            self.report({"ERROR"}, error_text(error))
            return {"CANCELLED"}
        figures = ruler[TEXT_KEY]
        if ruler.parent != shown:
            figures = rpt_("On {model}: {figures}").format(model=ruler.parent.name, figures=figures)
        self.report({"INFO"}, figures)
        return {"FINISHED"}


CLASSES = (INSIDEOUT_OT_point_add, INSIDEOUT_OT_measure)
