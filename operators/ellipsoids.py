"""How the model is shown, and which of its splats are ellipsoids."""

from __future__ import annotations

import bpy
from bpy.app.translations import pgettext_rpt as rpt_

from ..core.errors import InsideOutError
from ..insideout_addon.error_text import error_text
from ..insideout_addon.properties import DISPLAY_ITEMS, DISPLAY_TEXT
from ..insideout_addon.scene.display import display_modifier
from ..insideout_addon.scene.kept_splats import kept_splats
from ..insideout_addon.scene.look import apply_look
from ..insideout_addon.scene.node_tree import modifier_input
from ..insideout_addon.scene.showing import add_box, choose_selected, has_selection, show_as
from ..insideout_addon.scene.splats import shown_model
from .needs import NeedsModel


class INSIDEOUT_OT_show_as(NeedsModel, bpy.types.Operator):
    """Show the model as points, as ellipsoids or as both"""

    bl_idname = "insideout.show_as"
    bl_label = "Show As"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    display: bpy.props.EnumProperty(name="Show As", description=DISPLAY_TEXT, items=DISPLAY_ITEMS)

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            with kept_splats.outlast(context.scene):
                show_as(shown_model(context.scene), self.display)
                apply_look(context.scene)
        except InsideOutError as error:
            self.report({"ERROR"}, error_text(error))
            return {"CANCELLED"}
        return {"FINISHED"}


class INSIDEOUT_OT_ellipsoids_selected(NeedsModel, bpy.types.Operator):
    """Show the splats selected in Edit Mode as ellipsoids, before all others; with none selected forget them"""

    bl_idname = "insideout.ellipsoids_selected"
    bl_label = "Ellipsoids for Selected"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    extend: bpy.props.BoolProperty(name="Extend", description="Keep those that were chosen before", default=False)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not super().poll(context):
            return False
        if not has_selection(shown_model(context.scene)):
            cls.poll_message_set("Select splats of the model in Edit Mode first")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        model = shown_model(context.scene)
        try:
            count = choose_selected(model, self.extend)
        except InsideOutError as error:
            self.report({"ERROR"}, error_text(error))
            return {"CANCELLED"}
        most = modifier_input(display_modifier(model), "Ellipsoids at Most")
        if count > most:
            told = rpt_("{count:,} splats chosen, only the {most:,} largest are ellipsoids; raise Ellipsoids at Most")
            self.report({"WARNING"}, told.format(count=count, most=most))
        else:
            self.report({"INFO"}, rpt_("{count:,} splats chosen").format(count=count))
        return {"FINISHED"}


class INSIDEOUT_OT_ellipsoids_box(NeedsModel, bpy.types.Operator):
    """Show the splats in a box as ellipsoids; you can move, turn and scale it"""

    bl_idname = "insideout.ellipsoids_box"
    bl_label = "Ellipsoids in Box"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            box = add_box(shown_model(context.scene), context)
        except InsideOutError as error:
            self.report({"ERROR"}, error_text(error))
            return {"CANCELLED"}
        if context.mode == "OBJECT":
            for other in context.view_layer.objects:
                other.select_set(other == box)
            context.view_layer.objects.active = box
        return {"FINISHED"}


CLASSES = (INSIDEOUT_OT_show_as, INSIDEOUT_OT_ellipsoids_selected, INSIDEOUT_OT_ellipsoids_box)
