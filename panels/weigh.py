"""Weigh: what the model weighs, where it balances, and its closed hollows."""

from __future__ import annotations

import bpy
from bpy.app.translations import pgettext_iface as iface_
from bpy.app.translations import pgettext_n as n_

from ..core.mesh.weight import center_text, mass_text, volume_text
from ..insideout_addon.scene.splats import shown_model, shows_density
from ..insideout_addon.scene.weighing import kept_weight
from ..insideout_addon.scene.weight_text import GUESS, cavities_text, mass_is_a_guess, moments_text
from .layout import SidebarPanel, draw_scaled, wrapped

_MOST_CAVITIES = 5
# Part of a row that is its name.
_NAME = 0.32


class INSIDEOUT_PT_weigh(SidebarPanel, bpy.types.Panel):
    bl_label = "Weigh"
    bl_idname = "INSIDEOUT_PT_weigh"
    bl_order = 6
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw(self, context: bpy.types.Context) -> None:
        layout, model = self.layout, shown_model(context.scene)
        if model is None:
            wrapped(layout, "Import a model first, under Model", context, "INFO")
            return
        if not shows_density(model):
            wrapped(layout, "Photos alone have no density to weigh", context, "INFO")
            return
        draw_scaled(layout, model, context)
        layout.operator("insideout.weigh")
        weight = kept_weight(model)
        if weight is None:
            wrapped(
                layout,
                "Choose what attenuation means in g/cm³, then see mass, balance and cavities",
                context,
                "INFO",
            )
            return
        box = layout.box().column(align=True)
        _row(box, n_("Mass"), mass_text(weight.properties.mass_g))
        _row(box, n_("Center of Mass"), center_text(weight.properties.center_mm))
        _row(box, n_("Moments"), moments_text(weight.properties.principal_moments))
        if weight.cavities is not None:
            _row(box, n_("Cavities"), cavities_text(weight.cavities))
            for cavity in weight.cavities[:_MOST_CAVITIES]:
                # Both in one column would be cut off in a sidebar that nobody has widened.
                row = box.split(factor=_NAME)
                row.label(text=volume_text(cavity.volume_mm3), translate=False)
                row.label(text=center_text(cavity.center_mm), translate=False)
        wrapped(
            layout,
            iface_("Attenuation read as mass density by {calibration}").format(calibration=weight.calibration),
            context,
        )
        if mass_is_a_guess(model):
            wrapped(layout, GUESS, context, "ERROR")
        row = layout.row(align=True)
        row.operator("insideout.weigh_center", text="Center of Mass", icon="EMPTY_ARROWS")
        row.operator("insideout.weigh_save", text="Save Table...", icon="EXPORT")


def _row(layout: bpy.types.UILayout, name: str, value: str) -> None:
    row = layout.split(factor=_NAME)
    row.label(text=name)
    row.label(text=value, translate=False)


CLASSES = (INSIDEOUT_PT_weigh,)
