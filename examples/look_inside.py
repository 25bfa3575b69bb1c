"""A whole session without the mouse: import, cut, measure, look, weigh, break or bend, take out.

blender --background --python examples/look_inside.py -- RUN --out FOLDER [--pieces 8 | --rigid | --soft]

What it finds lies in one folder: pictures, tables, and the scene to go on with.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import bpy
from mathutils import Vector

sys.path.insert(0, str(Path(__file__).parent))
from load_insideout import folder_for_files, open_empty_file, run_script, script_arguments
from take_picture import LEFT, take_picture


def main(package: ModuleType) -> int:
    options = _parse()
    out = folder_for_files(options.out)
    open_empty_file()
    bpy.ops.insideout.import_run(filepath=str(options.run.resolve()))
    out.mkdir(parents=True, exist_ok=True)
    settings = bpy.context.scene.insideout
    pieces = options.pieces
    if pieces and (hindrance := _module(package, "physics.breaking").hindrance(settings.model)):
        print(f"The model stays whole: {hindrance}")
        pieces = 0
    met = _cut(settings, out)
    with _dark_ink(_module(package, "scene.color_bar")):
        _look(settings, out, options.size)
    if met:
        bpy.ops.insideout.contours_curve()
    _measure(settings, out, walls=met)
    if met:
        _measure_points(settings, out, _module(package, "measure.rulers"))
    bpy.ops.insideout.weigh(calibration="WATER")
    bpy.ops.insideout.weigh_center()
    bpy.ops.insideout.weigh_save(filepath=str(out / "weight.csv"))
    if pieces or options.rigid or options.soft:
        _move(pieces, options)
        take_picture(_fallen(settings.model), out / "fallen.png", options.size)
    bpy.ops.insideout.export_file(filepath=str(out / "model.ply"))
    blend = _module(package, "scene.paths").free_path(out / "session.blend")
    bpy.ops.wm.save_as_mainfile(filepath=str(blend), compress=True)
    print(f"Saved {blend} and what was found beside it")
    return 0


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="look_inside.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, help="folder of a run, or a .ply of splats with density")
    parser.add_argument("--out", type=Path, required=True, help="where the files go")
    motion = parser.add_mutually_exclusive_group()
    motion.add_argument(
        "--pieces", type=_pieces, default=0, help="break at so many places, 2 to 500; what is hollow has more pieces"
    )
    motion.add_argument("--rigid", action="store_true", help="let it fall whole")
    motion.add_argument("--soft", action="store_true", help="let it fall and bend")
    parser.add_argument("--frames", type=int, default=60, help="how long it falls; the motion is kept as keyframes")
    parser.add_argument("--size", type=int, default=512, help="pixels along each side of the pictures")
    return parser.parse_args(script_arguments())


def _pieces(text: str) -> int:
    count = int(text)
    if not 2 <= count <= 500:
        raise argparse.ArgumentTypeError(f"{count} is not 2 to 500")
    return count


def _module(package: ModuleType, name: str) -> ModuleType:
    return importlib.import_module(f"{package.__name__}.insideout_addon.{name}")


def _cut(settings: bpy.types.PropertyGroup, out: Path) -> bool:
    """Half way in, as pictures and outlines; then a corner out of the half that is left. Whether material was met."""
    bpy.ops.insideout.section_add()
    half = settings.sections[0]
    half.object.name = "Half way"
    print(f"The section is at y = {half.position_mm:.2f} mm")
    bpy.ops.insideout.section_save(filepath=str(out / "section.png"))
    met = bpy.ops.insideout.contours_save(filepath=str(out / "contours.svg")) == {"FINISHED"}
    if not met:
        # As in the middle of a ring.
        print("The plane half way in meets no material: no contours, no walls and no distances are saved")
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


def _measure_points(settings: bpy.types.PropertyGroup, out: Path, rulers: ModuleType) -> None:
    """Of the outlines on the section: their width as a distance, and the triangle to their highest point."""
    outlines = bpy.data.objects["InsideOut Contours"]
    to_model = settings.model.matrix_world.inverted() @ outlines.matrix_world
    places = [to_model @ Vector(point.co[:3]) for spline in outlines.data.splines for point in spline.points]
    left, right = min(places, key=lambda place: place.x), max(places, key=lambda place: place.x)
    top = max(places, key=lambda place: place.z)
    bpy.ops.object.select_all(action="DESELECT")
    for points in ((left, right), (left, top, right)):
        for point in points:
            bpy.ops.insideout.point_add(location=point)
        # The points that were added since the last measurement: a distance of two, angle and area of three.
        bpy.ops.insideout.measure()
    told = [ruler[rulers.TEXT_KEY] for ruler in rulers.rulers(bpy.context.scene)]
    (out / "distances.txt").write_text("\n".join(told) + "\n", "utf-8")


@contextmanager
def _dark_ink(color_bar: ModuleType) -> Iterator[None]:
    """Numbers that are read before the pictures' light grey, not before the viewport's dark one."""
    color_bar.set_ink(0.02)
    try:
        yield
    finally:
        color_bar.set_ink()


def _look(settings: bpy.types.PropertyGroup, out: Path, size: int) -> None:
    """The halves pulled apart; a few millimetres peeled off, coloured by density; each as a picture."""
    half, corner = settings.sections
    corner.cut, corner.object.hide_render = False, True
    extent = max(settings.model.dimensions) / settings.model.matrix_world.median_scale
    half.apart_mm = 0.3 * extent
    take_picture([settings.model], out / "apart.png", size, LEFT)
    half.apart_mm, half.show_density = 0.0, False
    bpy.ops.insideout.look_prepare()
    settings.peel_mm = 0.03 * extent
    bpy.ops.insideout.color_by(color_by="DENSITY")
    take_picture([settings.model], out / "peeled.png", size)
    bpy.ops.insideout.look_reset()
    half.show_density = corner.cut = True
    corner.object.hide_render = False


def _move(pieces: int, options: argparse.Namespace) -> None:
    """Broken, whole or soft it falls, and its motion is kept as keyframes."""
    if pieces:
        bpy.ops.insideout.break_model(pieces=pieces, seed=1)
    elif options.rigid:
        bpy.ops.insideout.make_rigid()
    else:
        bpy.ops.insideout.make_soft()
    scene = bpy.context.scene
    scene.frame_end = scene.frame_start + options.frames
    bpy.ops.insideout.bake_physics()


def _fallen(model: bpy.types.Object) -> list[bpy.types.Object]:
    """What moves, in the last frame."""
    scene = bpy.context.scene
    scene.frame_set(scene.frame_end)
    return [thing for thing in scene.objects if thing.animation_data and not thing.hide_render] or [model]


if __name__ == "__main__":
    run_script(main)
