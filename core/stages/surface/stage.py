"""The stage itself: photos, then projections."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ...evaluate.photos import registered_photos, shown_or_put_background
from ...files import plain
from ...run_folder import RunFolder
from ...sections import choose_planes, reference_section
from ...threshold import large_attenuation
from ...told import Told
from ...train.loop import Task, optimise
from ...train.schedule import Decay, Growth, hotter, in_iterations
from ...train.smoothness import EDGE
from ...train.strategy import DefaultStrategy
from ..context import StageContext
from ..density_fit import fit_to_projections
from ..effects import RunEffects
from ..measures import WITH_EFFECTS
from ..photo_effects import look_again
from .photos import TrainingPhotos
from .rgb import RgbSettings, RgbTrainer
from .smooth_trial import SmoothTrial
from .xray import XraySettings, XrayTrainer

if TYPE_CHECKING:
    from .x_gaussian import XGaussianTrainer


@dataclass(frozen=True)
class SurfaceSettings:
    """Both halves' settings."""

    rgb: RgbSettings = field(default_factory=RgbSettings)
    xray: XraySettings = field(default_factory=XraySettings)


# No threshold: how large gradients are depends on the object (a gun of thin plastic with steel in it would end with a
# fourth of these splats, 2 dB further from its true sections). Their number grows evenly, where gradients are largest.
_FILLED = replace(XraySettings().strategy, gradient=0.0, budget=True)

# The rates of presets are not R2-Gaussian's (scales 0.005, rotation 0.001): with those thin walls are still
# on their way to being thin after 5000 iterations, with these 1500 reach more. Its L1 with long memory costs the
# terracotta figure's true sections 0.6 dB. With the largest line integral as full scale the toy gun's, a screw's, left
# its plastic to the total variation: as shares of what rays through most of it measure its sections gained 1.4 dB, and
# 1.3 more where large differences count straight on; the pharaoh's gained 0.8 by that, the matryoshka's lost 0.3 and
# the terracotta figure's 0.1. `standard` ends where more steps gain little (with squares): the terracotta figure has
# 34.4 dB after 2000 of them, 35.7 after 3000, 36.4 after 4500, 36.8 after 5400, the matryoshka 35.5 after 4500 and 35.3
# after 5400. These rates are for that many: with 1.4 times as large ones the matryoshka loses 0.3 dB, the terracotta
# figure 0.5. All that with total variation.
_SHORT = XraySettings(
    full_scale="body",
    squares_weight=60.0,
    straight_from=0.005,
    structure_weight=0.1,
    smooth_weight=0.1,
    smooth_edge=EDGE,
    memory=0.99,
    smooth_every=2,
    cutoff_sigmas=3.0,
    means_rate=Decay(4e-4, 4e-5),
    density_rate=Decay(0.02, 0.002),
    scale_rate=Decay(0.04, 0.004),
    rotation_rate=Decay(0.01, 0.001),
)

# px², the variance of a pixel, by which splats are widened and become fainter (Mip-Splatting's filter, arXiv
# 2311.16493). Beside 0.1 without becoming fainter photos that were kept back gain 0.1 to 0.8 dB in `draft` and 0.2 to
# 1.0 in `standard`, for no time, and from twice as far away 5 dB; 0.1 was 1.0 dB better than 3DGS's 0.3 on the sample,
# and no better on the softer photos of the five phantoms by Cycles. With 0.05 they are as good as with 1/12.
_LOW_PASS = 1 / 12
# Photos kept back, dB, by how many times each other was shown: with ten photos of the sample 26.1 after 100 passes,
# 26.0 after 150, 25.3 after 400; with 38 of it 30.3 after 90, 30.2 after 180; with nine real ones of a puppet 21.4
# after 100, 21.2 after 150, 22.3 after 167, 20.7 after 780, where chance is about 1 dB. What 47 photos and more bear
# was not measured: this leaves them all of `standard`'s steps.
_PASSES = 150
# Fewer splats changed photos that were kept back by +0.2 dB (ten of the sample, 22,000 for 78,000), -0.2 (eleven of an
# engine, 22,000 for 52,000) and, of the puppet, by -0.2 (20,000 for 121,000) and +0.5 to +1.5 (20,000 for 149,000), in
# 0.3 to 0.6 of the time.
_SPLATS_PER_PAIR = 250.0

