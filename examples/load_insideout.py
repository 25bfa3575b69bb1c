"""What a script needs around it: InsideOut wherever it is, an empty file, an exit code that tells the truth.

In a Blender with the extension enabled that one is used; else the pip package; else the checkout this file is in.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
import traceback
from collections.abc import Callable
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
    return package


def open_empty_file() -> None:
    """An empty file; the user's preferences and extensions stay as they are."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)


def run_script(main: Callable[[ModuleType], int]) -> None:
    """Runs `main` with the package and ends Blender with its exit code.

    What the user can mend is told in a sentence (2); an error of the program with its traceback (1), for Blender by
    itself would end with 0.
    """
    try:
        for stream in (sys.stdout, sys.stderr):
            # A file or a console of Windows may not know "mm⁻¹".
            stream.reconfigure(errors="replace")
        package = load_insideout()
        errors = importlib.import_module(f"{package.__name__}.core.errors")
        error_text = importlib.import_module(f"{package.__name__}.insideout_addon.error_text")
        try:
            code = main(package)
        except (errors.InsideOutError, OSError, RuntimeError) as error:
            # An operator that failed raises what it reported, with "Error: " before it.
            print(f"Error: {error_text.sentence(error).strip().removeprefix('Error: ')}", file=sys.stderr)
            code = 2
    except SystemExit as ended:
        # argparse has said what is wrong, or shown its help.
        code = ended.code if isinstance(ended.code, int) else 0
    except Exception:
        traceback.print_exc()
        code = 1
    if bpy.app.module:
        # As a Python module Blender may hang at its end on classes that are still registered, and tells of an error
        # of its memory that is none of the user's.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    if code:
        sys.exit(code)


def folder_for_files(path: Path) -> Path:
    """The whole path of a folder that a script is to write into; not made yet.

    Raises:
        NotADirectoryError: something else is there.
    """
    path = path.resolve()
    if path.exists() and not path.is_dir():
        raise NotADirectoryError(0, "is a file, not a folder", str(path))
    return path


def script_arguments() -> list[str]:
    """What follows "--" on the command line; without it nothing, or everything when Python itself runs the script."""
    if "--" in sys.argv:
        return sys.argv[sys.argv.index("--") + 1 :]
    return sys.argv[1:] if bpy.app.module else []


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
