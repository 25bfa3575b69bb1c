"""The stage itself: photos, then X-rays."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ...effect_names import XRAY_EFFECTS
from ...evaluate.reference import make_reference
from ...fdk_process import end_fdk, prepare_fdk
from ...progress import Progress
from ...render.kernels.cpu import announce
from ...told import Told
from ...volume import compress
from ..context import StageContext
from ..density_fit import fit_to_projections
from ..effects import FILES, NUMBERS, choose, keep_choice
from ..photo_effects import backdrops, before_another_background, look_at_photos
from . import photos as from_photos
from . import xray as from_xray

if TYPE_CHECKING:
    from ...effects.choose import Choice
    from ...effects.request import Request


@dataclass(frozen=True)
class InitializeSettings:
    """Where the first splats come from.

    Attributes:
        hull_cells: of the visual hull along the object's longest side, where the background is plain; 0 for none.
        most_rgb: at most so many coloured splats.
        opacity: of the coloured splats (3DGS: 0.1).
        start: of the radiative splats: "fdk", "acui" or "coarse", see `xray.first_splats`. Without projections
            nothing would split them where the object is fine, so a volume alone has "fdk".
        xray_splats: for "fdk".
        coarse_splats: for "coarse".
        acui_stride: voxels, for "acui".
        acui_scale: standard deviation of the splats of "acui" and "coarse" as a share of their cells.
        density_factor: the first densities as a share of the volume's; None to keep its total and then to fit the
            projections.
        fdk_window: "ramp" or "hann".
    """

    hull_cells: int = 96
    most_rgb: int = 50_000
    opacity: float = 0.1
    start: str = "fdk"
    xray_splats: int = 50_000
    coarse_splats: int = 2500
    acui_stride: int = 8
    acui_scale: float = 0.5
    density_factor: float | None = None
    fdk_window: str = "hann"


PRESETS: dict[str, InitializeSettings] = {
    "draft": InitializeSettings(most_rgb=20_000, xray_splats=20_000, start="coarse"),
    "standard": InitializeSettings(start="coarse"),
    "paper": InitializeSettings(start="coarse"),
}


def reason_to_skip(context: StageContext) -> Told | None:
    """Never: every capture has something to start from."""
    return None


def run(context: StageContext, settings: InitializeSettings) -> dict[str, Any]:
    """Leaves `photos.json` and `rgb.ply` for photos, `volume.npz` and `xray.ply` for X-rays, and for projections
    `reference.npz`, which only the report reads; where effects were looked for, what was found (`core.stages.effects`).

    Returns:
        `photos` (registered, names of those that were not placed and of those before another background, points by
        origin), `xray` (start, density_factor to fit the projections, voxels), each with its `seconds`; `splats`.

    Raises:
        CaptureError: too few photos register, or the projections cannot be reconstructed.
        Cancelled: the user asked to stop.
    """
    capture = context.capture
    report: dict[str, Any] = {"splats": {}}
    if capture.needs_fdk and not context.is_kept("initialize", "volume"):
        prepare_fdk()
    if capture.photos is not None:
        # What an earlier run left is made anew, and may be of photos that are no longer there.
        kept = context.is_kept("initialize", "photos")
        behind = backdrops(context.run.stage("initialize") / "photos.json") if kept else []
        report["photos"] = context.once(
            "initialize", "photos", lambda: _from_photos(context, settings), ("photos.json", "rgb.ply", *behind)
        )
        report["splats"]["rgb"] = report["photos"].pop("splats")
        _look_at_photos(context)
    if capture.projections is not None or capture.volume is not None:
        _look_at_rays(context)
        context.progress("initialize", part="fdk", fraction=0.75)
        left = context.once("initialize", "volume", lambda: _leave_volumes(context, settings), ("volume.npz",))
        started = time.monotonic()
        _compress_volumes(context)
        report["xray"] = _from_xray(context, settings)
        report["xray"]["seconds"] = left.get("seconds", 0.0) + time.monotonic() - started
        report["splats"]["xray"] = report["xray"].pop("splats")
    return report


def _from_photos(context: StageContext, settings: InitializeSettings) -> dict[str, Any]:
    """Leaves `photos.json` and `rgb.ply`; what to report of them."""
    started = time.monotonic()
    photos, note = from_photos.place_photos(context)
    context.progress("initialize", part="points", fraction=0.5)
    gaussians, found = from_photos.first_splats(
        context, photos, settings.hull_cells, settings.most_rgb, settings.opacity, context.seed
    )
    context.run.write_set("initialize", "rgb", gaussians)
    registered = {photo.path.resolve() for photo in photos.photos if photo.camera is not None}
    given = [] if context.capture.photos is None else [photo.path for photo in context.capture.photos.photos]
    other = before_another_background(context)
    return {
        "registered": len(registered),
        "given": len(given),
        "left_out": [path.name for path in given if path.resolve() not in registered and path not in other],
        "other_background": [path.name for path in other],
        "points": found,
        "splats": len(gaussians),
        "seconds": time.monotonic() - started,
        **({"note": note} if note else {}),
    }


def _look_at_photos(context: StageContext) -> None:
    """Leaves `photo-effects.json` where effects of photos are asked for."""
    request = context.request
    if request is None or not request.concerns("photos"):
        return

    def look() -> dict[str, Any]:
        look_at_photos(context, "initialize", 0.7)
        return {}

    context.once("initialize", "photo-effects", look, (FILES["photos"],))


def _look_at_rays(context: StageContext) -> None:
    """Leaves `ray-effects.json` and what goes with it where effects of X-rays are asked for."""
    request, projections = context.request, context.capture.projections
    if request is None or projections is None or not request.concerns("xray"):
        return

    def look() -> dict[str, Any]:
        from ...effects.choose import look_at_rays
        from ...effects.rays import RayEvidence

        evidence = RayEvidence(projections, context.reporter.silent(), context.seed)

        def look_for(narrower: Request) -> Choice:
            message = "looking for effects in the X-rays"
            context.progress("initialize", part="effects", fraction=0.71, message=message)
            choice = look_at_rays(narrower, evidence)
            if "ring" in choice.numbers:
                from .rings import learn_offsets

                learn_offsets(context, choice, 0.71, 0.74, narrower.off - request.off)
            return choice

        def tell_gains(choice: Choice) -> str | None:
            from ..effect_gains import tell_gains_of_rays

            return tell_gains_of_rays(context, evidence, choice)

        choice = choose(context, XRAY_EFFECTS, look_for, tell_gains)
        keep_choice(context.run.stage("initialize"), "xray", choice)
        context.effects.know(choice.without)
        return {}

    context.once("initialize", "ray-effects", look, (FILES["xray"], NUMBERS))


def _leave_volumes(context: StageContext, settings: InitializeSettings) -> dict[str, Any]:
    """Leaves `volume.npz`, and for the report the volume of all projections while ITK-RTK is there."""
    left = context.once("initialize", "fdk", lambda: _leave_volume(context, settings), ("volume.npz",))
    started = time.monotonic()
    make_reference(context, 0.9, 0.95, "initialize")
    end_fdk()
    return {**left, "seconds": left["seconds"] + time.monotonic() - started}


def _leave_volume(context: StageContext, settings: InitializeSettings) -> dict[str, Any]:
    started = time.monotonic()
    reporter = context.reporter.within(0.75, 0.9)
    volume = from_xray.first_volume(context.capture.volume, context.projections, reporter, settings.fdk_window)
    # The user's volume stays as it is, whatever splats that are fitted to projections beside it come to be in.
    own = context.run.densities if context.capture.volume is None else context.capture.volume_densities
    # Compressing takes longer than some FDKs, which would be lost if it were broken off.
    volume.save(context.run.stage("initialize") / "volume.npz", own, compressed=False)
    return {"voxels": list(volume.values.shape[::-1]), "seconds": time.monotonic() - started}


def _compress_volumes(context: StageContext) -> None:
    # Where no reference was made, one that lies there is of an earlier run.
    for name in ("volume.npz", "reference.npz") if context.capture.needs_fdk else ("volume.npz",):
        path = context.run.stage("initialize") / name
        if path.exists():
            compress(path, context.reporter.check)


def _from_xray(context: StageContext, settings: InitializeSettings) -> dict[str, Any]:
    """Leaves `xray.ply`; what to report of it and of the volume it came from."""
    projections, volume = context.projections, context.run.volume()
    start = settings.start if projections is not None else "fdk"
    splats = from_xray.first_splats(
        volume,
        start,
        settings.coarse_splats if start == "coarse" else settings.xray_splats,
        settings.acui_stride,
        context.seed,
        settings.acui_scale,
        settings.density_factor,
    )
    factor = 1.0
    if projections is not None and settings.density_factor is None:
        context.progress("initialize", part="fit", fraction=0.95)
        announce(context.reporter, Progress("initialize", "fit", 0.95), ("radiograph",))
        splats, factor = fit_to_projections(splats, projections)
    context.run.write_set("initialize", "xray", splats)
    return {
        "start": start,
        "volume": "the capture's own" if context.capture.volume is not None else "FDK of the training projections",
        "density_factor": factor,
        "voxels": list(volume.values.shape[::-1]),
        "splats": len(splats),
    }
