"""Reconstruct: run the engine and watch it."""

from __future__ import annotations

import json
from functools import cache, lru_cache

import blf
import bpy
from bpy.app.translations import pgettext_iface as iface_
from bpy.app.translations import pgettext_n as n_

from ..core.forecast.text import duration
from ..insideout_addon.effects import cannot_be_together, possible_effects
from ..insideout_addon.engine.commands import RECONSTRUCTING, forecast_subject, run_elsewhere
from ..insideout_addon.engine.curve_picture import CurvePoint, curve_points
from ..insideout_addon.engine.job import job_running
from ..insideout_addon.engine.progress_text import BLOCKS, rows, stage_lines
from .curve import draw_curve
from .job import draw_job
from .layout import SidebarPanel, wrapped

_STATE_ICONS = {"done": "CHECKMARK", "kept": "CHECKMARK", "started": "PLAY", "skipped": "REMOVE"}


class INSIDEOUT_PT_reconstruct(SidebarPanel, bpy.types.Panel):
    bl_label = "Reconstruct"
    bl_idname = "INSIDEOUT_PT_reconstruct"
    bl_order = 2

    def draw(self, context: bpy.types.Context) -> None:
        if context.scene.insideout.capture:
            _draw_settings(self.layout, context)
        else:
            # Nothing of it is of use yet, and who opens a finished run looks for what is below.
            wrapped(self.layout, "Choose a capture folder first, under Capture", context, "INFO")
        draw_job(self.layout, context, "reconstruct")
        _draw_stages(self.layout, context)


class INSIDEOUT_PT_run_curve(SidebarPanel, bpy.types.Panel):
    bl_label = "Quality over Time"
    bl_idname = "INSIDEOUT_PT_run_curve"
    bl_parent_id = "INSIDEOUT_PT_reconstruct"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        # Not while times are estimated: it would come and go.
        state = context.window_manager.insideout
        return bool(state.stages) or (_running(context) and state.title == RECONSTRUCTING)

    def draw(self, context: bpy.types.Context) -> None:
        draw_curve(self.layout, _points(context.window_manager.insideout.curve), "run", context)


class INSIDEOUT_PT_progress(SidebarPanel, bpy.types.Panel):
    bl_label = "Details"
    bl_idname = "INSIDEOUT_PT_progress"
    bl_parent_id = "INSIDEOUT_PT_reconstruct"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw(self, context: bpy.types.Context) -> None:
        _load_sparkline_font()
        column = self.layout.column(align=True)
        column.active = _running(context)
        column.scale_y = 0.85
        for name, value in rows(context.window_manager.insideout):
            row = column.split(factor=0.32)
            row.label(text=name)
            row.label(text=value, translate=False)


def _draw_settings(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """What a run is to do, and the button that starts it."""
    settings, column = context.scene.insideout, layout.column()
    column.use_property_split = True
    column.use_property_decorate = False
    column.enabled = not job_running()
    preset = column.column()
    preset.active = not settings.limit_time
    preset.prop(settings, "preset")
    _draw_time(column, context)
    column.prop(settings, "refine")
    _draw_effects(column, settings, context)
    column.prop(settings, "stage")
    column.prop(settings, "run")
    elsewhere = run_elsewhere(settings)
    if elsewhere is not None:
        wrapped(column, iface_("The next run goes to {folder}").format(folder=elsewhere), context, "INFO")
    column.prop(context.window_manager.insideout, "start_over")
    column.prop(settings, "import_when_done")
    if not _running(context):
        row = layout.row()
        row.scale_y = 1.3
        row.operator("insideout.reconstruct", icon="PLAY")


def _draw_time(column: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """What presets take and bring, if that was asked for this capture and route, and how much time the user gives."""
    settings, state = context.scene.insideout, context.window_manager.insideout
    if state.forecast_of == forecast_subject(settings):
        for row in state.forecasts:
            # With what cameras take it is wider than the sidebar; cut off it would lose its decibels.
            wrapped(column, _forecast_text(settings, row), context, "TIME")
        _draw_source(column, context)
    # Also below those that are known: photos may have come, or the machine was busy.
    column.operator("insideout.forecast", icon="TIME")
    limit = column.row(heading="Limit Time")
    limit.prop(settings, "limit_time", text="")
    minutes = limit.row()
    minutes.active = settings.limit_time
    minutes.prop(settings, "minutes", text="Minutes")


def _forecast_text(settings: bpy.types.PropertyGroup, row: bpy.types.PropertyGroup) -> str:
    preset = iface_(settings.bl_rna.properties["preset"].enum_items[row.name].name)
    told = [f"{preset}: ~{duration(row.seconds)}"]
    if row.cameras:
        told.append(iface_("more to find cameras"))
    if row.quality:
        least, most = round(row.least_db), round(row.most_db)
        told.append(f"~{least} dB" if least == most else f"{least}–{most} dB")
    return ", ".join(told)


def _draw_source(column: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Of what the decibels are, and where they are from."""
    state = context.window_manager.insideout
    of = next((row.quality for row in state.forecasts if row.quality), "")
    sources = {
        ("photos", False): n_("dB: photos kept back, of simulated objects; yours may lie outside"),
        ("photos", True): n_("dB: photos kept back, told from this run"),
        ("projections", False): n_("dB: projections kept back, of simulated objects; yours may lie outside"),
        ("projections", True): n_("dB: projections kept back, told from this run"),
    }
    if of:
        wrapped(column, sources[of, state.forecast_known], context)


def _draw_effects(column: bpy.types.UILayout, settings: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    """Whether effects are looked for, or a box for each that this capture can have."""
    column.prop(settings, "effects")
    if settings.effects != "NAMED":
        return
    possible = possible_effects(bpy.path.abspath(settings.capture))
    for name in possible:
        column.prop(settings.named_effects, name)
    if cannot_be_together(settings, possible):
        wrapped(column, "Motion Blur cannot be learned beside Rolling Shutter or Defocus", context, "ERROR")
    if not possible:
        column.label(text="No photos and no projections there", icon="INFO")


@cache
def _load_sparkline_font() -> None:
    """Takes 0.3 s, which belong to the click that opens the panel, not to the first losses in the middle of a run."""
    if not bpy.app.background:
        blf.size(0, 11)
        blf.dimensions(0, BLOCKS)


@lru_cache(maxsize=1)
def _points(curve: str) -> tuple[CurvePoint, ...]:
    return curve_points(json.loads(curve)) if curve else ()


def _running(context: bpy.types.Context) -> bool:
    return job_running() and context.window_manager.insideout.panel == "reconstruct"


def _draw_stages(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    state, running = context.window_manager.insideout, _running(context)
    if not (running or state.stages):
        return
    column = layout.column(align=True)
    for name, status, text in stage_lines(state, running):
        row = column.row()
        row.active = bool(status)
        broken_off = status == "started" and not running
        row.label(text=text, translate=False, icon="PAUSE" if broken_off else _STATE_ICONS.get(status, "DOT"))
        if status == "skipped":
            wrapped(column, state.stages[name].reason, context, "BLANK1")


CLASSES = (INSIDEOUT_PT_reconstruct, INSIDEOUT_PT_run_curve, INSIDEOUT_PT_progress)
