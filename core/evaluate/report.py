"""The figures of a finished run: held-out views of the final model and of either modality alone, and chamfer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ..gaussians import GaussianSet, Modality
from ..render.options import SplatOptions
from ..render.voxels import LastAverages
from ..run_folder import RunFolder
from ..sections import SectionView, choose_planes
from ..similarity import Similarity
from ..threshold import air_threshold
from ..volume import Volume
from . import heldout
from .photos import kept_effects, photo_background, read_views, registered_photos, spread
from .reference import GIVEN, reference_volume
from .shells import SHELL_STEPS, shell_distances

if TYPE_CHECKING:
    from ..stages.context import StageContext

# Held-out photos are compared at no more than this many pixels along their long side.
PHOTO_SIZE = 800
_NO_PHOTOS = {"note": "the capture has no photos that could be held out"}
_NO_XRAY = {"note": "the capture has no X-ray data"}
_FOLLOWED = {"note": "splats began from this volume, its held-out sections included: this is how well they follow it"}


@dataclass(frozen=True, eq=False)
class _Models:
    """The run's models.

    Attributes:
        final: the fused model, or the only modality there is.
        rgb: RGB splats alone (3DGS), in the photo frame.
        xray: radiative splats alone, in mm.
        similarity: photo frame to mm, None when there was nothing to align.
    """

    final: GaussianSet | None
    rgb: GaussianSet | None
    xray: GaussianSet | None
    similarity: Similarity | None

    @property
    def rgb_in_mm(self) -> GaussianSet | None:
        if self.rgb is None or self.similarity is None:
            return None
        return self.rgb.transformed(self.similarity)


def evaluate_run(context: StageContext, averages: LastAverages | None = None) -> dict[str, Any]:
    """Measures a finished run.

    Args:
        averages: what the model was voxelised with for the run's files.

    Returns:
        `heldout.photos` {psnr, ssim}, `heldout.projections` {psnr}, `heldout.sections` {psnr, ssim, piqe}, each of
        the final model with `rgb` and `xray` holding the same of that modality alone (of photos: radiative splats with
        the display opacities that `internal` learnt, in one colour); `chamfer_mm` of RGB against
        radiative splats by step (none, align, internal), hidden points removed from 20 views. What cannot be
        measured is None with a `note` that says why. JSON-able.

    Raises:
        Cancelled: the user asked to stop.
    """
    models = _load_models(context.run)
    photos = _photos(context, models)
    projections = _projections(context, models)
    sections = _sections(context, models, averages or LastAverages())
    context.progress("report", part="chamfer", fraction=0.9)
    distances, details = _chamfer_by_step(context)
    return {
        "heldout": {"photos": photos, "projections": projections, "sections": sections},
        "chamfer_mm": distances,
        "chamfer": details,
        "splats": {
            name: None if model is None else len(model)
            for name, model in (("final", models.final), ("rgb", models.rgb), ("xray", models.xray))
        },
    }


def _load_models(run: RunFolder) -> _Models:
    rgb, xray = _made(run, "surface", "rgb"), _made(run, "surface", "xray")
    aligned = run.is_done("align") and "similarity" in run.report("align")
    candidates = (_made(run, "fuse", "fused"), _made(run, "internal", "xray"), xray, rgb)
    final = next((one for one in candidates if one is not None), None)
    return _Models(final, rgb, xray, run.similarity() if aligned else None)


def _made(run: RunFolder, stage: str, name: str) -> GaussianSet | None:
    return run.read_set(stage, name).to_numpy() if run.has_set(stage, name) else None


def _photos(context: StageContext, models: _Models) -> dict[str, Any]:
    photos = registered_photos(context)
    held_out = [] if photos is None else [p for p in photos.photos if p.held_out and p.camera is not None]
    if photos is None or not held_out:
        return {"psnr": None, "ssim": None, "rgb": None, "xray": None, **_NO_PHOTOS}

    def tick() -> None:
        context.progress("report", part="photos", fraction=0.4)

    background = photo_background(photos, tick=tick)
    views = read_views(held_out, PHOTO_SIZE, background, tick)
    options = SplatOptions.of(context.run)
    known = {str(photo.path): photo.camera for photo in photos.photos if photo.camera is not None}

    def measured(model: GaussianSet, in_mm: bool) -> dict[str, Any]:
        seen, cameras, scale = views, known, 1.0
        if in_mm and models.similarity is not None:
            frame, scale = models.similarity, models.similarity.scale
            seen = [(camera.transformed(frame), image) for camera, image in views]
            cameras = {name: camera.transformed(frame) for name, camera in known.items()}
        effects = kept_effects(context, cameras, scale)
        return heldout.photo_figures(model, seen, background, context.kernel, tick, options, effects)

    rgb = None if models.rgb is None else measured(models.rgb, in_mm=False)
    if models.similarity is None or models.final is None:
        return {**(rgb or {"psnr": None, "ssim": None}), "rgb": rgb, "xray": None, "peak": 1.0}
    xray, shown = None, _radiative(_made(context.run, "internal", "xray"))
    # `surface` fits densities alone: how opaque its splats are shown is learnt later.
    if shown is not None and len(shown):
        training = [p for p in photos.photos if not p.held_out and p.camera is not None] or held_out
        color = heldout.mean_color([image for _, image in read_views(spread(training, 12), 200, background, tick)])
        xray = measured(heldout.in_one_color(shown, color), in_mm=True)
        xray["note"] = "X-rays know no colour: radiative splats as refined, in the training photos' mean colour"
    return {
        **measured(models.final, in_mm=True),
        "rgb": rgb,
        "xray": xray,
        "peak": 1.0,
        "background": None if background is None else [float(v) for v in background],
    }


def _projections(context: StageContext, models: _Models) -> dict[str, Any]:
    projections = context.projections
    if projections is None or models.xray is None or models.final is None or not projections.held_out.any():
        note = "the capture has no projections that could be held out"
        return {"psnr": None, "rgb": None, "xray": None, "note": note}

    def tick() -> None:
        context.progress("report", part="projections", fraction=0.6)

    rgb, in_mm = None, models.rgb_in_mm
    if in_mm is not None:
        attenuation = heldout.fitted_attenuation(in_mm, projections, context.kernel, tick)
        as_density = heldout.opacity_as_density(in_mm)
        rgb = heldout.projection_figures(as_density, projections, context.kernel, tick, attenuation)
        rgb["fitted_attenuation_per_mm"] = attenuation
        rgb["note"] = "RGB splats have no density: opacity times one attenuation fitted to training projections"
    return {
        **heldout.projection_figures(models.final, projections, context.kernel, tick),
        "rgb": rgb,
        "xray": heldout.projection_figures(models.xray, projections, context.kernel, tick),
        "peak": heldout.projection_peak(projections),
        "peak_is": "largest line integral of the held-out projections",
    }


def _sections(context: StageContext, models: _Models, averages: LastAverages) -> dict[str, Any]:
    if models.xray is None or models.final is None:
        return {"psnr": None, "ssim": None, "piqe": None, "rgb": None, "xray": None, **_NO_XRAY}

    def tick() -> None:
        context.progress("report", part="sections", fraction=0.8)

    volume, source = reference_volume(context)
    views = _section_views(context, volume)
    held_out = [view for view in views if view.held_out]
    training = [view for view in views if not view.held_out][::3]
    peak, air = heldout.section_peak(volume), air_threshold(volume.values)
    references = heldout.references_of(volume, held_out)

    def measured(model: GaussianSet) -> dict[str, Any]:
        # Voxels stand for averages: values of splats at points would rate a sharper model down.
        images = heldout.references_of(averages(model, volume, tick), held_out)
        return heldout.section_figures(images, references, peak, air)

    unit = "relative" if context.capture.densities.relative else "mm⁻¹"
    rgb, in_mm = None, models.rgb_in_mm
    if in_mm is not None:
        factor = heldout.fitted_factor(
            heldout.occupancy_images(in_mm, training, context.kernel, tick),
            heldout.references_of(volume, training),
        )
        occupied = heldout.occupancy_images(in_mm, held_out, context.kernel, tick)
        rgb = heldout.section_figures([factor * image for image in occupied], references, peak, air)
        rgb["fitted_attenuation_per_mm"] = factor
        rgb["note"] = "RGB splats have no density: occupancy times one attenuation fitted to training sections"
    return {
        **measured(models.final),
        "rgb": rgb,
        "xray": measured(models.xray),
        "reference": source,
        **(_FOLLOWED if source == GIVEN else {}),
        "reference_piqe": heldout.section_figures(references, references, peak, air)["piqe"],
        "peak": peak,
        "peak_is": f"99.9th percentile of the reference volume (of a thin rod its median), {unit}; PIQE's window, too",
    }


def _section_views(context: StageContext, volume: Volume) -> list[SectionView]:
    """The series that `internal` trained on, so that its held-out planes are held out here too."""
    run = context.run
    settings = run.report("internal").get("settings", {}) if run.is_done("internal") else {}
    chosen = {"planes": settings["planes"], "step_mm": settings["step_mm"]} if settings else {}
    return choose_planes(volume.box_mm, pixel_mm=volume.spacing_mm, **chosen)


def _chamfer_by_step(context: StageContext) -> tuple[dict[str, float | None], dict[str, Any]]:
    """RGB against radiative splats: raw frames, after align, after internal."""
    found = shell_distances(context.run, context.seed, context.reporter.check) or {}
    told = {
        "measure": "mean of the two mean nearest distances between centres seen from 20 views (hidden points removed)",
        "none_is": "RGB in the photo frame, its lengths taken as mm, as the paper's baseline does",
    }
    return {step: found[step]["mm"] if step in found else None for step in SHELL_STEPS}, {**told, **found}


def _radiative(gaussians: GaussianSet | None) -> GaussianSet | None:
    """The splats that came from X-rays."""
    return None if gaussians is None else gaussians.select(gaussians.modality == Modality.XRAY)
