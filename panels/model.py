"""Model: bring a run's splats into the scene."""

from __future__ import annotations

from pathlib import Path

import bpy

from ..core.errors import InsideOutError
from ..insideout_addon.scene.display import display_modifier
from ..insideout_addon.scene.importing import find_set
from ..insideout_addon.scene.memory import chosen_display, import_cost
from ..insideout_addon.scene.splats import is_splats
from .layout import SidebarPanel, bytes_text, wrapped


class INSIDEOUT_PT_model(SidebarPanel, bpy.types.Panel):
    bl_label = "Model"
    bl_idname = "INSIDEOUT_PT_model"
    bl_order = 3

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.layout, context.scene.insideout
        layout.prop(settings, "run", text="Run")
        layout.row().prop(settings, "which", expand=True)
        column = layout.column()
        column.use_property_split = True
        column.use_property_decorate = False
        column.prop(settings, "display")
        column.prop(settings, "view_dependent")
        if settings.run:
            _draw_cost(layout, settings, context)
        layout.operator("insideout.import_run", icon="IMPORT")
        layout.prop(settings, "model", text="Shown")
        if is_splats(settings.model):
            modifier = display_modifier(settings.model)
            if modifier is not None:
                layout.label(text=f"{len(settings.model.data.points):,} splats; see the modifier for size", icon="INFO")


def _draw_cost(layout: bpy.types.UILayout, settings: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    try:
        path = find_set(Path(bpy.path.abspath(settings.run)), settings.which)
        cost = import_cost(path, settings.display, settings.view_dependent)
    except (InsideOutError, OSError) as error:
        wrapped(layout, str(error), context, "INFO")
        return
    shown = chosen_display(settings.display, cost.splats).lower()
    box = layout.box()
    box.label(text=f"{cost.splats:,} splats as {shown}")
    box.label(text=f"Memory {bytes_text(cost.scene_bytes)}, Cycles {bytes_text(cost.cycles_bytes)} more")


CLASSES = (INSIDEOUT_PT_model,)
