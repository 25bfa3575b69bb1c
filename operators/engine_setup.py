"""Makes the engine's environment."""

from __future__ import annotations

import bpy
from bpy.app.translations import pgettext_iface as iface_
from bpy.app.translations import pgettext_n as n_

from ..insideout_addon.engine.commands import start_setup
from ..insideout_addon.engine.environment import engine_folder, find_python
from ..insideout_addon.told_text import displayable
from .needs import engine_is_free

_QUESTION = (
    n_("InsideOut will make a Python environment of its own"),
    n_("and download about 1 GB of packages (torch and others)."),
    n_("Blender's own Python stays as it is."),
)


class INSIDEOUT_OT_engine_setup(bpy.types.Operator):
    """Make a Python environment for the engine; downloads about 1 GB"""

    bl_idname = "insideout.engine_setup"
    bl_label = "Make Environment..."

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not bpy.app.online_access:
            cls.poll_message_set("Allow Online Access in Preferences > System first")
            return False
        return engine_is_free(cls)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_props_dialog(self, width=360, confirm_text="Download")

    def draw(self, context: bpy.types.Context) -> None:
        column = self.layout.column(align=True)
        for line in _QUESTION:
            column.label(text=line)
        folder = iface_("Folder: {path}").format(path=displayable(engine_folder()))
        column.label(text=folder, translate=False)

    def execute(self, context: bpy.types.Context) -> set[str]:
        folder = engine_folder()
        if folder is None:
            self.report({"ERROR"}, "Install InsideOut as an extension first, or set Engine Python in its preferences.")
            return {"CANCELLED"}
        python = find_python()
        if python is None:
            self.report(
                {"ERROR"},
                "No Python 3.11 was found; install it from python.org, not from the Microsoft Store, then press the "
                "button again.",
            )
            return {"CANCELLED"}
        return start_setup(self, python, folder)


CLASSES = (INSIDEOUT_OT_engine_setup,)
