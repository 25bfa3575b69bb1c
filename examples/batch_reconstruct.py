"""Does without a window what the panel does: check, reconstruct, import, cut, save.

    blender --background --python examples/batch_reconstruct.py -- CAPTURE --check
    blender --background --python examples/batch_reconstruct.py -- CAPTURE --out RUN [--preset draft] [--refine apart]
    blender --background --python examples/batch_reconstruct.py -- --out RUN --position 0 12 0 --normal 0 -1 0.3

leaves in RUN, beside the engine's files, insideout.blend, section.png and section.svg; without CAPTURE it shows the
run that is there. The engine's Python is the first there is: of --engine, of the add-on's preferences, of
INSIDEOUT_ENGINE, the one made in Blender's sidebar, the one that runs this script if insideout is installed in it,
.venv of the checkout.
A .blend that is there already stays: the new one is insideout-2.blend then.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from pathlib import Path
from types import ModuleType

import bpy

sys.path.insert(0, str(Path(__file__).resolve().parent))
from load_insideout import open_empty_file, run_script, script_arguments


def main(package: ModuleType) -> int:
    options = _parse(package)
    if options.engine is not None:
        _use_engine(package, options.engine)
    open_empty_file()
    settings = bpy.context.scene.insideout
    if options.capture is not None:
        settings.capture = str(options.capture.resolve())
    if options.check:
        return _check(settings)
    settings.run, settings.import_when_done = str(options.out.resolve()), False
    settings.preset, settings.refine, settings.stage = options.preset, options.refine, options.stage
    if options.capture is not None:
        bpy.ops.insideout.reconstruct()
    return _show(package, settings, options)


def _use_engine(package: ModuleType, python: Path) -> None:
    """Before the one of the preferences, which are not saved in background mode."""
    addon = bpy.context.preferences.addons.get(package.__name__)
    if addon is not None and addon.preferences is not None:
        addon.preferences.engine_python = str(python.absolute())
    os.environ["INSIDEOUT_ENGINE"] = str(python.absolute())


def _parse(package: ModuleType) -> argparse.Namespace:
    properties = importlib.import_module(f"{package.__name__}.insideout_addon.properties")
    parser = argparse.ArgumentParser(
        prog="batch_reconstruct.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("capture", type=Path, nargs="?", help="folder with photos and X-rays")
    parser.add_argument("--out", type=Path, help="run folder")
    engine = parser.add_argument_group("Capture and Reconstruct")
    engine.add_argument("--check", action="store_true", help="only look the capture over")
    engine.add_argument("--preset", choices=_names(properties.PRESETS), default="draft")
    engine.add_argument("--refine", choices=_names(properties.ROUTES), default="joint", help="both halves, or each")
    engine.add_argument("--stage", choices=_names(properties.STAGE_ITEMS), default="ALL", help="one stage instead")
    engine.add_argument("--engine", type=Path, metavar="PYTHON", help="Python in which insideout is installed")
    model = parser.add_argument_group("Model")
    model.add_argument("--which", choices=_names(properties.SET_ITEMS), help="splats to show; default: the best")
    model.add_argument("--display", choices=_names(properties.DISPLAY_ITEMS), default="AUTOMATIC", type=str.upper)
    model.add_argument("--view-dependent", action="store_true", help="keep colours that change with the view")
    section = parser.add_argument_group("Section, in mm and 1/mm in the model's frame")
    section.add_argument("--position", type=float, nargs=3, metavar=("X", "Y", "Z"), help="a point of the plane")
    section.add_argument("--normal", type=float, nargs=3, metavar=("X", "Y", "Z"), help="towards the hidden side")
    section.add_argument("--no-cut", action="store_true", help="hide nothing")
    section.add_argument("--flip", action="store_true", help="hide the other side")
    section.add_argument("--slab", type=float, default=0.0, metavar="MM", help="show only this depth; 0: everything")
    section.add_argument("--no-density", action="store_true", help="no picture of the density on the plane")
    section.add_argument("--window", type=float, nargs=2, metavar=("LOW", "HIGH"), help="densities that colours span")
    section.add_argument("--pixels", type=int, default=384, help="pixels along the section's longer side")
    section.add_argument("--level", type=float, default=0.0, help="of the contours; 0: half of the material's median")
    files = parser.add_argument_group("Files")
    files.add_argument("--section", type=Path, metavar="PNG", help="default: RUN/section.png")
    files.add_argument("--values", type=Path, metavar="PNG", help="also the section as 16-bit grey, linear in density")
    files.add_argument("--contours", type=Path, metavar="FILE", help=".svg or .csv; default: RUN/section.svg")
    files.add_argument("--curve", action="store_true", help="also the contours as a curve in the .blend")
    files.add_argument("--render", action="store_true", help="also a picture beside the .blend")
    options = parser.parse_args(script_arguments())
    if options.check and options.capture is None:
        parser.error("--check needs a CAPTURE")
    if not options.check and options.out is None:
        parser.error("--out is needed: the run folder")
    if options.window is not None and options.window[0] >= options.window[1]:
        parser.error("--window: LOW has to be below HIGH")
    return options


def _names(items: tuple[tuple[str, str, str], ...]) -> list[str]:
    return [name for name, *_ in items]


def _check(settings: bpy.types.PropertyGroup) -> int:
    bpy.ops.insideout.check()
    for finding in settings.findings:
        print(f"{finding.level:8}{finding.subject}: {finding.message} {finding.advice}".rstrip())
    return 2 if any(finding.level == "error" for finding in settings.findings) else 0


def _show(package: ModuleType, settings: bpy.types.PropertyGroup, options: argparse.Namespace) -> int:
    scene_of = f"{package.__name__}.insideout_addon.scene"
    importing, showcase = (importlib.import_module(f"{scene_of}.{name}") for name in ("importing", "showcase"))
    run, scene = options.out.resolve(), bpy.context.scene
    sets = importing.available_sets(run)
    if options.capture is not None and options.which is None and not sets:
        print(f"{run}: no splats to show yet; run the stages that are left.")
        return 0
    settings.which = options.which or (sets or ["fused"])[0]
    showcase.build_showcase(run, bpy.context, settings.which, options.display, options.view_dependent)
    if len(settings.sections):
        _cut(package, settings, options)
    showcase.render_settings(scene, 720, 16)
    blend = showcase.save_blend(scene, run / "insideout.blend", run)
    print(f"Saved {blend}")
    code = _save_section(run, options) if len(settings.sections) else _no_section(options)
    if options.render:
        scene.render.filepath = str(blend.with_suffix(".png"))
        bpy.ops.render.render(write_still=True)
    return code


def _cut(package: ModuleType, settings: bpy.types.PropertyGroup, options: argparse.Namespace) -> None:
    scene_of = f"{package.__name__}.insideout_addon.scene"
    section, picture = (importlib.import_module(f"{scene_of}.{name}") for name in ("section", "section_picture"))
    section.place_plane(bpy.context.scene, options.position, options.normal)
    chosen = section.active_section(bpy.context.scene)
    chosen.cut, chosen.flip, chosen.slab_mm = not options.no_cut, options.flip, options.slab
    chosen.show_density = not options.no_density
    settings.display, settings.pixels, settings.level = options.display, options.pixels, options.level
    if options.window is not None:
        settings.low, settings.high = options.window
    # In background mode no timer draws the picture on the plane.
    picture.refresh_sections(bpy.context.scene)
    if options.curve:
        bpy.ops.insideout.contours_curve()


def _save_section(run: Path, options: argparse.Namespace) -> int:
    bpy.ops.insideout.section_save(filepath=str((options.section or run / "section.png").resolve()))
    if options.values is not None:
        bpy.ops.insideout.section_save(filepath=str(options.values.resolve()), content="VALUES")
    contours = (options.contours or run / "section.svg").resolve()
    saved = "FINISHED" in bpy.ops.insideout.contours_save(filepath=str(contours))
    # A plane beside the model meets no edge; that is a failure only where contours were asked for.
    return 0 if saved or not (options.contours or options.level) else 2


def _no_section(options: argparse.Namespace) -> int:
    print("The model has no density, for photos do not see inside: there is no section to save.")
    # A failure only where one was asked for.
    return 2 if options.section or options.values or options.contours or options.level else 0


if __name__ == "__main__":
    run_script(main)
