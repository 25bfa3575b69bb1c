"""Section: cut the model and read the density on the cut."""

from __future__ import annotations

import bpy

from .layout import SidebarPanel


class INSIDEOUT_PT_section(SidebarPanel, bpy.types.Panel):
    bl_label = "Section"
    bl_idname = "INSIDEOUT_PT_section"
    bl_order = 4

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.layout, context.scene.insideout
        if settings.plane is None:
            layout.operator("insideout.section_add", icon="MESH_PLANE")
            return
        layout.prop(settings, "plane", text="")
        row = layout.row(align=True)
        row.prop(settings, "cut", toggle=True)
        row.prop(settings, "flip", toggle=True)
        row.prop(settings, "show_density", text="Density", toggle=True)
        column = layout.column()
        column.use_property_split = True
        column.use_property_decorate = False
        column.prop(settings, "slab_mm")
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
