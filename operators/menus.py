"""InsideOut's lines in Blender's own menus."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import bpy
from bpy.app.translations import contexts
from bpy.app.translations import pgettext_n as n_

from ..insideout_addon.scene.splats import is_splats

_TEXT = n_("Gaussian Splats (.ply)", contexts.operator_default)
_ASSETS = n_("InsideOut Assets (.blend)", contexts.operator_default)


def attach() -> None:
    """Adds them: File > Import, File > Export, Object > Apply."""
    for menu, draw in _lines():
        menu.append(draw)


def detach() -> None:
    """Takes them away again."""
    for menu, draw in _lines():
        menu.remove(draw)


def _lines() -> Iterator[tuple[type[bpy.types.Menu], Callable[[bpy.types.Menu, bpy.types.Context], None]]]:
    yield bpy.types.TOPBAR_MT_file_import, _draw_import
    yield bpy.types.TOPBAR_MT_file_export, _draw_export
    yield bpy.types.VIEW3D_MT_object_apply, _draw_apply


def _draw_import(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    menu.layout.operator("insideout.import_file", text=_TEXT)


def _draw_export(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    menu.layout.operator("insideout.export_file", text=_TEXT)
    menu.layout.operator("insideout.assets_save", text=_ASSETS)


def _draw_apply(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    if is_splats(context.view_layer.objects.active):
        menu.layout.separator()
        menu.layout.operator("insideout.apply_transform")