_STANDARD = SurfaceSettings(
    rgb=RgbSettings(
        growth=Growth(((0.1, 0.25), (0.3, 0.5))),
        degree=1,
        # With rates that stay, photos that were kept back lost 0.1 to 0.3 dB in the last quarter of 7000
        # iterations, the photo half alone. Falling they gained 0.2 dB on toy gun and pharaoh and 0.4 on the sample,
        # of which a whole run gained 0.3; of 3000 iterations neither was better, of 1500 and of a `draft` rates
        # that stay were, by 0.2 to 0.4 dB.
        decay=Decay(2.0, 0.2),
        low_pass=_LOW_PASS,
        mip_filter=True,
        strategy=DefaultStrategy(reset_every=3000, most=150_000),
        passes=_PASSES,
        splats_per_pair=_SPLATS_PER_PAIR,
    ),
    # Total variation lowers edges as it does streaks, so that it may weigh but a tenth of what it does where edges are
    # let be: by that true sections of five objects gained 0.4 to 2.3 dB, projections 0.1 to 0.3. Edges from 3 % on
    # cost two of them 0.2 and 0.8 of that, a third of the weight four 0.1 to 0.9 (the toy gun gained 0.2), three times
    # the weight two 0.1 and 1.1.
    # That weight suits walls of one density, not the grain of a cast engine: a third of it brought true sections of its
    # real scan, X-rayed anew, 2.4 dB, a real head's 0.1 and 0.3. So a third is tried beside it: the five objects keep
    # all of it, the engine goes on with the third.
    xray=replace(
        _SHORT,
        iterations=4500,
        smooth_every=4,
        smooth_trial=SmoothTrial(),
        strategy=replace(_FILLED, most=60_000),
    ),
)

# More of what `standard` has, at the rates of so many steps, and photos at up to twice its size: as many as the paper
# shows, where there are enough of them. With colours of degree 2 photos of the sample have 0.2 dB less, of 3 0.4 dB.
_LONG = SurfaceSettings(
    rgb=replace(
        in_iterations(_STANDARD.rgb, 20_000), long_side=1600, strategy=DefaultStrategy(every=286, reset_every=3000)
    ),
    xray=in_iterations(_STANDARD.xray, 9000),
)

PRESETS: dict[str, SurfaceSettings] = {
    "draft": SurfaceSettings(
        rgb=RgbSettings(
            iterations=1000,
            long_side=400,
            growth=Growth(((0.3, 0.5),)),
            # With colours of degree 3 photos of eight captures that were kept back, the photo half alone, were +0.1 to
            # -0.2 dB (a real puppet's two -0.9, where chance is 1), in a tenth more of time.
            degree=1,
            # With half of these rates photos of five captures were 0.3 to 0.5 dB worse, a real puppet's 0.1 better.
            means_rate=Decay(6.4e-4, 6.4e-6),
            sh_rate=0.01,
            opacity_rate=0.1,
            scale_rate=0.02,
            rotation_rate=0.002,
            low_pass=_LOW_PASS,
            mip_filter=True,
            strategy=DefaultStrategy(stop=0.6, most=30_000),
            passes=_PASSES,
            splats_per_pair=_SPLATS_PER_PAIR,
        ),
        # With 100 iterations between two densifications the first thousands of splats came later than they are allowed
        # to, and projections were 0.9 dB worse for an eighth less of time. With the rates of `standard` and its weight
        # of structure, 0.1, true sections of five objects were 0.9 to 1.7 dB worse; with three times the rates those
        # of two were 0.1 and 0.4 worse than here, with a weight of a half those of one 0.05. `standard` loses up to
        # 0.2 by this weight. All that with total variation of a weight of 0.01.
        # Half of the smoothness of `standard`, for there is no time to try less: beside that total variation, by all of
        # it sections of six captures gained 0.1 to 1.2 dB and an engine's projections lost 0.4; by half of it they
        # gained 0.1 to 0.7 and lost 0.04.
        xray=replace(
            hotter(_SHORT, 2.0),
            iterations=1000,
            structure_weight=0.25,
            smooth_weight=0.05,
            strategy=replace(_FILLED, most=30_000, every=50),
        ),
    ),
    "standard": _STANDARD,
    "paper": _LONG,
}


