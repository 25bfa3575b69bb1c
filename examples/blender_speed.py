"""How fast this Blender imports splats, and how fast a section follows its plane through them; nothing is kept.

The splats are made up. They are shown as an import shows so many, and the plane cuts them.

blender --background --python examples/blender_speed.py -- [--splats 1000000] [--cut-splats 200000]
"""

from __future__ import annotations

import argparse
import importlib
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import bpy

sys.path.insert(0, str(Path(__file__).parent))
from load_insideout import open_empty_file, run_script, script_arguments

_SIZE_MM, _PLACES = 100.0, 40
# As long as an import of a million splats may take, or of fewer.
_BAR_S = 2.5


def main(package: ModuleType) -> int:
    parser = argparse.ArgumentParser(prog="blender_speed.py", description=__doc__)
    parser.add_argument("--splats", type=int, default=1_000_000, help="splats of the file that is imported")
    parser.add_argument("--cut-splats", type=int, default=200_000, help="splats that the plane moves through")
    options = parser.parse_args(script_arguments())
    if min(options.splats, options.cut_splats) < 1:
        parser.error("give at least one splat")
    open_empty_file()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "splats.ply"
        _splats(package, options.splats).save(path)
        seconds = _imported(package, path)
        bar = _BAR_S * max(options.splats / 1e6, 1.0)
        held = "within" if seconds <= bar else "over"
        size = path.stat().st_size / 1e6
        print(f"Import of {options.splats:,} splats, {size:.0f} MB: {seconds:.2f} s, {held} the {bar:.2g} s of the bar")
    open_empty_file()
    cut, picture, pixels = _followed(package, _splats(package, options.cut_splats))
    print(
        f"Section of {options.cut_splats:,} splats while its plane moves: Blender's cut {cut:.0f} ms, picture of "
        f"{pixels}x{pixels} {picture:.0f} ms: {1e3 / (cut + picture):.0f} updates a second"
    )
    return 0


def _splats(package: ModuleType, count: int) -> object:
    """A cube of 100 mm full of splats of degree 3, as in `insideout bench cut`."""
    made = importlib.import_module(f"{package.__name__}.core.bench.scenes").scene(count, 512)
    scale = _SIZE_MM / float(made.gaussians.means[:, 0].max() - made.gaussians.means[:, 0].min())
    return replace(made.gaussians, means=made.gaussians.means * scale, scales=made.gaussians.scales * scale)


def _imported(package: ModuleType, path: Path) -> float:
    importing = importlib.import_module(f"{package.__name__}.insideout_addon.scene.importing")
    begin = time.perf_counter()
    importing.import_splats(path, "splats", bpy.context, display="POINTS")
    return time.perf_counter() - begin


def _followed(package: ModuleType, gaussians: object) -> tuple[float, float, int]:
    """Milliseconds an update: what Blender takes to cut what is shown, and the picture computed, coloured and handed to
    it; and how many pixels that has along a side."""
    scene_of = f"{package.__name__}.insideout_addon.scene"
    splats, sections, picture, showing = (
        importlib.import_module(f"{scene_of}.{name}") for name in ("splats", "sections", "section_picture", "showing")
    )
    model = splats.create_splats(gaussians, "splats", bpy.context, view_dependent=False)
    showing.show_as(model, "AUTOMATIC")
    plane = sections.add_section_plane(model, bpy.context)
    scene = bpy.context.scene
    section, middle = scene.insideout.sections[0], plane.location.y
    cut = drawn = 0.0
    for place in range(_PLACES):
        plane.location.y = middle + 0.8 * _SIZE_MM * (place / (_PLACES - 1) - 0.5)
        begin = time.perf_counter()
        bpy.context.view_layer.update()
        between = time.perf_counter()
        picture.draw_picture(scene, section, quick=True)
        cut, drawn = cut + between - begin, drawn + time.perf_counter() - between
    return 1e3 * cut / _PLACES, 1e3 * drawn / _PLACES, scene.insideout.pixels


if __name__ == "__main__":
    run_script(main)
