"""Model: bring a run's splats into the scene."""

from __future__ import annotations

import os
from pathlib import Path

import bpy
from bpy.app.translations import pgettext_iface as iface_
from bpy.app.translations import pgettext_n as n_

from ..core.errors import InsideOutError
from ..insideout_addon.error_text import sentence
from ..insideout_addon.remembered import remembered
from ..insideout_addon.scene.display import display_modifier
from ..insideout_addon.scene.exporting import is_edited_by_modifiers
from ..insideout_addon.scene.importing import BODY_KEY, find_set, lengths_are_arbitrary, warnings_of
from ..insideout_addon.scene.memory import ImportCost, import_cost
from ..insideout_addon.scene.node_tree import input_property
from ..insideout_addon.scene.provenance import curve_of, provenance_of
from ..insideout_addon.scene.provenance_text import effect_lines, provenance_lines
from ..insideout_addon.scene.showing import shown_as
from ..insideout_addon.scene.sources import source_name, source_path
from ..insideout_addon.scene.splats import shown_model
from ..insideout_addon.told_text import displayable
from .curve import draw_curve
from .layout import SidebarPanel, bytes_text, shortened, wrapped

_MOST_WARNINGS = 3
_BEFORE_MODIFIERS = n_("Sections, measures and weights are of the splats before your modifiers; apply those first")


def _split(layout: bpy.types.UILayout) -> bpy.types.UILayout:
    """A column with room for whole labels."""
    column = layout.column()
    column.use_property_split = True
    column.use_property_decorate = False
    return column


class INSIDEOUT_PT_model(SidebarPanel, bpy.types.Panel):
    bl_label = "Model"
    bl_idname = "INSIDEOUT_PT_model"
    bl_order = 3

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.layout, context.scene.insideout
        _split(layout).prop(settings, "run")
        layout.row().prop(settings, "which", expand=True)
        column = _split(layout)
        column.prop(settings, "display")
        column.prop(settings, "view_dependent")
        if settings.run:
            source = _source(bpy.path.abspath(settings.run), settings.which)
            draw_cost(layout, source, settings, context)
        elif shown_model(context.scene) is None:
            wrapped(layout, "Choose the folder of a finished run, then import it", context, "INFO")
        row = layout.row(align=True)
        row.operator("insideout.import_run", icon="IMPORT")
        row.operator("insideout.import_file", icon="FILE_FOLDER")
        layout.prop(settings, "model", text="Shown")
        model = shown_model(context.scene)
        if model is not None and display_modifier(model) is not None:
            shown = iface_("{count:,} splats").format(count=len(model.data.points))
            layout.label(text=shown, translate=False, icon="INFO")
            _draw_display(layout, model, context)
            _draw_facts(layout, model, settings, context)
            layout.operator("insideout.export_file", icon="EXPORT")


class INSIDEOUT_PT_model_curve(SidebarPanel, bpy.types.Panel):
    bl_label = "Quality over Time"
    bl_idname = "INSIDEOUT_PT_model_curve"
    bl_parent_id = "INSIDEOUT_PT_model"
    # Where the run was made just now, Reconstruct shows the same.
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        model = shown_model(context.scene)
        return model is not None and bool(curve_of(model))

    def draw(self, context: bpy.types.Context) -> None:
        draw_curve(self.layout, curve_of(shown_model(context.scene)), "model", context)


def _draw_display(layout: bpy.types.UILayout, model: bpy.types.Object, context: bpy.types.Context) -> None:
    """How the model is shown, and of mixed ones which splats are ellipsoids."""
    shown = shown_as(model)
    if not shown:
        return
    way = iface_(context.scene.insideout.bl_rna.properties["display"].enum_items[shown].name)
    told = iface_("Shown as {way}").format(way=way)
    layout.operator_menu_enum("insideout.show_as", "display", text=told, translate=False)
    if shown == "MIXED":
        owner, path = input_property(display_modifier(model), "Ellipsoids at Most")
        layout.prop(owner, path, text="Ellipsoids at Most")
        layout.operator("insideout.ellipsoids_box", icon="MESH_CUBE")
        layout.operator("insideout.ellipsoids_selected", icon="RESTRICT_SELECT_OFF")