def reason_to_skip(context: StageContext) -> Told | None:
    """Why there is nothing to fit, or None."""
    if context.run.has_set("initialize", "rgb") or context.run.has_set("initialize", "xray"):
        return None
    return Told("initialize left no splats to start from")


def run(context: StageContext, settings: SurfaceSettings) -> dict[str, Any]:
    """Fits `initialize/rgb.ply` and `initialize/xray.ply` to `surface/rgb.ply` and `surface/xray.ply`.

    Without projections the radiative half is taken from the volume as `initialize` made it.

    Returns:
        For `rgb` and `xray`: losses, held-out PSNR by iteration, splats, `trained_with` (the settings, for as many
        iterations as there was time for), and of `xray` `smoothness` (`XrayTrainer`); `splats`.

    Raises:
        Cancelled: the user asked to stop; a checkpoint is kept.
        CaptureError: a photo cannot be read.
    """
    report: dict[str, Any] = {"splats": {}}
    both = context.run.has_set("initialize", "rgb") and context.run.has_set("initialize", "xray")
    if context.run.has_set("initialize", "rgb"):
        report["rgb"] = _fit_photos(context, settings.rgb, 0.0, 0.6 if both else 1.0)
        report["splats"]["rgb"] = report["rgb"]["splats"]
    if context.run.has_set("initialize", "xray"):
        report["xray"] = _fit_projections(context, settings.xray, 0.6 if both else 0.0, 1.0)
        report["splats"]["xray"] = report["xray"]["splats"]
    return report


def _fit_photos(context: StageContext, settings: RgbSettings, first: float, last: float) -> dict[str, Any]:
    photos = registered_photos(context)
    if photos is None:
        raise AssertionError("initialize leaves photos.json with rgb.ply")
    background, is_put = shown_or_put_background(photos, tick=context.reporter.check)
    look_again(context, "surface", first)
    settings = _with_effects(settings, context.effects, background, is_put)
    known = [photo for photo in photos.photos if photo.camera is not None]
    shown = [p for p in known if not p.held_out]
    aside = settings.stop.set_aside(len(shown)) if settings.stop else []
    kept = [photo for place, photo in enumerate(shown) if place not in aside]
    validation, training, heldout = (
        TrainingPhotos(some, settings.long_side, background, tick=context.reporter.check)
        for some in ([shown[place] for place in aside], kept, [p for p in known if p.held_out])
    )
    start = context.run.read_set("initialize", "rgb")
    settings = settings.for_photos(len(training))
    renderers = context.compiled(*settings.renderers)
    task = replace(_task(context, "rgb", settings.iterations, first, last), stop=settings.stop, renderers=renderers)
    # The last reset of opacities is made before densifying ends; each costs the photos 20 dB for a while.
    densify = settings.strategy.densify
    if isinstance(densify, DefaultStrategy) and densify.reset_every:
        task = replace(task, settled=densify.stop)
    task = replace(task, settled_splats=densify.stop)
    if settings.effects:
        # Held-out photos have numbers of their own, which take long to fit.
        task = replace(task, measures=WITH_EFFECTS["surface rgb"])
    task = context.paced(task, settings.most_iterations(len(training)))
    settings = in_iterations(settings, task.iterations)
    trainer = RgbTrainer(start, training, heldout, background, settings, context.seed, context.kernel, validation)
    history = optimise(trainer, task, context.reporter)
    result = trainer.parameters.to_set()
    context.run.write_set("surface", "rgb", result)
    context.trained("surface", "rgb", len(result))
    if trainer.effects:
        # What a capture does not show is not loaded.
        from ...effects.kept import FILE, keep_effects

        names = [str(photo.path) for photo in kept]
        keep_effects(context.run.stage("surface") / FILE, trainer.effects, names, training.cameras)
    return {
        **history,
        "splats": len(result),
        "photos": {"training": len(training), "validation": len(validation), "held_out": len(heldout)},
        "background": None if background is None else [float(value) for value in background],
        **({"effects": trainer.effects.report()} if trainer.effects else {}),
        "options": vars(trainer.options),
        "trained_with": plain(settings),
    }


