"""Saves the add-on's node groups and materials for the asset browser."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path

import bpy
from bpy.app.translations import pgettext_rpt as rpt_

from ..core.errors import InsideOutError
from ..insideout_addon.assets.library import FILE, add_to_asset_libraries, save_in_steps
from ..insideout_addon.engine.environment import PACKAGE
from ..insideout_addon.error_text import sentence
from ..insideout_addon.told_text import displayable
from .needs import nothing_in_work
from .saving import FILE_PATH, chosen_file
from .waiting import SavedInSteps


class INSIDEOUT_OT_assets_save(SavedInSteps, bpy.types.Operator):
    """Save node groups and materials of splats as assets, to use them in other files without this add-on"""

    bl_idname = "insideout.assets_save"
    bl_label = "Save Assets..."

    filename_ext = ".blend"
    filepath: FILE_PATH
    filter_glob: bpy.props.StringProperty(default="*.blend", options={"HIDDEN"})
    use_library: bpy.props.BoolProperty(
        name="Add to Asset Libraries",
        description="Also list the folder in Preferences > File Paths > Asset Libraries, for the asset browser",
        default=False,
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return nothing_in_work(cls)

    def ask(self, context: bpy.types.Context) -> set[str]:
        if not self.filepath:
            self.filepath = str(_usual_folder() / FILE)
        return super().ask(context)

    def steps(self, context: bpy.types.Context) -> Generator[float, None, set[str]]:
        try:
            path = chosen_file(self.filepath)
            yield from save_in_steps(path)
        except (InsideOutError, OSError) as error:
            self.report({"ERROR"}, sentence(error))
            return {"CANCELLED"}
        if self.use_library:
            add_to_asset_libraries(path.parent)
        self.report({"INFO"}, rpt_("Saved {path}").format(path=displayable(path)))
        return {"FINISHED"}


def _usual_folder() -> Path:
    """The user's first asset library; without one a folder of the extension's that updates leave alone."""
    for library in bpy.context.preferences.filepaths.asset_libraries:
        folder = Path(bpy.path.abspath(library.path))
        if library.path and folder.is_dir():
            return folder
    try:
        return Path(bpy.utils.extension_path_user(PACKAGE, path="assets", create=True))
    except ValueError:
        # Not installed as an extension.
        return Path()


CLASSES = (INSIDEOUT_OT_assets_save,)
