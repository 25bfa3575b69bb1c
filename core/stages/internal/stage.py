"""The stage itself: both halves jointly, or each apart, where what got worse is taken back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...capture.model import Projections
from ...evaluate import heldout
from ...evaluate.chamfer import chamfer, outer_points
from ...gaussians import GaussianSet
from ...render.voxels import voxel_averages
from ...run_folder import RunFolder
from ...told import Told
from ...train.loop import Measured, Task, known
from ...train.schedule import Decay
from ..context import StageContext
from ..measures import WITH_EFFECTS
from ..photo_series import PhotoSeries
from ..refine import median_spacing, refine
from .joint import refine_jointly
from .joint_settings import PRESETS as JOINT
from .joint_settings import JointSettings, joint_of
from .rgb import ContourLoss
from .targets import SectionSeries, unit_length
from .xray import DensityLoss, DisplayLoss, clear_haze, start_display

# Photo splats that cost the photos more than this (dB), or lie further from the X-ray surface, are taken back.
_PHOTO_LOSS_DB = 0.25
_CHAMFER_LOSS = 1.005
# Share of the smallest distances that counts: photos do not see all of the surface.
_KEEP = 0.8
# Of a joint refinement, the part that learning display opacities takes.
_DISPLAY_SHARE = 0.1


@dataclass(frozen=True)
class InternalSettings:
    """How long and how hard the sections pull.

    Rates are those of Adam in a scene whose longest half side is 1: means are multiplied by that length.

    Attributes:
        xray_iterations: of densities; each one section and one projection.
        display_iterations: of display opacities; each one section.
        rgb_iterations: of photo splats; each one section and one photo.
        planes: series of sections, of "axial", "coronal", "sagittal".
        step_mm: distance between sections; min(15 mm, extent / 24) if None.
        structure_weight: λs of all losses of this stage but for the joint refinement's.
        zero_one_weight: λz, on the opacities of photo splats and the display opacities of radiative ones.
        projection_weight: of the projection's loss beside the section's, both relative to their size at the start.
        section_weight: of the contour's loss beside the photo's.
        rate: of the radiative splats' means, falling to `final_rate`; the paper's.
        final_rate: of the means at the end.
        rgb_rate: of the photo splats' means (falling to a hundredth), scales, rotations and opacities. The paper's
            5e-4 takes its 20,000 iterations to settle again; in 800 it costs the training photos 2.6 dB.
        density_rate: of log densities, falling to a tenth.
        shape_rate: of the radiative splats' log scales and rotations, falling to a tenth.
        display_rate: of display opacities' logits.
        projection_loss_db: radiative splats are taken back to what they were where following the sections of an FDK
            cost the training projections more than this; None to keep them in any case, as the paper does.
        photo_size: long side of the photos in pixels.
        joint: one set for both halves, fitted to everything at once, in place of the two halves' own refinement; None
            for the paper's route. A capture without projections, or with a volume of its own, takes that in any case:
            its densities follow the volume.
    """

    xray_iterations: int = 1500
    display_iterations: int = 400
    rgb_iterations: int = 800
    planes: tuple[str, ...] = ("axial", "coronal")
    step_mm: float | None = None
    structure_weight: float = 0.2
    zero_one_weight: float = 0.005
    projection_weight: float = 0.25
    section_weight: float = 0.5
    rate: float = 5e-4
    final_rate: float = 5e-6
    rgb_rate: float = 3e-5
    density_rate: float = 0.01
    shape_rate: float = 0.01
    display_rate: float = 0.1
    projection_loss_db: float | None = 2.0
    photo_size: int = 800
    joint: JointSettings | None = None


PRESETS: dict[str, InternalSettings] = {
    "draft": InternalSettings(
        xray_iterations=400,
        display_iterations=250,
        rgb_iterations=100,
        rgb_rate=5e-4,
        photo_size=400,
        joint=JOINT["draft"],
    ),
    "standard": InternalSettings(joint=JOINT["standard"]),
    # Three times the steps of `standard`, at the rates of so many.
    "paper": InternalSettings(
        xray_iterations=4500,
        display_iterations=1200,
        rgb_iterations=2400,
        rate=3e-4,
        final_rate=3e-6,
        rgb_rate=1.7e-5,
        density_rate=0.006,
        shape_rate=0.006,
        photo_size=1600,
        joint=JOINT["paper"],
    ),
}


def reason_to_skip(context: StageContext) -> Told | None:
    """Why there is nothing to refine, or None."""
    if not context.run.has_set("surface", "xray"):
        return Told("there is no X-ray data: photos say nothing about the inside")
    if not len(context.run.read_set("surface", "xray")):
        return Told("surface left no radiative splats")
    if not (context.run.path / "initialize" / "volume.npz").exists():
        return Told("there is no volume to take sections from")
    return None


def run(context: StageContext, settings: InternalSettings) -> dict[str, Any]:
    """Refines `surface/xray.ply` and `align/rgb.ply` to `internal/xray.ply` and `internal/rgb.ply`.

    With `settings.joint`, projections and no volume but their FDK, all splats become one set, fitted to photos,
    projections and sections together (see `refine_jointly`); without aligned photos, radiative splats alone.

    Else, as the paper has it, radiative splats follow the sections of the volume (the user's, else the FDK of the
    training projections) and the projections together; their display opacity is learnt apart from their density, as
    occupancy. Densities follow no grey values that fit no projections. Photo splats follow the sections' outer contour
    with their colours frozen, and the photos. What is taken back is decided on training views: held-out ones measure
    only.

    Returns:
        `mode` ("joint" or "apart"), `planes` {training, held_out, spacing_mm}, `splats`, and:

        joint: `display`, `joint` (see `refine_jointly`) and, with photos, `similarity` (the photo frame's, refined).
        `internal/joint.ply` is that set, `internal/xray.ply` those of it that attenuate, `internal/rgb.ply` the photo
        splats as `align` left them, in the refined frame.

        apart: for `xray` and `rgb` losses, held-out figures `before` and `after`, iterations and why it was taken back
        (`taken_back`, None if not). Of `xray`, figures of sections and `projection_factor` (of the projection's loss
        beside the section's) are None where densities follow no grey values. Of `rgb`, `surface_chamfer_mm` is to the
        volume's outside surface, the worst fifth of each way trimmed; `chamfer_mm` is to the centres of the radiative
        splats seen from 20 views (the paper's measure), which lie inside of that surface.

    Raises:
        Cancelled: the user asked to stop; a checkpoint is kept.
    """
    # Else water of another attenuation would pull at what was fitted to the projections.
    own = context.capture.volume_in_model()
    volume = context.run.volume() if own is None else own
    series = SectionSeries(volume, settings.planes, settings.step_mm, context.seed)
    photos_too = _has_aligned_photos(context)
    joint = joint_of(settings.joint, context.capture)
    if joint is not None:
        return _run_jointly(context, settings, joint, series, photos_too)
    share = 0.6 if photos_too else 1.0
    xray, xray_report = _refine_xray(context, settings, series, share)
    sets = {"xray": xray}
    report: dict[str, Any] = {
        "mode": "apart",
        "planes": _planes(series),
        "xray": xray_report,
        "splats": {"xray": len(xray)},
    }
    if photos_too:
        rgb, report["rgb"] = _refine_rgb(context, settings, series, xray, share)
        sets["rgb"] = rgb
        report["splats"]["rgb"] = len(rgb)
    else:
        report["rgb"] = {"skipped": "there are no photos in the X-ray frame"}
    _write(context.run, sets)
    return report


def _write(run: RunFolder, sets: dict[str, GaussianSet]) -> None:
    """Leaves these sets and none of an earlier run of the stage, which may have had photos or gone the other way."""
    for name, gaussians in sets.items():
        run.write_set("internal", name, gaussians)
    for name in {"joint", "rgb", "xray"} - set(sets):
        (run.path / "internal" / f"{name}.ply").unlink(missing_ok=True)


def _run_jointly(
    context: StageContext, settings: InternalSettings, how: JointSettings, series: SectionSeries, photos_too: bool
) -> dict[str, Any]:
    run = context.run
    start, rgb = run.read_set("surface", "xray"), run.read_set("align", "rgb") if photos_too else None
    photos = PhotoSeries(context, how.photo_size) if photos_too else None
    report: dict[str, Any] = {"mode": "joint", "planes": _planes(series)}
    if rgb is None or not len(rgb) or not photos:
        fitted, report["joint"] = refine_jointly(context, how, series, None, None, start, 0.0, 1 - _DISPLAY_SHARE)
        xray, report["display"] = _learn_display(context, settings, series, fitted, 1 - _DISPLAY_SHARE, 1.0)
        _write(run, {"xray": xray})
        return {**report, "splats": {"xray": len(xray)}}
    shown, report["display"] = _learn_display(context, settings, series, start, 0.0, _DISPLAY_SHARE)
    together, report["joint"] = refine_jointly(context, how, series, photos, rgb, shown, _DISPLAY_SHARE, 1.0)
    correction = report["joint"].pop("correction")
    report["similarity"] = correction.after(run.similarity()).to_json()
    xray = together.select(together.density > 0)
    # The colour half by itself: in the joint set radiative splats carry a part of the photos.
    _write(run, {"joint": together, "xray": xray, "rgb": rgb.transformed(correction)})
    return {**report, "splats": {"joint": len(together), "xray": len(xray), "rgb": len(rgb)}}


def _planes(series: SectionSeries) -> dict[str, Any]:
    held_out = len(series.held_out)
    return {"training": series.training_count, "held_out": held_out, "spacing_mm": series.spacing_mm()}


def _has_aligned_photos(context: StageContext) -> bool:
    run = context.run
    return run.is_done("align") and run.has_set("align", "rgb")


def _refine_xray(
    context: StageContext, settings: InternalSettings, series: SectionSeries, share: float
) -> tuple[GaussianSet, dict[str, Any]]:
    start = context.run.read_set("surface", "xray")
    unit = unit_length(series.volume)
    projections = context.projections
    measure = _xray_measure(context, series, projections)
    before = measure(start)
    loss = DensityLoss(
        series, projections, settings.projection_weight, settings.structure_weight, context.kernel, context.seed
    )
    follows = context.capture.can_follow_volume
    factor = loss.balance(start) if follows else None

    def measured(gaussians: GaussianSet) -> Measured:
        figures = measure(gaussians)
        return known({"sections": figures["sections_psnr"], "projections": figures["projections_psnr"]})

    rates = {
        "means": Decay(settings.rate * unit, settings.final_rate * unit),
        "scales": Decay(settings.shape_rate, settings.shape_rate / 10),
        "quats": Decay(settings.shape_rate, settings.shape_rate / 10),
        "density": Decay(settings.density_rate, settings.density_rate / 10),
    }
    task = Task(
        "internal",
        "xray",
        settings.xray_iterations,
        last=0.8 * share,
        checkpoint=context.checkpoint("internal", "xray"),
        measures=2,
        message="following sections of the volume",
        renderers=context.compiled("section", *(() if projections is None else ("radiograph",))),
    )
    if follows:
        task = context.paced(task)
    else:
        task = replace(context.paced(task, 0), iterations=0)
    refined, history = refine(start, rates, loss, task, context.reporter, series.scale, measured)
    after = measure(refined)
    allowed = settings.projection_loss_db
    taken_back = allowed is not None and _fell(
        before["training_projections_psnr"], after["training_projections_psnr"], allowed
    )
    if taken_back:
        refined = start
    shown, display_history = _learn_display(context, settings, series, refined, 0.8 * share, share)
    return shown, {
        **history,
        "display": display_history,
        "projection_factor": factor,
        "before": before,
        "after": after,
        "taken_back": "projections fell" if taken_back else None,
    }


def _learn_display(
    context: StageContext,
    settings: InternalSettings,
    series: SectionSeries,
    xray: GaussianSet,
    first: float,
    last: float,
) -> tuple[GaussianSet, dict[str, Any]]:
    """The set with display opacities, and the history with `undecided`, the share of those neither near 0 nor 1."""
    loss = DisplayLoss(series, settings.structure_weight, settings.zero_one_weight, context.kernel)
    task = Task(
        "internal",
        "display",
        settings.display_iterations,
        first=first,
        last=last,
        checkpoint=context.checkpoint("internal", "display"),
        measures=1,
    )
    rates = {"opacities": Decay(settings.display_rate)}
    shown, history = refine(start_display(xray, series), rates, loss, context.paced(task), context.reporter)
    shown = clear_haze(shown)
    undecided = float(np.mean((shown.opacities > 0.1) & (shown.opacities < 0.9))) if len(shown) else 0.0
    return shown, {**history, "undecided": undecided}


def _refine_rgb(
    context: StageContext, settings: InternalSettings, series: SectionSeries, xray: GaussianSet, share: float
) -> tuple[GaussianSet, dict[str, Any]]:
    start = context.run.read_set("align", "rgb")
    photos = PhotoSeries(context, settings.photo_size)
    if len(photos) == 0 or len(start) == 0:
        return start, {"skipped": "there are no photos to train on"}
    unit = unit_length(series.volume)
    dense = xray.density > 0.1 * np.percentile(xray.density, 99)
    outside = outer_points(xray.means[dense], seed=context.seed)
    surface = series.outside_surface()

    def measure(gaussians: GaussianSet) -> dict[str, float | None]:
        shown = photos.measure(gaussians, context.kernel, context.reporter.check)
        trained = photos.measure_training(gaussians, context.kernel, context.reporter.check)
        solid = gaussians.means[gaussians.opacities > 0.1]
        return {
            "photos_psnr": shown["psnr"],
            "photos_ssim": shown["ssim"],
            "training_photos_psnr": trained["psnr"],
            "surface_chamfer_mm": _chamfer(solid, surface, keep=_KEEP),
            "chamfer_mm": _chamfer(outer_points(solid, seed=context.seed), outside),
        }

    def measured(gaussians: GaussianSet) -> Measured:
        return known({"photos": photos.measure_some(gaussians, context.kernel, context.reporter.check)["psnr"]})

    before = measure(start)
    loss = ContourLoss(
        start,
        median_spacing(start.means),
        series,
        photos,
        settings.section_weight,
        settings.structure_weight,
        settings.zero_one_weight,
        context.kernel,
    )
    rates = {
        "means": Decay(settings.rgb_rate * unit, settings.rgb_rate * unit / 100),
        "scales": Decay(settings.rgb_rate),
        "quats": Decay(settings.rgb_rate),
        "opacities": Decay(settings.rgb_rate),
    }
    task = Task(
        "internal",
        "rgb",
        settings.rgb_iterations,
        first=share,
        checkpoint=context.checkpoint("internal", "rgb"),
        measures=WITH_EFFECTS["internal rgb"],
        message="following outer contours",
        renderers=context.compiled("section", "splat"),
    )
    refined, history = refine(start, rates, loss, context.paced(task), context.reporter, measure=measured)
    after = measure(refined)
    reason = None
    if _fell(before["training_photos_psnr"], after["training_photos_psnr"], _PHOTO_LOSS_DB):
        reason = "photos fell"
    elif _rose(before["surface_chamfer_mm"], after["surface_chamfer_mm"], _CHAMFER_LOSS):
        reason = "splats moved away from the X-ray surface"
    report = {
        **history,
        "before": before,
        "after": after,
        "taken_back": reason,
    }
    return (refined if reason is None else start), report


def _xray_measure(
    context: StageContext, series: SectionSeries, projections: Projections | None
) -> Callable[[GaussianSet], dict[str, float | None]]:
    # Beside grey values that fit no projections a model has densities of another scale, which nobody knows.
    comparable = context.capture.can_follow_volume
    references = heldout.references_of(series.volume, series.held_out) if comparable else []
    compared = {"projections_psnr": np.zeros(0, int), "training_projections_psnr": np.zeros(0, int)}
    if projections is not None:
        training = np.flatnonzero(~projections.held_out)
        compared["projections_psnr"] = np.flatnonzero(projections.held_out)
        compared["training_projections_psnr"] = training[heldout.some_of(len(training))]
    tick = context.reporter.check

    def measure(gaussians: GaussianSet) -> dict[str, float | None]:
        figures: dict[str, float | None] = {"sections_psnr": None, "sections_ssim": None}
        if comparable:
            images = heldout.references_of(voxel_averages(gaussians, series.volume, tick), series.held_out)
            sections = heldout.section_figures(images, references, series.scale, series.threshold)
            figures = {"sections_psnr": sections["psnr"], "sections_ssim": sections["ssim"]}
        for name, views in compared.items():
            figures[name] = None
            if projections is not None and len(views):
                shown = heldout.projection_figures(gaussians, projections, context.kernel, tick, views=views)
                figures[name] = shown["psnr"]
        return figures

    return measure


def _chamfer(first: np.ndarray, second: np.ndarray, keep: float = 1.0) -> float | None:
    return chamfer(first, second, keep).mm if len(first) and len(second) else None


def _rose(before: float | None, after: float | None, factor: float) -> bool:
    return before is not None and after is not None and not after <= factor * before


def _fell(before: float | None, after: float | None, allowed: float) -> bool:
    return before is not None and after is not None and not after >= before - allowed