def _fit_projections(context: StageContext, settings: XraySettings, first: float, last: float) -> dict[str, Any]:
    start = context.run.read_set("initialize", "xray")
    projections = context.projections
    if projections is None:
        context.run.write_set("surface", "xray", start)
        return {"splats": len(start), "skipped": "there are no projections, the volume alone is followed later"}
    volume, smoothness = context.run.volume(), {}
    told: dict[str, Any] = {}
    trainer: XrayTrainer | XGaussianTrainer
    task = replace(_task(context, "xray", settings.iterations, first, last), stop=settings.stop)
    task = context.paced(replace(task, settled_splats=settings.strategy.stop))
    settings = in_iterations(settings, task.iterations)
    if settings.model == "x_gaussian":
        # Only who chooses the rival loads it.
        from .x_gaussian import XGaussianTrainer, with_density

        trainer = XGaussianTrainer(start, projections, settings, context.seed, context.kernel)
        history = optimise(trainer, replace(task, renderers=context.compiled("splat")), context.reporter)
        views = [view for view in choose_planes(volume.box_mm) if not view.held_out]
        references = [reference_section(volume, view) for view in views]
        result = with_density(trainer.result(), views, references, context.kernel)
    else:
        voxel_mm, unit = float(np.mean(volume.spacing_mm)), _unit_of_splats(context)
        trainer = XrayTrainer(start, projections, voxel_mm, unit, settings, context.seed, context.kernel)
        history = optimise(trainer, task, context.reporter)
        trainer.finish()
        result, smoothness = trainer.parameters.to_set(), trainer.smoothness
        if settings.whole:
            result, factor = fit_to_projections(result, projections)
            told["density_factor"] = factor
    context.run.write_set("surface", "xray", result)
    held_out = int(projections.held_out.sum())
    counts = {"training": len(trainer.training), "validation": len(trainer.validation), "held_out": held_out}
    told |= {"smoothness": smoothness, "trained_with": plain(settings)}
    return {**history, "splats": len(result), "projections": counts, **told}


def _with_effects(settings: RgbSettings, found: RunEffects, background: np.ndarray | None, is_put: bool) -> RgbSettings:
    """The settings with the effects that the photos were found to show before a background (3,), put there or not."""
    if "pixel_integration" in found.used("photos"):
        settings = replace(settings, pixel_integration=True)
    effects = found.photos or settings.effects
    if not effects:
        return settings
    from ...effects.exposure import before

    return replace(settings, effects=before(effects, background, is_put))


def density_unit(run: RunFolder) -> float:
    """`large_attenuation` of the run's volume, mm⁻¹."""
    return max(large_attenuation(run.volume().values), 1e-9)


def _unit_of_splats(context: StageContext) -> float:
    """`density_unit` in what densities are fitted to, mm⁻¹: a volume beside projections may be in anything, and
    `initialize` has scaled the splats from it to these."""
    unit = density_unit(context.run)
    if context.capture.volume is None or not context.run.is_done("initialize"):
        return unit
    return unit * float(context.run.report("initialize").get("xray", {}).get("density_factor", 1.0))


def smooth_share(run: RunFolder) -> float:
    """Of the smoothness's weight, what `surface` went on with (`SmoothTrial`); 1 where no less was tried."""
    report = run.report("surface") if run.is_done("surface") else {}
    return float(report.get("xray", {}).get("smoothness", {}).get("share", 1.0))


def _task(context: StageContext, part: str, iterations: int, first: float, last: float) -> Task:
    renderers = context.compiled("splat" if part == "rgb" else "radiograph")
    checkpoint = context.checkpoint("surface", part)
    return Task("surface", part, iterations, first, last, checkpoint, renderers=renderers)