def _draw_facts(
    layout: bpy.types.UILayout, model: bpy.types.Object, settings: bpy.types.PropertyGroup, context: bpy.types.Context
) -> None:
    """What the model's run says about it."""
    source = source_path(model)
    if source is not None and _is_missing(source):
        row = layout.row(align=True)
        missing = iface_("{file} is missing").format(file=displayable(source_name(model)))
        row.label(text=missing, translate=False, icon="ERROR")
        row.operator("insideout.relink")
    for line in provenance_lines(provenance_of(model)):
        wrapped(layout, line, context)
    _draw_effects(layout, model, context)
    if model.get(BODY_KEY):
        layout.prop(settings, "hide_background")
    if lengths_are_arbitrary(model):
        layout.label(text="Lengths in an arbitrary unit: no X-ray", icon="INFO")
    if is_edited_by_modifiers(model):
        wrapped(layout, iface_(_BEFORE_MODIFIERS), context, "INFO")
    warnings = warnings_of(model)
    for warning in warnings[:_MOST_WARNINGS]:
        wrapped(layout, shortened(warning, 200), context, "ERROR")
    if len(warnings) > _MOST_WARNINGS:
        more = iface_("{count} more in report.json").format(count=len(warnings) - _MOST_WARNINGS)
        layout.label(text=more, translate=False, icon="BLANK1")


def _draw_effects(layout: bpy.types.UILayout, model: bpy.types.Object, context: bpy.types.Context) -> None:
    """What the model's run found of effects, as the capture's findings are shown."""
    lines = effect_lines(provenance_of(model))
    if not lines:
        return
    box = layout.box()
    box.label(text="Effects")
    for line in lines:
        icon = "CHECKMARK" if line.used else "QUESTION" if line.found is None else "REMOVE"
        wrapped(box, line.told, context, icon)
        wrapped(box, line.reason, context, "BLANK1")


def draw_cost(
    layout: bpy.types.UILayout,
    source: Path | str,
    settings: bpy.types.PropertyGroup,
    context: bpy.types.Context,
) -> None:
    """What importing a .ply will cost; where `source` is no path it says why there is none."""
    cost = _cost(source, settings.display, settings.view_dependent) if isinstance(source, Path) else source
    if isinstance(cost, str):
        wrapped(layout, cost, context, "INFO")
        return
    box = layout.box()
    if 0 < cost.ellipsoids < cost.splats:
        some = iface_("{count:,} splats, at most {most:,} as ellipsoids")
        wrapped(box, some.format(count=cost.splats, most=cost.ellipsoids), context)
    else:
        splats = iface_("{count:,} splats as ellipsoids") if cost.ellipsoids else iface_("{count:,} splats as points")
        box.label(text=splats.format(count=cost.splats), translate=False)
    memory = iface_("Memory {scene}, Cycles {render} more")
    told = memory.format(scene=bytes_text(cost.scene_bytes), render=bytes_text(cost.cycles_bytes))
    box.label(text=told, translate=False)


@remembered
def _is_missing(source: Path) -> bool:
    return not os.path.isfile(source)


@remembered
def _source(run: str, which: str) -> Path | str:
    """The .ply of a run, or why there is none."""
    try:
        return find_set(Path(run), which)
    except (InsideOutError, OSError) as error:
        return sentence(error)


@remembered
def _cost(source: Path, display: str, view_dependent: bool) -> ImportCost | str:
    """What importing will cost, or why that cannot be said."""
    try:
        return import_cost(source, display, view_dependent)
    except (InsideOutError, OSError) as error:
        return sentence(error)


CLASSES = (INSIDEOUT_PT_model, INSIDEOUT_PT_model_curve)
