"""Section: cut the model and read the density on the cut."""

from __future__ import annotations

import bpy

from ..insideout_addon.scene.ct_volume import has_volume
from ..insideout_addon.scene.following import is_bent
from ..insideout_addon.scene.importing import densities_are_relative, lengths_are_arbitrary
from ..insideout_addon.scene.look import is_peeled
from ..insideout_addon.scene.section import active_section, plane_position, shown_planes
from ..insideout_addon.scene.section_cut import hides_whole_splats
from ..insideout_addon.scene.section_picture import only_scan_is_relative
from ..insideout_addon.scene.splats import shown_model, shows_density
from .layout import SidebarPanel, draw_scaled, draw_window, wrapped

_ICONS = {"PLANE": "MESH_PLANE", "BOX": "MESH_CUBE"}


class INSIDEOUT_UL_sections(bpy.types.UIList):
    """Sections by the names of their objects, each with the switch for its cut."""

    bl_idname = "INSIDEOUT_UL_sections"

    def draw_item(
        self,
        context: bpy.types.Context,
        layout: bpy.types.UILayout,
        data: bpy.types.PropertyGroup,
        item: bpy.types.PropertyGroup,
        icon: int,
        active_data: bpy.types.PropertyGroup,
        active_property: str,
    ) -> None:
        if item.object is None:
            layout.label(text="Deleted", icon="ERROR")
            return
        layout.prop(item.object, "name", text="", emboss=False, icon=_ICONS[item.shape])
        layout.prop(item, "cut", text="", emboss=False, icon="HIDE_OFF" if item.cut else "HIDE_ON")


class INSIDEOUT_PT_section(SidebarPanel, bpy.types.Panel):
    bl_label = "Section"
    bl_idname = "INSIDEOUT_PT_section"
    bl_order = 4

    def draw(self, context: bpy.types.Context) -> None:
        layout, scene = self.layout, context.scene
        settings, section = scene.insideout, active_section(scene)
        if section is None:
            layout.operator("insideout.section_add", icon="MESH_PLANE")
            layout.operator("insideout.section_add_box", icon="MESH_CUBE")
            if shown_model(scene) is None:
                wrapped(layout, "Import a model first, under Model", context, "INFO")
            return
        _draw_list(layout, settings)
        model = shown_model(scene)
        _draw_cut(layout, section, model, context)
        if model is not None and not shows_density(model):
            layout.label(text="Photos alone have no density to show", icon="INFO")
        else:
            _draw_density(layout, settings, section, model, context)
            if model is not None and shown_planes(scene):
                draw_scaled(layout, model, context)


def _draw_list(layout: bpy.types.UILayout, settings: bpy.types.PropertyGroup) -> None:
    row = layout.row()
    row.template_list("INSIDEOUT_UL_sections", "", settings, "sections", settings, "section_index", rows=3)
    column = row.column(align=True)
    column.operator("insideout.section_add", text="", icon="MESH_PLANE")
    column.operator("insideout.section_add_box", text="", icon="MESH_CUBE")
    column.operator("insideout.section_remove", text="", icon="REMOVE")


def _draw_cut(
    layout: bpy.types.UILayout,
    section: bpy.types.PropertyGroup,
    model: bpy.types.Object | None,
    context: bpy.types.Context,
) -> None:
    """What of the model the chosen plane or box hides."""
    row = layout.row(align=True)
    row.prop(section, "cut", toggle=True)
    if section.cut and model is not None and hides_whole_splats(model, section):
        wrapped(layout, "Too many cuts: this one hides whole splats, so its faces are rough", context, "INFO")
    if section.shape == "BOX":
        row.prop(section, "flip", text="Hide Inside", toggle=True)
        row.prop(section, "show_density", text="Density", toggle=True)
        return
    row.prop(section, "flip", toggle=True)
    row.prop(section, "show_density", text="Density", toggle=True)
    arbitrary = model is not None and lengths_are_arbitrary(model)
    column = _column(layout)
    position = plane_position(section)
    if position is not None:
        _draw_place(column, section, position.axis, arbitrary)
    column.prop(section, "slab_mm", text="Slab" if arbitrary else "Slab (mm)")
    column.prop(section, "apart_mm", text="Apart" if arbitrary else "Apart (mm)")
    if arbitrary:
        layout.label(text="Lengths in an arbitrary unit: no X-ray", icon="INFO")


def _draw_place(layout: bpy.types.UILayout, section: bpy.types.PropertyGroup, axis: str, arbitrary: bool) -> None:
    """Where in the model the plane lies, and which of the model's axes it faces."""
    layout.prop(section, "position_mm", text="Position" if arbitrary else "Position (mm)")
    row = layout.row(align=True, heading="At Right Angles To")
    for name in ("X", "Y", "Z"):
        row.operator("insideout.section_face", text=name, depress=name.lower() == axis).axis = name


def _draw_density(
    layout: bpy.types.UILayout,
    settings: bpy.types.PropertyGroup,
    section: bpy.types.PropertyGroup,
    model: bpy.types.Object | None,
    context: bpy.types.Context,
) -> None:
    """How densities are shown, and what can be saved of the section."""
    density = _column(layout)
    density.active = section.show_density
    density.prop(section, "picture")
    if section.shape == "PLANE":
        beside = density.column()
        beside.active = section.picture == "MODEL"
        beside.prop(section, "beside")
    if section.picture != "MODEL" or section.beside != "NONE":
        if not has_volume(section.id_data.insideout.model):
            density.label(text="The model's run has no CT volume here", icon="ERROR")
        elif model is not None and is_bent(model):
            wrapped(density, "A soft body is not shown with its CT while it is bent", context, "INFO")
        elif only_scan_is_relative(model):
            wrapped(density, "Gray values of the CT have no unit: no difference to the model is shown", context, "INFO")
    draw_window(density, model, settings)
    density.prop(settings, "colors")
    if model is not None and densities_are_relative(model):
        density.label(text="Gray values: densities are relative", icon="INFO")
    else:
        density.prop(settings, "unit")
        if settings.unit == "HU":
            density.prop(settings, "water")
    density.prop(settings, "pixels")
    if is_peeled(settings):
        density.label(text="Pictures show the whole model, peeled or not", icon="INFO")
    if not shown_planes(section.id_data):
        return
    layout.operator("insideout.section_save", icon="IMAGE_DATA")
    if model is not None and densities_are_relative(model):
        _column(layout).prop(settings, "level", text="Contour (relative)")
    else:
        _column(layout).prop(settings, "level", text="Contour (mm⁻¹)")
    row = layout.row(align=True)
    row.operator("insideout.contours_save", icon="EXPORT")
    row.operator("insideout.contours_curve", text="As Curve", icon="OUTLINER_OB_CURVE")


def _column(layout: bpy.types.UILayout) -> bpy.types.UILayout:
    column = layout.column()
    column.use_property_split = True
    column.use_property_decorate = False
    return column


CLASSES = (INSIDEOUT_UL_sections, INSIDEOUT_PT_section)
