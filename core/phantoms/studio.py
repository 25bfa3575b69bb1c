"""Photos of a phantom, by the ray caster built in or by Cycles in a process that has Blender."""

from __future__ import annotations

import importlib.util
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Generator
from dataclasses import replace
from pathlib import Path
from typing import IO

import numpy as np

from ..errors import SettingError
from ..files import write_json
from ..processes import NO_CONSOLE
from ..progress import Reporter
from ..srgb import srgb_to_linear
from .distance_grid import DistanceGrid
from .meshes import surface_mesh
from .model import Phantom
from .photos import BACKGROUND, exposed, render_photo
from .settings import CaptureSettings
from .shots import Shot, opengl_camera_to_world

_SCRIPT = Path(__file__).resolve().parents[2] / "insideout_addon" / "studio.py"
_FINEST_MESH_MM = 0.35
# Rays a pixel along each axis. Of the painted doll at 192 x 256 pixels 2 leave errors of 34 dB, 4 of 43 (against 12):
# with 2 a model cannot show kept-back photos better than that, and goes after errors in those that it is trained on.
_RAYS = 4
_POLL_SECONDS = 0.05
_LIGHT = {
    "key": (-0.45, -0.70, 0.75),
    "fill": (0.75, 0.55, 0.45),
    "key_degrees": 35.0,
    "key_strength": 0.40,
    "fill_strength": 0.12,
    "sky_strength": 0.42,
    "glow": 0.85,
}


def take_photos(
    phantom: Phantom, shots: list[Shot], settings: CaptureSettings, seed: int, reporter: Reporter
) -> Generator[np.ndarray]:
    """Photos (height, width, 3) uint8 sRGB, in the order of `shots`.

    Cycles runs in this Python where it has the package bpy, else in a `blender` that is on the PATH. It is ended at
    once when the work is cancelled; close the generator to end it before the last photo.

    Args:
        seed: of Cycles' noise.

    Raises:
        SettingError: Cycles is asked for and there is no Blender, or Blender failed.
        Cancelled: through `reporter`.
    """
    if settings.photos_by == "cycles":
        yield from _by_cycles(phantom, shots, settings, seed, reporter)
        return
    grid = DistanceGrid.bake(phantom.surface, np.array(phantom.size_mm), settings.table_mm)
    for shot in shots:
        reporter.check()
        yield np.round(255 * render_photo(phantom, grid, shot, supersample=_RAYS)).astype(np.uint8)


def blender_command() -> list[str]:
    """How to run the studio's script: what comes before the folder's name.

    Raises:
        SettingError: neither the package bpy nor a `blender` is there.
    """
    if importlib.util.find_spec("bpy") is not None:
        code = f"import runpy; runpy.run_path({str(_SCRIPT)!r}, run_name='__main__')"
        return [sys.executable, "-c", code, "--"]
    program = shutil.which("blender")
    if program is None:
        raise SettingError(
            "photos by cycles need Blender: install the package bpy (pip install bpy==5.0.1) or put blender on the "
            "PATH, or choose --photos-by rays."
        )
    flags = ["--background", "--factory-startup", "--python-exit-code", "1"]
    return [program, *flags, "--python", str(_SCRIPT), "--"]


def _by_cycles(
    phantom: Phantom, shots: list[Shot], settings: CaptureSettings, seed: int, reporter: Reporter
) -> Generator[np.ndarray]:
    command = blender_command()
    with tempfile.TemporaryDirectory(prefix="insideout-studio-") as name:
        folder = Path(name)
        _write_scene(folder, phantom, shots, settings, seed)
        with open(folder / "log.txt", "w+b") as log:
            process = subprocess.Popen(
                [*command, str(folder)], stdin=subprocess.DEVNULL, stdout=log, stderr=log, **NO_CONSOLE
            )
            try:
                for index, shot in enumerate(shots):
                    pixels = _wait_for(folder / f"{index:04d}.npy", process, log, reporter)
                    yield pixels if shot.gain is None else exposed(pixels, shot.gain)
            finally:
                process.kill()
                process.wait()


def _wait_for(path: Path, process: subprocess.Popen[bytes], log: IO[bytes], reporter: Reporter) -> np.ndarray:
    while not path.exists():
        reporter.check()
        if process.poll() is not None and not path.exists():
            # Ctrl-C in a terminal ends Blender too.
            reporter.check()
            log.seek(0)
            said = log.read().decode("utf-8", "replace")
            why = _what_failed(said) or f"exit code {process.returncode}"
            raise SettingError(f"photos by cycles: Blender stopped ({why}); choose --photos-by rays.")
        time.sleep(_POLL_SECONDS)
    pixels: np.ndarray = np.load(path)
    path.unlink()
    return pixels


def _what_failed(said: str) -> str:
    """The last exception in a log, which Blender ends with lines of its own; else its last line, "" where none is."""
    lines = said.strip().splitlines()
    exceptions = [line for line in lines if re.match(r"[\w.]+(Error|Exception)\b", line)]
    return (exceptions or lines or [""])[-1]


def _write_scene(folder: Path, phantom: Phantom, shots: list[Shot], settings: CaptureSettings, seed: int) -> None:
    """scene.json and mesh.npz, as the script describes them."""
    size = max(phantom.size_mm)
    # A colour a vertex: as fine as a pixel of the photos, where that is not finer than the painting.
    spacing = float(np.clip(0.8 * size / settings.photo_height, min(_FINEST_MESH_MM, size / 300), size / 60))
    grid = DistanceGrid.bake(phantom.surface, np.array(phantom.size_mm), spacing)
    vertices, faces = surface_mesh(grid)
    colors = srgb_to_linear(np.asarray(phantom.color(vertices, grid.normals(vertices)), np.float64))
    np.savez(folder / "mesh.npz", vertices=vertices, faces=faces, colors=colors.astype(np.float32))
    write_json(
        folder / "scene.json",
        {
            "width": settings.photo_width,
            "height": settings.photo_height,
            "samples": settings.samples,
            "seed": seed,
            "background": srgb_to_linear(np.asarray(BACKGROUND)),
            "table": float(vertices[:, 2].min()) if "table" in settings.effects else None,
            "light": _LIGHT,
            "photos": [_photo(shot) for shot in shots],
        },
    )


def _photo(shot: Shot) -> dict[str, object]:
    cameras = [replace(shot.camera, world_to_camera=end) for end in shot.ends] if shot.ends else [shot.camera]
    return {
        "poses": [opengl_camera_to_world(camera) for camera in cameras],
        "focal": shot.camera.fx,
        "aperture": shot.aperture_mm or None,
        "focus": shot.focus_mm or None,
        "open": shot.open,
    }
