"""The options that save steps of the surface stage, each switched on alone: seconds and held-out dB of each half."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..capture.model import Capture
from ..capture.read import read_capture
from ..errors import CaptureError, SettingError
from ..run_folder import RunFolder
from ..settings import Settings
from ..stages.context import StageContext
from .compiling import compile_kernels
from .machine import machine

HALVES = ("rgb", "xray")
GROWTH = ((0.3, 0.5),)


def measure_options(
    capture: Path,
    preset: str = "draft",
    seed: int = 0,
    halves: Iterable[str] = HALVES,
    tell: Callable[[str], None] | None = None,
) -> list[dict[str, Any]]:
    """Fits each half of a capture alone: with none of the options, with each of them, and with all.

    Args:
        halves: "rgb" (photos) and "xray" (projections); those that the capture does not have are left out.

    Returns:
        A row each: `half`, `options`, `seconds`, `cpu_seconds` (of all threads together: what other programs take is
        not in it), `iterations` made, `splats`, `heldout_psnr` (dB, of the set that was left, on all held-out views);
        the machine.

    Raises:
        CaptureError: the capture cannot be read or has none of these halves.
        SettingError: there is no such preset or half.
    """
    names, settings, facts = tuple(halves), Settings.of(preset, seed), machine()
    for name in names:
        if name not in HALVES:
            raise SettingError(f"--half {name}: there is no such half; choose {' or '.join(HALVES)}.")
    found = read_capture(capture)
    parts = {
        "rgb": replace(found, projections=None, volume=None) if found.photos else None,
        "xray": replace(found, photos=None, volume=None) if found.projections else None,
    }
    given = {name: part for name in names if (part := parts[name]) is not None}
    if not given:
        raise CaptureError(f"{capture}: has nothing to fit for --half {', '.join(names)}; give a capture that has it.")
    rows = [
        row for name, part in given.items() for row in _measure_half(name, part, settings, tell or (lambda _: None))
    ]
    return [{**row, "preset": preset, **facts} for row in rows]


def option_cases(half: str, chosen: Any) -> dict[str, Any]:
    """Settings of a half by the options that are on: none of them, each alone, all.

    Args:
        chosen: `RgbSettings` or `XraySettings` of a preset; its own options are switched off.
    """
    from ..train.schedule import Growth, Stop

    frugal = replace(chosen.strategy, budget=True)
    off: dict[str, Any] = {"stop": None, "strategy": replace(chosen.strategy, budget=False)}
    on: dict[str, dict[str, Any]] = {"budget": {"strategy": frugal}, "stop": {"stop": Stop()}}
    if half == "rgb":
        off["growth"] = Growth()
        on = {"growth": {"growth": Growth(GROWTH)}, **on}
    together = {key: value for changes in on.values() for key, value in changes.items()}
    return {
        name: replace(chosen, **{**off, **changes}) for name, changes in {"none": {}, **on, "all": together}.items()
    }


def _measure_half(half: str, capture: Capture, settings: Settings, tell: Callable[[str], None]) -> list[dict[str, Any]]:
    from ..stages import initialize, surface

    rows = []
    with tempfile.TemporaryDirectory(prefix="insideout-bench-") as folder:
        context = StageContext(capture, RunFolder(Path(folder)), settings.seed)
        compile_kernels(capture, settings, context.reporter)
        tell(f"{half}: making the start")
        initialize.run(context, settings.stages["initialize"])
        chosen = settings.stages["surface"]
        for name, changed in option_cases(half, getattr(chosen, half)).items():
            tell(f"{half}: fitting, options: {name}")
            begin = time.perf_counter(), time.process_time()
            report = surface.run(context, replace(chosen, **{half: changed}))[half]
            seconds, processor = time.perf_counter() - begin[0], time.process_time() - begin[1]
            context.checkpoint("surface", half).unlink(missing_ok=True)
            times = {"seconds": round(seconds, 3), "cpu_seconds": round(processor, 3)}
            photos = half == "rgb"
            quality = _photo_quality(context, report) if photos else _projection_quality(context)
            made = {"iterations": report["iterations"], "splats": report["splats"], "heldout_psnr": quality}
            rows.append({"half": half, "options": name, **times, **made})
    return rows


def _photo_quality(context: StageContext, report: dict[str, Any]) -> float | None:
    """Of the set that was left, on all held-out photos: the curve in the report ends before an early stop.

    It is drawn as it was trained, which the half's report tells: a stage that is run by itself leaves none beside it.
    """
    import numpy as np

    from ..capture.photos import read_photo
    from ..evaluate.heldout import photo_figures
    from ..evaluate.photos import registered_photos
    from ..render.options import SplatOptions

    photos = registered_photos(context)
    if photos is None:
        return None
    red, green, blue = report["background"] or (0.0, 0.0, 0.0)
    heldout = [photo for photo in photos.photos if photo.held_out and photo.camera is not None]
    # Read as they are needed: at full size they may not fit into memory together.
    pictures = (read_photo(photo, None, (red, green, blue)) for photo in heldout)
    views = ((camera, image) for image, camera in pictures)
    final = context.run.read_set("surface", "rgb")
    behind, options = np.array([red, green, blue]), SplatOptions(**report["options"])
    quality: float | None = photo_figures(final, views, behind, context.kernel, context.reporter.check, options)["psnr"]
    return quality


def _projection_quality(context: StageContext) -> float | None:
    """Of the set that was left, on all held-out projections."""
    from ..evaluate.heldout import projection_figures

    projections = context.capture.projections
    if projections is None:
        return None
    final = context.run.read_set("surface", "xray")
    quality: float | None = projection_figures(final, projections, context.kernel, context.reporter.check)["psnr"]
    return quality
