"""The methods that are compared: most are the project's own pipeline with other settings, some stages, or one half.

A row is added by one `Method` in `_ALL`: with `change` for a pipeline with other settings, `volume` for a
reconstruction that leaves voxels, or `mesh` for a mesh that is made of another row's splats.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..capture.model import Capture
from ..errors import SettingError
from ..fdk_process import end_fdk, fdk, sart
from ..progress import Reporter
from ..render.splat import PUBLISHED_LOW_PASS
from ..run_folder import RunFolder
from ..sart import SartSettings
from ..settings import Settings
from ..train.schedule import Decay
from ..volume import Volume
from .code import code_of

if TYPE_CHECKING:
    import trimesh

RATES = ("means_rate", "density_rate", "scale_rate", "rotation_rate")
"""The rates of `XraySettings` that R²-Gaussian has, too."""
PUBLISHED_ITERATIONS = 30_000
"""Of 3DGS, 3DGS-MCMC and MaskGaussian."""
_FDK_WINDOW = "hann"


@dataclass(frozen=True)
class VolumeJob:
    """What a reconstruction that leaves voxels is given.

    Attributes:
        capture: the capture; held-out projections must not be used.
        folder: its own, for checkpoints.
        settings: preset, seed and kernel of the comparison.
        seconds: what the InsideOut row spent on X-rays, for a method that goes by time; None for its own default.
        at_centers: the volume is compared with values at voxel centres, not with averages over voxels.
        start: the first volume of the InsideOut row, the FDK of the training projections; None where it was not made.
        reporter: progress out, cancel in.
    """

    capture: Capture
    folder: Path
    settings: Settings
    seconds: float | None
    start: Volume | None
    reporter: Reporter
    at_centers: bool = False


@dataclass(frozen=True)
class Reconstructed:
    """What such a method makes.

    Attributes:
        volume: its voxels.
        budget: for a method that goes by time, what `train.budget.iterations_in_time` found.
    """

    volume: Volume
    budget: dict[str, Any] | None = None


@dataclass(frozen=True)
class MeshJob:
    """What a method that makes a mesh of another row's splats is given.

    Attributes:
        run: that row's finished run.
        folder: its own.
        settings: preset, seed and kernel of the comparison.
        reporter: progress out, cancel in.
    """

    run: RunFolder
    folder: Path
    settings: Settings
    reporter: Reporter


def as_it_is(settings: Settings) -> Settings:
    """The preset unchanged."""
    return settings


def with_stage(settings: Settings, stage: str, **changes: Any) -> Settings:
    """Settings with some fields of a stage's settings replaced."""
    return replace(settings, stages={**settings.stages, stage: replace(settings.stages[stage], **changes)})


def with_rgb(settings: Settings, **changes: Any) -> Settings:
    """Settings with some fields of `RgbSettings` replaced."""
    return with_stage(settings, "surface", rgb=replace(settings.stages["surface"].rgb, **changes))


def with_pair(settings: Settings, initialize: Any, xray: Any) -> Settings:
    """Settings with other `InitializeSettings` and `XraySettings`."""
    surface = replace(settings.stages["surface"], xray=xray)
    return replace(settings, stages={**settings.stages, "initialize": initialize, "surface": surface})


def with_xray(settings: Settings, **changes: Any) -> Settings:
    """Settings with some fields of `XraySettings` replaced."""
    return with_stage(settings, "surface", xray=replace(settings.stages["surface"].xray, **changes))


