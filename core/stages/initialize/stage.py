"""The stage itself: photos, then X-rays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ..context import StageContext
from . import photos as from_photos
from . import xray as from_xray


@dataclass(frozen=True)
class InitializeSettings:
    """Where the first splats come from.

    Attributes:
        hull_cells: of the visual hull along the object's longest side, where the background is plain; 0 for none.
        most_rgb: at most so many coloured splats.
        opacity: of the coloured splats (3DGS: 0.1).
        start: of the radiative splats: "fdk" or "acui".
        xray_splats: for "fdk".
        acui_stride: voxels, for "acui".
        fdk_window: "ramp" or "hann".
    """

    hull_cells: int = 96
    most_rgb: int = 50_000
    opacity: float = 0.1
    start: str = "fdk"
    xray_splats: int = 50_000
    acui_stride: int = 8
    fdk_window: str = "hann"


PRESETS: dict[str, InitializeSettings] = {
    "draft": InitializeSettings(most_rgb=20_000, xray_splats=20_000),
    "standard": InitializeSettings(),
    "paper": InitializeSettings(hull_cells=0, start="acui"),
}


def reason_to_skip(context: StageContext) -> str | None:
    """Never: every capture has something to start from."""
    return None


def run(context: StageContext, settings: InitializeSettings) -> dict[str, Any]:
    """Leaves `photos.json` and `rgb.ply` for photos, `volume.npz` and `xray.ply` for X-rays.

    Returns:
        `photos` (registered, names left out, points by origin), `xray` (start, density_factor to fit the projections,
        voxels), `splats`.

    Raises:
        CaptureError: too few photos register, or the projections cannot be reconstructed.
        Cancelled: the user asked to stop.
    """
    capture, run_folder = context.capture, context.run
    report: dict[str, Any] = {"splats": {}}
    if capture.photos is not None:
        photos, note = from_photos.place_photos(context)
        context.progress("initialize", part="points", fraction=0.5)
        gaussians, found = from_photos.first_splats(
            context, photos, settings.hull_cells, settings.most_rgb, settings.opacity, context.seed
        )
        run_folder.write_set("initialize", "rgb", gaussians)
        registered = {photo.path for photo in photos.photos if photo.camera is not None}
        report["photos"] = {
            "registered": len(registered),
            "given": len(capture.photos.photos),
            "left_out": [photo.path.name for photo in capture.photos.photos if photo.path not in registered],
            "points": found,
            **({"note": note} if note else {}),
        }
        report["splats"]["rgb"] = len(gaussians)
    if capture.projections is not None or capture.volume is not None:
        context.progress("initialize", part="fdk", fraction=0.75)
        volume = from_xray.first_volume(capture, context.reporter, settings.fdk_window)
        volume.save(run_folder.stage("initialize") / "volume.npz")
        splats = from_xray.first_splats(
            volume, settings.start, settings.xray_splats, settings.acui_stride, context.seed
        )
        factor = 1.0
        if capture.projections is not None:
            context.progress("initialize", part="fit", fraction=0.95)
            splats, factor = from_xray.fit_to_projections(splats, capture.projections)
        run_folder.write_set("initialize", "xray", splats)
        report["xray"] = {
            "start": settings.start,
            "volume": "the capture's own" if capture.volume is not None else "FDK of the training projections",
            "density_factor": factor,
            "voxels": list(volume.values.shape[::-1]),
        }
        report["splats"]["xray"] = len(splats)
    return report
