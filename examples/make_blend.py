"""Makes a run into a .blend that shows it cut open, and a rendered picture of that.

    python examples/make_blend.py -- RUN --out demo
    blender --background --python examples/make_blend.py -- RUN --out demo

leaves demo/insideout.blend and demo/insideout.png. A .blend that is there already stays: the new one is
insideout-2.blend then.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from pathlib import Path
from types import ModuleType

import bpy

sys.path.insert(0, str(Path(__file__).resolve().parent))
from load_insideout import folder_for_files, open_empty_file, run_script, script_arguments


def main(package: ModuleType) -> int:
    showcase = importlib.import_module(f"{package.__name__}.insideout_addon.scene.showcase")
    parser = argparse.ArgumentParser(prog="make_blend.py", description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, help="run folder with fused.ply")
    parser.add_argument("--out", type=Path, default=Path("demo"), help="folder for insideout.blend and .png")
    parser.add_argument("--which", choices=("fused", "rgb", "xray"), default="fused")
    parser.add_argument("--size", type=int, default=720, help="pixels along a side of the picture")
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--no-render", action="store_true", help="only the .blend")
    options = parser.parse_args(script_arguments())
    out = folder_for_files(options.out)
    open_empty_file()
    scene = bpy.context.scene
    showcase.build_showcase(options.run.resolve(), bpy.context, options.which)
    showcase.render_settings(scene, options.size, options.samples)
    out.mkdir(parents=True, exist_ok=True)
    blend = showcase.save_blend(scene, out / "insideout.blend", options.run)
    print(f"Saved {blend}")
    if not options.no_render:
        scene.render.filepath = str(blend.with_suffix(".png"))
        bpy.ops.render.render(write_still=True)
    return 0


if __name__ == "__main__":
    run_script(main)
