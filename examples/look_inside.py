"""A whole session without the mouse: import, cut, measure, weigh, break, take out. What it finds lies in one folder.

blender --background --python examples/look_inside.py -- RUN --out FOLDER [--pieces 8]
"""

from __future__ import annotations

import argparse
import importlib
import sys
from pathlib import Path
from types import ModuleType

import bpy

sys.path.insert(0, str(Path(__file__).parent))
from load_insideout import open_empty_file, run_script, script_arguments


def main(package: ModuleType) -> int:
    parser = argparse.ArgumentParser(prog="look_inside.py", description=__doc__)
    parser.add_argument("run", type=Path, help="folder of a run, or a .ply of splats with density")
    parser.add_argument("--out", type=Path, required=True, help="where the files go")
    parser.add_argument("--pieces", type=int, default=0, help="break into so many pieces; 0: leave it whole")
    options = parser.parse_args(script_arguments())
    out = options.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    open_empty_file()
    bpy.ops.insideout.import_run(filepath=str(options.run.resolve()))
    settings = bpy.context.scene.insideout
    pieces = options.pieces
    if pieces:
        breaking = importlib.import_module(f"{package.__name__}.insideout_addon.physics.breaking")
        hindrance = breaking.hindrance(settings.model)
        if hindrance:
            print(f"The model stays whole: {hindrance}")
            pieces = 0
    _measure(settings, out, walls=_cut(settings, out))
    bpy.ops.insideout.weigh(calibration="WATER")
    bpy.ops.insideout.weigh_center()
    bpy.ops.insideout.weigh_save(filepath=str(out / "weight.csv"))
    if pieces:
        _break(pieces)
    bpy.ops.insideout.export_file(filepath=str(out / "model.ply"))
    blend = importlib.import_module(f"{package.__name__}.insideout_addon.scene.paths").free_path(out / "session.blend")
    bpy.ops.wm.save_as_mainfile(filepath=str(blend), compress=True)
    print(f"Saved {blend} and what was found beside it")
    return 0


def _cut(settings: bpy.types.PropertyGroup, out: Path) -> bool:
    """Half way in, as pictures and outlines; then a corner out of the half that is left. Whether material was met."""
    bpy.ops.insideout.section_add()
    half = settings.sections[0]
    half.object.name = "Half way"
    bpy.ops.insideout.section_save(filepath=str(out / "section.png"))
    met = bpy.ops.insideout.contours_save(filepath=str(out / "contours.svg")) == {"FINISHED"}
    if met:
        bpy.ops.insideout.contours_curve()
    else:
        # As in the middle of a ring.
        print("The plane half way in meets no material: no contours and no walls are saved")
    bpy.ops.insideout.section_add_box()
    settings.sections[1].object.name = "Corner"
    settings.section_index = 0
    return met


def _measure(settings: bpy.types.PropertyGroup, out: Path, walls: bool) -> None:
    """Walls on the section, all of the object on a sheet, its densities, and one place looked at."""
    if walls:
        bpy.ops.insideout.thickness()
        bpy.ops.insideout.thickness_save(filepath=str(out / "walls.csv"))
    bpy.ops.insideout.section_sheet(filepath=str(out / "sheet.pdf"), axis="Z", count=12)
    bpy.ops.insideout.histogram_save(filepath=str(out / "densities.png"), of="MODEL")
    middle = settings.model.matrix_world.inverted() @ settings.sections[0].object.matrix_world.translation
    bpy.ops.insideout.probe(point=middle)


def _break(pieces: int) -> None:
    """Into pieces that fall, their motion kept as keyframes."""
    bpy.ops.insideout.break_model(pieces=pieces, seed=1)
    scene = bpy.context.scene
    scene.frame_end = scene.frame_start + 60
    bpy.ops.insideout.bake_physics()


if __name__ == "__main__":
    run_script(main)