@dataclass(frozen=True)
class Method:
    """One row of the tables.

    Attributes:
        name: on the command line and of its folder.
        label: in the tables.
        modality: "photos" or "xray" for a method that sees that half of a capture alone, "both" for one that sees
            what there is.
        change: its settings, of the preset's.
        leave_out: stages that it does without.
        for_iterations: for a pipeline of X-rays that is to have the time that the InsideOut row spent on X-rays: its
            settings, of the preset's, for a number of X-ray iterations. None for a row with its own time.
        published: the iterations that such a pipeline makes where it is given no time; None for the preset's.
        for_count: for a strategy whose number of splats is a choice: its settings, of the preset's, for at most as
            many as the 3DGS row has in the end, which is what such strategies are published with.
        volume: reconstructs voxels, in place of the pipeline.
        own: the settings that `volume` or `mesh` has of its own; where they changed, a finished row is made anew.
        by_time: whether `volume` goes on for the time it is given.
        mesh: makes a mesh, in the photo frame, of the splats of the row `after`, in place of the pipeline.
        after: see `mesh`.
        parts: of `code.CODE`, what `volume` or `mesh` is of.
        note: what a reader of the tables has to know of it.
    """

    name: str
    label: str
    modality: str
    change: Callable[[Settings], Settings] = as_it_is
    leave_out: tuple[str, ...] = ()
    for_iterations: Callable[[Settings, int], Settings] | None = None
    published: int | None = None
    for_count: Callable[[Settings, int], Settings] | None = None
    volume: Callable[[VolumeJob], Reconstructed] | None = None
    own: Callable[[], Any] | None = None
    by_time: bool = False
    mesh: Callable[[MeshJob], trimesh.Trimesh] | None = None
    after: str = ""
    parts: tuple[str, ...] = ()
    note: str = ""

    @property
    def code(self) -> dict[str, int]:
        """The numbers of the code that makes the row, see `code.CODE`."""
        return code_of(self.modality, self.parts)

    def reason_not_for(self, capture: Capture) -> str | None:
        """Why the method cannot run on a capture, or None."""
        if self.modality == "photos" and capture.photos is None:
            return "it has no photos"
        if self.modality == "xray" and capture.projections is None:
            return "it has no X-ray projections"
        if self.name == "apart" and capture.projections is None:
            return "it has no X-ray projections, without which halves stay apart in the row insideout, too"
        return None


def _fdk(job: VolumeJob) -> Reconstructed:
    if job.capture.projections is None:
        raise AssertionError("only called where there are projections")
    try:
        return Reconstructed(fdk(job.capture.projections, window=_FDK_WINDOW, reporter=job.reporter))
    finally:
        end_fdk()


def _sart(job: VolumeJob) -> Reconstructed:
    if job.capture.projections is None:
        raise AssertionError("only called where there are projections")
    try:
        return Reconstructed(sart(job.capture.projections, reporter=job.reporter))
    finally:
        end_fdk()


def _naf(job: VolumeJob) -> Reconstructed:
    from ..naf.timed import naf_within
    from ..naf.train import BRIEF, NafSettings, naf

    projections = job.capture.projections
    if projections is None:
        raise AssertionError("only called where there are projections")
    start = job.start or _fdk(job).volume
    # A thin rod of metal is less than a thousandth of the voxels, and the sigmoid must reach it.
    largest = float(start.values.max()) / NafSettings.headroom
    attenuation = max(float(np.percentile(start.values, 99.9)), largest, 1e-9)
    seed, reporter, at_centers = job.settings.seed, job.reporter, job.at_centers
    if job.seconds is None:
        checkpoint = job.folder / "naf.checkpoint.pt"
        return Reconstructed(naf(projections, attenuation, None, seed, reporter, checkpoint, at_centers)[0])
    found = naf_within(job.seconds, projections, attenuation, job.folder, BRIEF, seed, reporter, at_centers)
    return Reconstructed(*found)


def _naf_settings() -> Any:
    from ..naf.train import BRIEF, NafSettings

    return {"by time": BRIEF, "else": NafSettings()}


def _stereo_settings() -> Any:
    from ..mesh.stereo import StereoSettings

    return StereoSettings()


def _mcmc(settings: Settings, count: int) -> Settings:
    from ..train.mcmc import McmcStrategy

    rgb = settings.stages["surface"].rgb
    # As many relocations as in the published 30,000 iterations.
    every = max(1, round(McmcStrategy.every * rgb.iterations / PUBLISHED_ITERATIONS))
    # The strategy adds none beyond its cap, but drops none either.
    start = min(settings.stages["initialize"].most_rgb, count)
    return with_stage(with_rgb(settings, strategy=McmcStrategy(every=every, most=count)), "initialize", most_rgb=start)


def _mask(settings: Settings) -> Settings:
    from ..train.mask import MaskStrategy

    rgb = settings.stages["surface"].rgb
    # The published rate, for as far a way in fewer steps.
    rate = MaskStrategy.rate * PUBLISHED_ITERATIONS / rgb.iterations
    return with_rgb(settings, strategy=MaskStrategy(densify=rgb.strategy, rate=rate))


def _as_published(change: Callable[[Settings], Settings] = as_it_is) -> Callable[[Settings], Settings]:
    """A change of the colour half. Splats are widened as in 3DGS and no fainter for it, all rates but that of means
    stay, and colours are of degree 3: in these our presets differ; the longest also in its rates and its pause."""

    def published(settings: Settings) -> Settings:
        from ..stages.surface.rgb import RgbSettings

        ours, usual = settings.stages["surface"].rgb, RgbSettings()
        changes: dict[str, Any] = {
            "low_pass": PUBLISHED_LOW_PASS,
            "mip_filter": False,
            "decay": Decay(1.0),
            "degree": 3,
        }
        # In fewer steps splats would not come far at published rates.
        if ours.iterations >= usual.iterations:
            rates = {field.name for field in fields(usual) if field.name.endswith("_rate")}
            changes |= {name: getattr(usual, name) for name in rates}
            changes["strategy"] = replace(ours.strategy, every=usual.strategy.densify.every)
        return change(with_rgb(settings, **changes))

    return published


