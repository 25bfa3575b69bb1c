"""Makes a run into a .blend that shows it cut open, and a rendered picture of that.

    python examples/make_blend.py -- RUN --out demo
    blender --background --python examples/make_blend.py -- RUN --out demo

leaves demo/insideout.blend and demo/insideout.png.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).resolve().parent))
from load_insideout import load_insideout, script_arguments


def main() -> int:
    parser = argparse.ArgumentParser(prog="make_blend.py", description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, help="run folder with fused.ply")
    parser.add_argument("--out", type=Path, default=Path("demo"), help="folder for insideout.blend and .png")
    parser.add_argument("--which", choices=("fused", "rgb", "xray"), default="fused")
    parser.add_argument("--size", type=int, default=720, help="pixels along a side of the picture")
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--no-render", action="store_true", help="only the .blend")
    options = parser.parse_args(script_arguments())
    bpy.ops.wm.read_factory_settings(use_empty=True)
    package = load_insideout()
    showcase = importlib.import_module(f"{package.__name__}.insideout_addon.scene.showcase")
    errors = importlib.import_module(f"{package.__name__}.core.errors")
    scene = bpy.context.scene
    try:
        showcase.build_showcase(options.run.resolve(), bpy.context, options.which)
    except errors.InsideOutError as error:
        print(f"Error: {error}", file=sys.stderr)
        return 2
    showcase.render_settings(scene, options.size, options.samples)
    showcase.save_blend(scene, options.out / "insideout.blend", options.run)
    if not options.no_render:
        scene.render.filepath = str((options.out / "insideout.png").resolve())
        bpy.ops.render.render(write_still=True)
    return 0


if __name__ == "__main__":
    code = main()
    if code:
        sys.exit(code)
