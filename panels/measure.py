"""Measure: lengths, walls, single places, and sheets for reports."""

from __future__ import annotations

import bpy
from bpy.app.translations import pgettext_iface as iface_

from ..insideout_addon.measure.probe_result import kept_probe, lines
from ..insideout_addon.measure.rulers import TEXT_KEY, rulers
from ..insideout_addon.measure.thickness import ThicknessFigures
from ..insideout_addon.measure.thickness_map import is_out_of_date, measured_at, shown_figures, thickness_maps
from ..insideout_addon.scene.importing import lengths_are_arbitrary
from ..insideout_addon.scene.section import shown_plane
from ..insideout_addon.scene.section_picture import density_unit
from ..insideout_addon.scene.section_position import Position
from ..insideout_addon.scene.splats import shown_model, shows_density
from .layout import SidebarPanel, draw_scaled, wrapped

_MOST_RULERS = 5


class INSIDEOUT_PT_measure(SidebarPanel, bpy.types.Panel):
    bl_label = "Measure"
    bl_idname = "INSIDEOUT_PT_measure"
    bl_order = 5
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw(self, context: bpy.types.Context) -> None:
        layout, model = self.layout, shown_model(context.scene)
        if model is None:
            wrapped(layout, "Import a model first, under Model", context, "INFO")
            return
        draw_scaled(layout, model, context)
        _draw_points(layout, model, context)
        _draw_probe(layout, model, context)
        if not shows_density(model):
            layout.label(text="Photos alone have no density to measure", icon="INFO")
            return
        _draw_walls(layout, model, context)
        column = layout.column(align=True)
        column.operator("insideout.section_sheet", icon="FILE_IMAGE")
        column.operator("insideout.histogram_save", icon="SEQ_HISTOGRAM")


def _draw_points(layout: bpy.types.UILayout, model: bpy.types.Object, context: bpy.types.Context) -> None:
    row = layout.row(align=True)
    row.operator("insideout.point_add", icon="EMPTY_AXIS")
    row.operator("insideout.measure", text="Measure", icon="DRIVER_DISTANCE")
    found = rulers(context.scene, model)
    if not found:
        wrapped(
            layout, "Set the 3D cursor (Shift + right click), add a point, do so again, then measure", context, "INFO"
        )
    for ruler in found[-_MOST_RULERS:]:
        layout.label(text=ruler[TEXT_KEY], translate=False, icon="DRIVER_DISTANCE")


def _draw_probe(layout: bpy.types.UILayout, model: bpy.types.Object, context: bpy.types.Context) -> None:
    layout.operator("insideout.probe", icon="EYEDROPPER")
    found = kept_probe(context.scene, model)
    if found is not None:
        column = layout.column(align=True)
        for line in lines(found, not lengths_are_arbitrary(model), density_unit(context.scene)):
            wrapped(column, line, context)


def _draw_walls(layout: bpy.types.UILayout, model: bpy.types.Object, context: bpy.types.Context) -> None:
    if shown_plane(context.scene) is None:
        layout.label(text="Add a section plane to measure walls", icon="INFO")
        return
    row = layout.row(align=True)
    row.operator("insideout.thickness", icon="MOD_THICKNESS")
    row.operator("insideout.thickness_save", text="", icon="EXPORT")
    for drawn in thickness_maps(context.scene, model)[-1:]:
        column = layout.column(align=True)
        for line in (*_place_lines(measured_at(drawn)), *_walls_lines(shown_figures(drawn))):
            column.label(text=line, translate=False)
        if is_out_of_date(drawn, context.scene):
            wrapped(
                layout,
                "The plane, Contour or the splats have changed since; press Wall Thickness again",
                context,
                "INFO",
            )


def _place_lines(position: Position | None) -> list[str]:
    if position is None:
        return []
    oblique = iface_("{length} along {direction}").format(length=position.length, direction=position.direction)
    return [iface_("At {place}").format(place=position.text if position.axis else oblique)]


def _walls_lines(figures: ThicknessFigures) -> list[str]:
    without, texts = f"{100 * (1 - figures.measured):.0f} %", figures.texts()
    return [
        iface_("Least {least} mm, most {most} mm").format(**texts),
        iface_("Mean {mean} mm, median {median} mm").format(**texts),
        iface_("90 % between {p5} and {p95} mm").format(**texts),
        iface_("Edges without a wall: {share}").format(share=without),
    ]


CLASSES = (INSIDEOUT_PT_measure,)