def _with_effect(name: str) -> Callable[[Settings], Settings]:
    def change(settings: Settings) -> Settings:
        from ..effects import effects_named

        return with_rgb(settings, effects=effects_named((name,)))

    return _as_published(change)


def _apart(settings: Settings) -> Settings:
    return with_stage(settings, "internal", joint=None)


def _r2_gaussian(settings: Settings, count: int) -> Settings:
    from ..stages.surface.rivals import r2_gaussian

    return with_pair(settings, *r2_gaussian(count))


def _r2_at_our_rates(settings: Settings, count: int) -> Settings:
    from ..stages.surface.rivals import r2_gaussian

    start, fit = r2_gaussian(count)
    ours = settings.stages["surface"].xray
    return with_pair(settings, start, replace(fit, **{name: getattr(ours, name) for name in RATES}))


def _x_gaussian(settings: Settings, count: int) -> Settings:
    from ..stages.surface.rivals import x_gaussian

    return with_pair(settings, *x_gaussian(count))


def _gs2mesh(job: MeshJob) -> trimesh.Trimesh:
    from ..mesh.stereo import mesh_of_run

    return mesh_of_run(job.run, job.settings.kernel, job.reporter)


_ALL = (
    Method(
        "3dgs",
        "3DGS",
        "photos",
        _as_published(),
        note="The colour half of the preset, but splats are widened in images by 0.3 px² and no fainter for it, and "
        "rates stay, as published; the photo rows below change one thing each of it. Other than published are: "
        "fewer iterations than 30,000 and higher rates where there are few photos, or at preset draft; images that "
        "grow to their size in the first 30 % of them, at most 150,000 splats (at preset standard), points of the "
        "visual hull beside the sparse ones, silhouettes where the background is plain, and no pruning by size in the "
        "image.",
    ),
    Method(
        "mcmc",
        "3DGS-MCMC",
        "photos",
        _as_published(),
        for_count=_mcmc,
        note="As many splats as the 3DGS row has in the end, and as many relocations as in 30,000 iterations, so at "
        "shorter distances; lengths are scaled as for the published scenes.",
    ),
    Method(
        "defocus",
        "DoF-Gaussian",
        "photos",
        _with_effect("defocus"),
        note="Its lens, on 3DGS. Where photos are sharp there is nothing for it to gain.",
    ),
    Method(
        "mask",
        "MaskGaussian",
        "photos",
        _as_published(_mask),
        note="The rate of its masks is larger by as much as the iterations are fewer.",
    ),
    Method(
        "pixel_integration",
        "Analytic-Splatting",
        "photos",
        _as_published(lambda settings: with_rgb(settings, pixel_integration=True)),
        note="A pixel's integral is the product of two along rows and then columns, not along the splat's axes: exact "
        "for upright splats, and stable for slanted ones.",
    ),
    Method(
        "rolling_shutter",
        "RS-NeRF",
        "photos",
        _with_effect("rolling_shutter"),
        note="Its motion, on 3DGS, not a field: half a path before and after each given camera, which itself stays. "
        "Where the shutter opened at once there is nothing for it to gain.",
    ),
    Method(
        "naf",
        "NAF",
        "xray",
        volume=_naf,
        own=_naf_settings,
        by_time=True,
        parts=("fdk", "naf"),
        note="In the time of the InsideOut row its field takes shorter steps (256 rays, 96 samples, rate 0.005): few "
        "of its own fit in. It begins at the object's mean attenuation; from half of the largest one, as published, it "
        "finds nothing in that time of objects with metal.",
    ),
    Method(
        "x_gaussian",
        "X-Gaussian",
        "xray",
        leave_out=("internal",),
        for_iterations=_x_gaussian,
        published=20_000,
        note="Its splats have no attenuation: opacity times intensity stands for it, as a line integral or a density, "
        "whichever with one factor fits training sections of the FDK better; its sections have the factor that fits "
        "the truth best. Held-out projections are blended, as it draws them. Its published numbers, rates for 20,000 "
        "iterations among them, but no pruning by size in the image; its schedule ends with the time.",
    ),
    Method(
        "r2_gaussian",
        "R²-Gaussian",
        "xray",
        leave_out=("internal",),
        for_iterations=_r2_gaussian,
        published=30_000,
        note="Its published numbers, made for 30,000 iterations; its schedule ends with the time. Other than published "
        "are: limits of scales that cut, not a sigmoid; splats that end three standard deviations out along each of "
        "their axes, not three of the largest; first positions anywhere in their voxels; and ITK-RTK's FDK, not "
        "TIGRE's.",
    ),
    Method(
        "r2_at_our_rates",
        "R²-Gaussian at our rates",
        "xray",
        leave_out=("internal",),
        for_iterations=_r2_at_our_rates,
        published=30_000,
        note="Not a published method: all else as R²-Gaussian's row has it. It tells how much of the distance to "
        "InsideOut is owed to rates made for more iterations than there is time for.",
    ),
    Method(
        "sart",
        "SART",
        "xray",
        volume=_sart,
        own=SartSettings,
        parts=("sart",),
        note="ITK-RTK with its own settings (three iterations, a relaxation of 0.3), positive, in a box a voxel larger "
        "on each side; some of its seconds are ITK-RTK being loaded. More iterations fit more, at last the noise: "
        "sections of the terracotta have 30.1 dB after 3, 31.0 after 5, 28.9 after 10 and 26.4 after 20, those of the "
        "toy gun 41.4, 42.6, 42.7 and 41.5; smaller steps were no better (30.4 and 41.6 after 10 of a third).",
    ),
    Method(
        "fdk",
        "FDK",
        "xray",
        volume=_fdk,
        own=lambda: _FDK_WINDOW,
        parts=("fdk",),
        note="ITK-RTK, Hann window, of the training projections; some of its seconds are ITK-RTK being loaded.",
    ),
    Method(
        "additive",
        "InsideOut, projections alone",
        "xray",
        leave_out=("internal",),
        for_iterations=lambda settings, count: with_xray(settings, iterations=count),
        note="The stage `surface` alone, for the X-ray seconds of the InsideOut row: exact line integrals, a coarse "
        "start, smoothness.",
    ),
    Method(
        "gs2mesh",
        "GS2Mesh",
        "photos",
        mesh=_gs2mesh,
        own=_stereo_settings,
        after="3dgs",
        parts=("photos", "gs2mesh"),
        note="Of the 3DGS row's splats; a classical matcher (OpenCV's semi-global matching) stands in for its learned "
        "one. Its outer distances include what no photo sees, the underside on a table above all.",
    ),
    Method(
        "insideout",
        "InsideOut",
        "both",
        note="After the alignment one set of splats for photos, projections and sections together, each for what it "
        "shows: photos move photo splats and the frame, projections radiative splats, and sections what a splat shows "
        "when it is cut. Photos and sections change nothing inside; what it has beside the X-ray half alone is owed "
        "to further steps on projections at small rates.",
    ),
    Method(
        "apart",
        "InsideOut, halves apart",
        "both",
        _apart,
        note="The paper's five stages: after the alignment each half by itself, then transfer and cloning. Unlike the "
        "paper's, radiative splats are taken back where following the sections of an FDK of few projections costs the "
        "training projections more than 2 dB, and photo splats follow sections at a rate of 3e-5 (preset standard), "
        "not 5e-4, which would wear their colours away.",
    ),
)

