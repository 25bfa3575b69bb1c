"""Section: cut the model and read the density on the cut."""

from __future__ import annotations

import bpy

from ..insideout_addon.scene.importing import lengths_are_arbitrary
from ..insideout_addon.scene.section import shown_plane
from ..insideout_addon.scene.splats import shown_model, shows_density
from .layout import SidebarPanel


class INSIDEOUT_PT_section(SidebarPanel, bpy.types.Panel):
    bl_label = "Section"
    bl_idname = "INSIDEOUT_PT_section"
    bl_order = 4

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.layout, context.scene.insideout
        plane = shown_plane(context.scene)
        if plane is None:
            layout.operator("insideout.section_add", icon="MESH_PLANE")
            return
        row = layout.row()
        row.label(text=plane.name, icon="MESH_PLANE")
        row.operator("insideout.section_remove", text="", icon="X")
        row = layout.row(align=True)
        row.prop(settings, "cut", toggle=True)
        row.prop(settings, "flip", toggle=True)
        row.prop(settings, "show_density", text="Density", toggle=True)
        column = layout.column()
        column.use_property_split = True
        column.use_property_decorate = False
        model = shown_model(context.scene)
        arbitrary = model is not None and lengths_are_arbitrary(model)
        column.prop(settings, "slab_mm", text="Slab" if arbitrary else "Slab (mm)")
        if arbitrary:
            layout.label(text="Lengths in an arbitrary unit: no X-ray", icon="INFO")
        if model is not None and not shows_density(model):
            layout.label(text="Photos alone have no density to show", icon="INFO")
            return
        density = column.column(align=True)
        density.active = settings.show_density
        density.prop(settings, "low")
        density.prop(settings, "high")
        density.operator("insideout.section_window")
        density.prop(settings, "pixels")
        layout.operator("insideout.section_save", icon="IMAGE_DATA")
        column = layout.column()
        column.use_property_split = True
        column.use_property_decorate = False
        column.prop(settings, "level", text="Contour (1/mm)")
        row = layout.row(align=True)
        row.operator("insideout.contours_save", icon="EXPORT")
        row.operator("insideout.contours_curve", text="As Curve", icon="OUTLINER_OB_CURVE")


CLASSES = (INSIDEOUT_PT_section,)
