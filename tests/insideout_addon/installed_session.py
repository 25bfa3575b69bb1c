"""What a user does with the zip, in a Blender of its own: install, import, cut, disable, enable again.

    python installed_session.py ZIP RUN

Run with BLENDER_USER_RESOURCES on an empty folder; prints what it found as one line of JSON.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import sys
from pathlib import Path

import bpy

_PACKAGE = "bl_ext.user_default.insideout"
_OPERATORS = (
    "engine_check",
    "engine_setup",
    "check",
    "reconstruct",
    "cancel",
    "import_run",
    "import_file",
    "section_add",
    "section_remove",
    "section_window",
    "section_save",
    "contours_save",
    "contours_curve",
)


def main(zip_path: Path, run: Path) -> None:
    installed = bpy.ops.extensions.package_install_files(
        filepath=str(zip_path), repo="user_default", enable_on_install=True, overwrite=True
    )
    package = importlib.import_module(_PACKAGE)
    found = {
        "installed": list(installed),
        "beside the checkout": "insideout" not in sys.modules,
        "folder": package.__file__,
        "registered": _registered(),
        "preferences": hasattr(bpy.context.preferences.addons[_PACKAGE].preferences, "engine_python"),
    }
    found["empty sidebar"] = _draw()
    settings = bpy.context.scene.insideout
    settings.run = str(run)
    bpy.ops.insideout.import_run()
    bpy.ops.insideout.section_add()
    bpy.ops.insideout.section_save(filepath=str(run / "section.png"))
    found["points"] = len(settings.model.data.points)
    found["plane"] = settings.sections[0].object.name
    found["sidebar"] = _draw()
    bpy.ops.preferences.addon_disable(module=_PACKAGE)
    found["left behind"] = {
        "classes": [name for name in dir(bpy.types) if name.startswith("INSIDEOUT")],
        "properties": hasattr(bpy.types.Scene, "insideout") or hasattr(bpy.types.WindowManager, "insideout"),
        "handlers": [
            str(function)
            for handlers in (bpy.app.handlers.depsgraph_update_post, bpy.app.handlers.load_post)
            for function in handlers
            if "insideout" in function.__module__
        ],
    }
    bpy.ops.preferences.addon_enable(module=_PACKAGE)
    found["registered again"] = _registered()
    found["model again"] = len(bpy.context.scene.insideout.model.data.points)
    found["heavy"] = sorted({"torch", "scipy", "numba", "skimage", "cv2", "PIL", "SimpleITK"} & set(sys.modules))
    bpy.ops.preferences.addon_disable(module=_PACKAGE)
    print("found:" + json.dumps(found))


def _registered() -> bool:
    operators = all(hasattr(bpy.types, f"INSIDEOUT_OT_{name}") for name in _OPERATORS)
    panels = all(
        hasattr(bpy.types, f"INSIDEOUT_PT_{name}") for name in ("engine", "capture", "reconstruct", "model", "section")
    )
    return operators and panels


def _draw() -> list[str]:
    path = Path(__file__).resolve().parents[1] / "panel_drawing.py"
    spec = importlib.util.spec_from_file_location("panel_drawing", path)
    drawing = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(drawing)
    return drawing.draw_panels(importlib.import_module(f"{_PACKAGE}.panels").CLASSES)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
