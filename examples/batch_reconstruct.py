"""Does without a window what the panel does: reconstruct, import, cut, save.

    blender --background --python examples/batch_reconstruct.py -- CAPTURE --out RUN [--preset draft]

leaves in RUN, beside the engine's files, insideout.blend, section.png and section.svg. The engine's Python is the
one of the add-on's preferences, of INSIDEOUT_ENGINE, or of --engine.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).resolve().parent))

from load_insideout import load_insideout, script_arguments


def main() -> int:
    parser = argparse.ArgumentParser(prog="batch_reconstruct.py", description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--out", type=Path, required=True, help="run folder")
    parser.add_argument("--preset", choices=("draft", "standard", "paper"), default="draft")
    parser.add_argument("--stage", default="ALL", help="one stage instead of all")
    parser.add_argument("--engine", type=Path, help="Python in which insideout is installed")
    parser.add_argument("--render", action="store_true", help="also render insideout.png")
    options = parser.parse_args(script_arguments())
    if options.engine is not None:
        os.environ["INSIDEOUT_ENGINE"] = str(options.engine)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    package = load_insideout()
    settings = bpy.context.scene.insideout
    settings.capture, settings.run = str(options.capture.resolve()), str(options.out.resolve())
    settings.preset, settings.stage, settings.import_when_done = options.preset, options.stage, False
    try:
        bpy.ops.insideout.reconstruct()
        return _present(package.__name__, options)
    except RuntimeError as error:
        # An operator that failed raises what it reported.
        print(str(error).strip(), file=sys.stderr)
        return 2


def _present(package: str, options: argparse.Namespace) -> int:
    showcase = importlib.import_module(f"{package}.insideout_addon.scene.showcase")
    importing = importlib.import_module(f"{package}.insideout_addon.scene.importing")
    run = options.out.resolve()
    sets = importing.available_sets(run)
    if not sets:
        print(f"{run}: no splats to show yet; run the stages that are left.")
        return 0
    scene = bpy.context.scene
    showcase.build_showcase(run, bpy.context, sets[0])
    bpy.ops.insideout.section_save(filepath=str(run / "section.png"))
    bpy.ops.insideout.contours_save(filepath=str(run / "section.svg"))
    showcase.render_settings(scene, 720, 16)
    showcase.save_blend(scene, run / "insideout.blend", run)
    if options.render:
        scene.render.filepath = str(run / "insideout.png")
        bpy.ops.render.render(write_still=True)
    return 0


if __name__ == "__main__":
    code = main()
    if code:
        sys.exit(code)
