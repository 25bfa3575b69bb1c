"""The options that save steps of the surface stage, each switched on alone: seconds and held-out dB."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..capture.read import read_capture
from ..errors import CaptureError
from ..run_folder import RunFolder
from ..settings import Settings
from ..stages.context import StageContext
from .machine import machine

GROWTH = ((0.3, 0.5),)


def measure_options(
    capture: Path, preset: str = "draft", seed: int = 0, tell: Callable[[str], None] | None = None
) -> list[dict[str, Any]]:
    """Fits the photos of a capture with none of the options, with each alone, and with all.

    Returns:
        A row each: `options`, `seconds`, `iterations` made, `splats`, `heldout_psnr` (dB, at the end); the machine.

    Raises:
        CaptureError: the capture cannot be read or has no photos.
        SettingError: there is no such preset.
    """
    from ..stages import initialize, surface
    from ..train.schedule import Growth, Stop

    tell = tell or (lambda _: None)
    settings, facts = Settings.of(preset, seed), machine()
    found = read_capture(capture)
    if found.photos is None:
        raise CaptureError(f"{capture}: has no photos; bench options fits photos, give a capture with a photos folder.")
    only_photos = replace(found, projections=None, volume=None)
    chosen = settings.stages["surface"]
    plain = replace(chosen.rgb, growth=Growth(), stop=None, strategy=replace(chosen.rgb.strategy, budget=False))
    on: dict[str, dict[str, Any]] = {
        "growth": {"growth": Growth(GROWTH)},
        "budget": {"strategy": replace(plain.strategy, budget=True)},
        "stop": {"stop": Stop()},
    }
    cases: dict[str, dict[str, Any]] = {
        "none": {},
        **on,
        "all": {key: v for one in on.values() for key, v in one.items()},
    }
    rows = []
    with tempfile.TemporaryDirectory(prefix="insideout-bench-") as folder:
        context = StageContext(only_photos, RunFolder(Path(folder)), seed)
        tell("starting from the photos")
        initialize.run(context, settings.stages["initialize"])
        for name, changes in cases.items():
            tell(f"fitting the photos, options: {name}")
            begin = time.perf_counter()
            rgb = surface.run(context, replace(chosen, rgb=replace(plain, **changes)))["rgb"]
            seconds = time.perf_counter() - begin
            context.checkpoint("surface", "rgb").unlink(missing_ok=True)
            row = {"options": name, "preset": preset, "seconds": round(seconds, 3), "iterations": rgb["iterations"]}
            rows.append({**row, "splats": rgb["splats"], "heldout_psnr": _last_heldout(context, rgb), **facts})
    return rows


def _last_heldout(context: StageContext, rgb: dict[str, Any]) -> float | None:
    """Of the set that was left, on all held-out photos: the curve in the report ends before an early stop."""
    import numpy as np

    from ..evaluate.metrics import psnr
    from ..evaluate.photos import registered_photos
    from ..render import splat
    from ..stages.surface.photos import TrainingPhotos

    photos = registered_photos(context)
    if photos is None:
        return None
    background = None if rgb["background"] is None else np.array(rgb["background"])
    heldout = TrainingPhotos([p for p in photos.photos if p.held_out and p.camera is not None], 10_000, background)
    final = context.run.read_set("surface", "rgb").to_torch()
    values = []
    for index in range(len(heldout)):
        camera, target, _ = heldout.read(index)
        image = splat(final, camera, background).color.clamp(0, 1)
        values.append(psnr(image.numpy(), target.numpy(), 1.0))
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
