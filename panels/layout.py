"""Small things that panels share."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping

import bpy
from bpy.app.translations import pgettext_iface as iface_
from bpy.app.translations import pgettext_n as n_

from ..insideout_addon.scene.importing import densities_are_relative
from ..insideout_addon.scene.placement import is_scaled, splats_are_left_behind
from ..insideout_addon.told_text import displayable


class SidebarPanel:
    """Where InsideOut's panels are."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "InsideOut"


def wrapped(layout: bpy.types.UILayout, text: str, context: bpy.types.Context, icon: str = "NONE") -> None:
    """A label of several lines, translated and broken to the sidebar's width."""
    # Without a window the scale is 0.
    scale = context.preferences.system.ui_scale or 1.0
    characters = max(20, int(context.region.width / (7.2 * scale)) - 6)
    column = layout.column(align=True)
    column.scale_y = 0.8
    for index, line in enumerate(textwrap.wrap(displayable(iface_(text)), characters) or [""]):
        column.label(text=line, translate=False, icon=icon if index == 0 else ("BLANK1" if icon != "NONE" else "NONE"))


def draw_scaled(layout: bpy.types.UILayout, model: bpy.types.Object, context: bpy.types.Context) -> None:
    """A note where a model has another size than what is measured of it, or splats that do not fit their places."""
    if not draw_left_behind(layout, model, context) and is_scaled(model):
        wrapped(
            layout,
            "The object is scaled, but measures, pictures and tables have its size of before; "
            "use Object > Apply > Transform to Splats first",
            context,
            "INFO",
        )


def draw_left_behind(layout: bpy.types.UILayout, model: bpy.types.Object, context: bpy.types.Context) -> bool:
    """A note, and True, where Blender's own Apply has left the splats of a model as they were."""
    left = splats_are_left_behind(model)
    if left:
        wrapped(
            layout,
            "Blender's own Apply has turned or scaled the points, but not the splats on them; "
            "undo it, then use Object > Apply > Transform to Splats",
            context,
            "ERROR",
        )
    return left


def draw_window(layout: bpy.types.UILayout, model: bpy.types.Object | None, settings: bpy.types.PropertyGroup) -> None:
    """The densities shown darkest and brightest, with the button that finds them."""
    window = layout.column(align=True)
    draw_densities(window, model, settings, {"low": n_("Low (relative)"), "high": n_("High (relative)")})
    window.operator("insideout.section_window")


def draw_densities(
    layout: bpy.types.UILayout,
    model: bpy.types.Object | None,
    settings: bpy.types.PropertyGroup,
    relative: Mapping[str, str],
) -> None:
    """Settings of density in the unit that the model's densities are written in.

    Args:
        relative: what each is called where densities have no unit.
    """
    for name, title in relative.items():
        if model is not None and densities_are_relative(model):
            layout.prop(settings, name, text=title)
        else:
            layout.prop(settings, f"{name}_hu" if settings.unit == "HU" else name)


def shortened(text: str, most: int = 480) -> str:
    """A long text without its middle: what is wrong stands at the start, what to do about it at the end."""
    return text if len(text) <= most else f"{text[: 2 * most // 3]} … {text[-most // 3 :]}"


def bytes_text(count: int) -> str:
    """Bytes as MB or GB."""
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.0f} MB"