METHODS: dict[str, Method] = {method.name: method for method in _ALL}


def choose_methods(names: Sequence[str], captures: Sequence[Capture]) -> list[Method]:
    """The methods of those names in the tables' order; all that any capture allows if there are no names.

    Raises:
        SettingError: an unknown name, or a method that none of the captures allows.
    """
    for name in names:
        if name not in METHODS:
            raise SettingError(f"--methods {name}: there is no such method; choose of {', '.join(METHODS)}.")
        reasons = [METHODS[name].reason_not_for(capture) for capture in captures]
        if all(reasons):
            raise SettingError(f"--methods {name}: cannot run on {captures[0].path}, {reasons[0]}; leave it out.")
    allowed = [m for m in METHODS.values() if any(m.reason_not_for(capture) is None for capture in captures)]
    return [method for method in allowed if not names or method.name in names]


def without_repeats(methods: Sequence[Method], settings: Settings) -> list[Method]:
    """The methods but for those that would only repeat one before them, their setting being the preset's already."""
    rows: list[Method] = []
    seen: list[Any] = []
    for method in methods:
        changed = method.for_iterations(settings, 1) if method.for_iterations else method.change(settings)
        works = (method.volume, method.mesh, method.for_count, method.for_iterations is None)
        made = (method.modality, method.leave_out, works, changed)
        if made not in seen:
            seen.append(made)
            rows.append(method)
    return rows
