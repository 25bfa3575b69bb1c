"""A run's curve: its picture, with decibels beside it, seconds below, and what each line has reached."""

from __future__ import annotations

from collections.abc import Sequence

import bpy
from bpy.app.translations import pgettext_iface as iface_
from bpy.app.translations import pgettext_n as n_

from ..insideout_addon.engine.curve_icons import curve_icon, mark_icon
from ..insideout_addon.engine.curve_picture import CurvePoint, levels, newest, shown_kinds
from ..insideout_addon.engine.progress_text import duration

_NAMES = {"photos": n_("Photos"), "projections": n_("Projections"), "sections": n_("Sections")}
# In widths of a button: what a sidebar has beside its panels, and room for the decibels; the picture at least, at most.
_BESIDE, _LEVELS, _LEAST, _MOST = 3.2, 2.6, 5.0, 14.0
_BUTTON = 20.0


def draw_curve(
    layout: bpy.types.UILayout, points: Sequence[CurvePoint], place: str, context: bpy.types.Context
) -> None:
    """As many rows whatever is known: when that number changes, Blender slides the panels below into place.

    Args:
        place: as of `curve_icon`.
    """
    # Without a window the scale is 0.
    button = _BUTTON * (context.preferences.system.ui_scale or 1.0)
    width = max(context.region.width / button - _BESIDE, _LEVELS + _LEAST)
    side = min(width - _LEVELS, _MOST)
    row = layout.split(factor=_LEVELS / width)
    beside = row.column(align=True)
    grid = levels(points)
    beside.scale_y = side / len(grid)
    for level in reversed(grid):
        beside.label(text=f"{level:.0f} dB" if points else "–", translate=False)
    row.template_icon(icon_value=curve_icon(place, points), scale=side)
    below = layout.column(align=True)
    below.scale_y = 0.85
    for kind in shown_kinds(points):
        value = newest(points, kind)
        told = "–" if value is None else f"{value:.1f} dB"
        below.label(text=f"{iface_(_NAMES[kind])}: {told}", translate=False, icon_value=mark_icon(kind))
    after = iface_("After {time}").format(time=duration(points[-1].seconds)) if points else "–"
    below.label(text=after, translate=False, icon="TIME")
