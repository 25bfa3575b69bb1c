"""Finds InsideOut for a script, wherever it runs.

In a Blender with the extension enabled that one is used; else the pip package; else the checkout this file is in.
"""

from __future__ import annotations

import atexit
import importlib
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import bpy


def load_insideout() -> ModuleType:
    """The package, registered in this Blender."""
    for name in bpy.context.preferences.addons.keys():  # noqa: SIM118
        if name.startswith("bl_ext.") and name.endswith(".insideout"):
            return importlib.import_module(name)
    package = _import_package()
    if not hasattr(bpy.types.Scene, "insideout"):
        package.register()
        if bpy.app.module:
            # As a Python module Blender may hang at exit on classes that are still registered.
            atexit.register(package.unregister)
    return package


def script_arguments() -> list[str]:
    """What follows "--" on the command line, or everything when Python itself runs the script."""
    if "--" in sys.argv:
        return sys.argv[sys.argv.index("--") + 1 :]
    return sys.argv[1:]


def _import_package() -> ModuleType:
    if importlib.util.find_spec("insideout") is not None:
        return importlib.import_module("insideout")
    root = Path(__file__).resolve().parents[1]
    spec = importlib.util.spec_from_file_location(
        "insideout", root / "__init__.py", submodule_search_locations=[str(root)]
    )
    assert spec is not None
    assert spec.loader is not None
    package = importlib.util.module_from_spec(spec)
    sys.modules["insideout"] = package
    spec.loader.exec_module(package)
    return package
