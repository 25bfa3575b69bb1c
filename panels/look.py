"""Look: what of the model is shown, and what its colours stand for."""

from __future__ import annotations

import bpy
from bpy.app.translations import pgettext_iface as iface_
from bpy.app.translations import pgettext_n as n_

from ..insideout_addon.remembered import remembered
from ..insideout_addon.scene.coloring import residual_window
from ..insideout_addon.scene.look import needs_a_look_inside
from ..insideout_addon.scene.splats import shown_model, shows_density
from .layout import SidebarPanel, draw_densities, draw_window, wrapped


class INSIDEOUT_PT_look(SidebarPanel, bpy.types.Panel):
    bl_label = "Look"
    bl_idname = "INSIDEOUT_PT_look"
    bl_parent_id = "INSIDEOUT_PT_model"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings, model = self.layout, context.scene.insideout, shown_model(context.scene)
        if model is None:
            wrapped(layout, "Import a model first", context, "INFO")
            return
        column = layout.column()
        column.use_property_split = True
        column.use_property_decorate = False
        _draw_color_by(column, settings)
        _draw_colors(column, model, settings, context)
        if needs_a_look_inside(model):
            # With its sliders Blender would wait, and nothing could end that.
            column.operator("insideout.look_prepare", icon="MOD_SKIN")
        elif shows_density(model):
            depth = column.column(align=True)
            depth.prop(settings, "peel_mm", slider=True)
            depth.prop(settings, "peel_layer_mm")
            low, high = n_("Denser Than (relative)"), n_("Less Dense Than (relative)")
            relative = {"peel_density_from": low, "peel_density_to": high}
            draw_densities(column.column(align=True), model, settings, relative)
        else:
            wrapped(layout, "Photos alone have no depth and no density to peel by", context, "INFO")
        layout.row().prop(settings, "modalities", expand=True)
        if settings.look_problem:
            wrapped(layout, settings.look_problem, context, "ERROR")
        layout.operator("insideout.look_reset", icon="LOOP_BACK")


def _draw_color_by(layout: bpy.types.UILayout, settings: bpy.types.PropertyGroup) -> None:
    """As the setting itself is drawn, with an operator that can be ended."""
    chosen = settings.bl_rna.properties["color_by"].enum_items[settings.color_by].name
    row = layout.split(factor=0.4)
    name = row.row()
    name.alignment = "RIGHT"
    name.label(text="Color By")
    row.operator_menu_enum("insideout.color_by", "color_by", text=iface_(chosen), translate=False)


def _draw_colors(
    layout: bpy.types.UILayout,
    model: bpy.types.Object,
    settings: bpy.types.PropertyGroup,
    context: bpy.types.Context,
) -> None:
    """The window of what the colours stand for; sections share that of densities."""
    if settings.color_by == "DENSITY" and shows_density(model):
        layout.prop(settings, "colors")
        draw_window(layout, model, settings)
    elif settings.color_by == "RESIDUAL":
        highest = _highest(model.data.session_uid, settings.residual_high)
        if highest is None:
            return
        layout.prop(settings, "colors")
        layout.prop(settings, "residual_high")
        scale = iface_("0 to {highest:.2g} % of the largest line integral, dark to bright")
        wrapped(layout, scale.format(highest=highest), context)
    elif settings.color_by == "MODALITY":
        wrapped(layout, "Photos yellow, X-rays blue, clones red", context)


@remembered
def _highest(uid: int, asked: float) -> float | None:
    """Residual shown brightest; `uid` is of the model's points: a linked model may share its name with another."""
    models = (thing for thing in bpy.data.objects if thing.type == "POINTCLOUD" and thing.data.session_uid == uid)
    window = residual_window(next(models), asked)
    return None if window is None else window[1]


CLASSES = (INSIDEOUT_PT_look,)
