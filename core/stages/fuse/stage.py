"""The stage itself: the joint model as it is, or transfer, clones and a short finish on the photos."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...gaussians import GaussianSet, Modality
from ...run_folder import RunFolder
from ...told import Told
from ...train.loop import Measured, Task, known
from ...train.schedule import Decay
from ..context import StageContext
from ..measures import WITH_EFFECTS
from ..photo_series import PhotoSeries
from ..refine import refine
from .finish import FinishLoss, limit_display, seen_by_photos
from .transfer import Fusion, color_as_photos, color_by_density, fuse_sets


@dataclass(frozen=True)
class FuseSettings:
    """How the two sets become one.

    Attributes:
        percentile: photo splats with λmax(Σ) up to this percentile are cloned (the paper's p).
        depth_spacings: radiative splats within this many median spacings of the surface take photo colours.
        paint_all: all radiative splats take photo colours, as the paper's equation says.
        iterations: of the finish, each one photo; 0 leaves it out.
        photo_size: long side of the photos in pixels.
        structure_weight: λs of the photos' loss.
        shown_at_surface: display opacities start so low that no radiative splat shows more than this at the surface.
        keep_weight: pulls display opacities to what `internal` found; weight of their mean squared change.
        opacity_rate: Adam's rate for display opacities' logits.
        color_rate: for the DC colours; the other bands have a twentieth of it, as in 3DGS.
    """

    percentile: float = 95.0
    depth_spacings: float = 2.0
    paint_all: bool = False
    iterations: int = 600
    photo_size: int = 800
    structure_weight: float = 0.2
    shown_at_surface: float = 0.03
    keep_weight: float = 0.03
    opacity_rate: float = 0.05
    color_rate: float = 2.5e-3


PRESETS: dict[str, FuseSettings] = {
    "draft": FuseSettings(iterations=150, photo_size=400, opacity_rate=0.15),
    "standard": FuseSettings(),
    "paper": FuseSettings(iterations=3_000, photo_size=1600, opacity_rate=0.02),
}


def reason_to_skip(context: StageContext) -> Told | None:
    """Why there is nothing to make a model of, or None."""
    if all(_best(context.run, wanted) is None for wanted in (_XRAY, _RGB, _RGB_ALONE)):
        return Told("neither photos nor X-rays left a model")
    return None


def run(context: StageContext, settings: FuseSettings) -> dict[str, Any]:
    """Makes `fuse/fused.ply` of the latest photo splats and radiative splats.

    Transfer and cloning follow the paper. Radiative splats are larger than the details they lie under, and drawn as
    a photo they reach out of the surface; the top 5 % of photo splats that are not cloned leave holes. A short finish
    on the training photos mends both: it changes display opacities of radiative splats near the surface and colours
    of these and of the clones. Shapes, densities and everything deeper stay, so X-rays show what they showed.

    A set that `internal` fitted to photos and X-rays together is taken as it is.

    With one modality alone the fused set is that modality, radiative splats coloured by their density.

    Returns:
        `mode`, `splats`, `photos_psnr` {rgb, transferred, finished} in dB on held-out photos (of a joint model
        `finished` alone); of transfer and clones also `clones`, `near_surface` and the finish's history.

    Raises:
        Cancelled: the user asked to stop; a checkpoint is kept.
    """
    run_folder = context.run
    joined = run_folder.is_done("internal") and run_folder.report("internal").get("mode") == "joint"
    if joined and run_folder.has_set("internal", "joint"):
        return _joined(context, settings)
    rgb, xray = _best(run_folder, _RGB), _best(run_folder, _XRAY)
    if rgb is None or xray is None:
        return _single(context, _best(run_folder, _RGB_ALONE) if rgb is None else rgb, xray)
    context.progress("fuse", part="transfer", fraction=0.0, message="colors to the radiative splats")
    fusion = fuse_sets(rgb, xray, settings.percentile, settings.depth_spacings, settings.paint_all)
    photos = PhotoSeries(context, settings.photo_size)

    def measure(gaussians: GaussianSet) -> float | None:
        return photos.measure(gaussians, context.kernel, context.reporter.check)["psnr"]

    figures = {"rgb": measure(rgb), "transferred": measure(fusion.fused)}
    fused, history = fusion.fused, None
    if len(photos) and settings.iterations > 0:
        fused, history = _finish(context, settings, fusion, photos, measure)
        figures["finished"] = measure(fused)
    run_folder.write_set("fuse", "fused", fused)
    clones = fused.modality == Modality.CLONE
    return {
        "mode": "fused",
        "splats": {"fused": len(fused), "xray": int(np.sum(~clones)), "clone": int(np.sum(clones))},
        "clones": {
            "count": int(clones.sum()),
            "left_out": len(rgb) - int(clones.sum()),
            "largest_mm": float(np.sqrt(fusion.largest_detail_mm2)),
        },
        "near_surface": {"count": int(fusion.near_surface.sum()), "depth_mm": fusion.depth_mm},
        "photos_psnr": figures,
        "finish": history,
    }


def _finish(
    context: StageContext,
    settings: FuseSettings,
    fusion: Fusion,
    photos: PhotoSeries,
    measure: Callable[[GaussianSet], float | None],
) -> tuple[GaussianSet, dict[str, Any]]:
    """The fused set after the finish, and what is to be reported of it."""
    count = len(fusion.near_surface)
    body = fusion.fused.select(slice(0, count))
    limited = limit_display(body, fusion.surface, settings.shown_at_surface)
    start = replace(
        fusion.fused, opacities=np.concatenate([limited.opacities, fusion.fused.opacities[count:]]).astype(np.float32)
    )
    context.progress("fuse", part="finish", fraction=0.05, message="looking for splats that photos see")
    seen = seen_by_photos(start, photos, context.kernel, context.reporter.check)[:count]
    fusion = color_as_photos(fusion, seen)
    start = replace(start, sh=fusion.fused.sh)
    colored = np.concatenate([fusion.near_surface, np.ones(len(start) - count, bool)])
    loss = FinishLoss(fusion.fused, colored, photos, settings.structure_weight, settings.keep_weight, context.kernel)
    rates = {
        "opacities": Decay(settings.opacity_rate, settings.opacity_rate / 10),
        "sh_dc": Decay(settings.color_rate),
        "sh_rest": Decay(settings.color_rate / 20),
    }
    task = Task(
        "fuse",
        "finish",
        settings.iterations,
        first=0.1,
        checkpoint=context.checkpoint("fuse", "finish"),
        measures=WITH_EFFECTS["fuse finish"],
        message="finishing on the photos",
        renderers=context.compiled("splat"),
    )

    def measured(gaussians: GaussianSet) -> Measured:
        return known({"photos": photos.measure_some(gaussians, context.kernel, context.reporter.check)["psnr"]})

    finished, history = refine(start, rates, loss, context.paced(task), context.reporter, measure=measured)
    finished = replace(
        finished,
        opacities=np.where(start.modality == Modality.XRAY, finished.opacities, start.opacities),
        sh=np.where(colored[:, None, None], finished.sh, start.sh),
    )
    solid = body.opacities > 0.5
    still = finished.opacities[:count][solid] > 0.5
    return finished, {
        **history,
        "limited_psnr": measure(start),
        "seen_by_photos": int(seen.sum()),
        "colored": int(fusion.near_surface.sum()),
        "solid_kept": float(still.mean()) if solid.any() else None,
    }


_XRAY = ("xray", ("internal", "surface"))
_RGB = ("rgb", ("internal", "align"))
_RGB_ALONE = ("rgb", ("surface",))


def _best(run: RunFolder, wanted: tuple[str, tuple[str, ...]]) -> GaussianSet | None:
    """The set of the latest stage that made one; empty ones do not count."""
    name, stages = wanted
    for stage in stages:
        if run.is_done(stage) and run.has_set(stage, name):
            found = run.read_set(stage, name)
            if len(found):
                return found
    return None


def _joined(context: StageContext, settings: FuseSettings) -> dict[str, Any]:
    """The set that `internal` fitted to everything is the model already."""
    joined = context.run.read_set("internal", "joint")
    context.run.write_set("fuse", "fused", joined)
    photos = PhotoSeries(context, settings.photo_size)
    photo_splats = int((joined.modality == Modality.RGB).sum())
    return {
        "mode": "joint",
        "splats": {"fused": len(joined), "xray": len(joined) - photo_splats, "rgb": photo_splats},
        "photos_psnr": {"finished": photos.measure(joined, context.kernel, context.reporter.check)["psnr"]},
    }


def _single(context: StageContext, rgb: GaussianSet | None, xray: GaussianSet | None) -> dict[str, Any]:
    if xray is not None:
        fused, mode = color_by_density(xray), "xray only: coloured by density"
        fused = replace(fused, modality=np.full(len(fused), Modality.XRAY, np.uint8))
    else:
        assert rgb is not None
        fused, mode = rgb, "rgb only: the photo splats as they are"
    context.run.write_set("fuse", "fused", fused)
    return {"mode": mode, "splats": {"fused": len(fused)}}
