"""The knobs that trade accuracy for time, and the positions of each that are measured.

A knob is added by one function that yields its positions for the settings it is turned from.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ...capture.model import Capture
from ...compare.methods import PUBLISHED_ITERATIONS, as_it_is, with_rgb, with_stage, with_xray
from ...compare.thinning import with_fewer_projections
from ...effect_names import PHOTO_EFFECTS, XRAY_EFFECTS
from ...effects.request import parse_effects
from ...errors import SettingError
from ...render.splat import PUBLISHED_LOW_PASS
from ...settings import PRESETS, Settings
from ...stages.internal.joint_settings import joint_in_iterations
from ...train.mask import MaskStrategy
from ...train.mcmc import McmcStrategy
from ...train.schedule import Decay, Growth, in_iterations
from ...train.smoothness import EDGE

Change = Callable[[Settings], Settings]
Thin = Callable[[Capture], Capture]

_IN_PATHS = str.maketrans({" ": "_", "/": "_", "×": "x", "½": "half", "σ": "sigma"})


@dataclass(frozen=True)
class Position:
    """One row: a knob turned to a position, all else as the preset has it.

    Attributes:
        knob: its name, as on the command line.
        value: the position, for people.
        change: the settings of the row, of the preset's.
        thin: the capture of the row; None for all of it.
        sees: "photos", "xray" (projections), "inside" (projections or a volume) or "all": what of a capture the knob
            has something to do with.
    """

    knob: str
    value: str
    change: Change = as_it_is
    thin: Thin | None = None
    sees: str = "all"

    @property
    def folder(self) -> str:
        """A name for its run."""
        return f"{self.knob}={self.value}".translate(_IN_PATHS)


def _joint(settings: Settings, **changes: Any) -> Settings:
    joint = settings.stages["internal"].joint
    return settings if joint is None else with_stage(settings, "internal", joint=replace(joint, **changes))


def _iterations(settings: Settings, factor: float) -> Settings:
    """As a run with a time budget changes them (`Pace`), on either route: a volume of one's own is followed apart."""
    surface, internal, fuse = (settings.stages[stage] for stage in ("surface", "internal", "fuse"))

    def times(count: int) -> int:
        # What a preset leaves out stays out.
        return max(1, round(factor * count)) if count else 0

    rgb, xray = (in_iterations(half, times(half.iterations)) for half in (surface.rgb, surface.xray))
    joint = internal.joint and joint_in_iterations(internal.joint, times(internal.joint.iterations))
    changed = with_stage(settings, "surface", rgb=rgb, xray=xray)
    changed = with_stage(
        changed,
        "internal",
        xray_iterations=times(internal.xray_iterations),
        rgb_iterations=times(internal.rgb_iterations),
        display_iterations=times(internal.display_iterations),
        joint=joint,
    )
    return with_stage(changed, "fuse", iterations=times(fuse.iterations))


def _photo_size(settings: Settings, pixels: int) -> Settings:
    return _joint(with_rgb(settings, long_side=pixels), photo_size=pixels)


def _splats_end_at(settings: Settings, sigmas: float) -> Settings:
    return _joint(with_xray(settings, cutoff_sigmas=sigmas), cutoff_sigmas=sigmas)


def _smoothness(settings: Settings, **changes: float | None) -> Settings:
    # What is measured is this weight, not a part of it.
    return _joint(with_xray(settings, smooth_trial=None, **changes), **changes)


def _of_iterations(settings: Settings) -> Iterator[Position]:
    for factor in (0.25, 0.5, 2.0):
        yield Position("iterations", f"×{factor:g}", partial(_iterations, factor=factor))


def _of_iterations_of(preset: str, settings: Settings) -> Iterator[Position]:
    """Whether another preset is a knee, too, shows in fewer and more iterations of its own."""
    for position in _of_iterations(settings.with_preset(preset)):
        change = partial(_changed_as, preset=preset, change=position.change)
        yield replace(position, value=f"{preset} {position.value}", change=change)


def _changed_as(settings: Settings, preset: str, change: Change) -> Settings:
    return change(settings.with_preset(preset))


def _of_resolution(settings: Settings) -> Iterator[Position]:
    side = settings.stages["surface"].rgb.long_side
    for share in (0.25, 0.5):
        pixels = round(share * side)
        yield Position("resolution", f"photos of {pixels} pixels", partial(_photo_size, pixels=pixels), sees="photos")
    half = partial(with_xray, growth=Growth(((1.0, 0.5),)))
    yield Position("resolution", "projections of half size", half, sees="xray")


def _of_schedule(settings: Settings) -> Iterator[Position]:
    rgb = settings.stages["surface"].rgb
    if rgb.growth.steps:
        yield Position("schedule", "full size at once", partial(with_rgb, growth=Growth()), sees="photos")
    if rgb.decay != Decay(1.0):
        yield Position("schedule", "rates of photos stay", partial(with_rgb, decay=Decay(1.0)), sees="photos")
    yield Position(
        "schedule",
        "projections small at first",
        partial(with_xray, growth=Growth(((0.25, 0.5),))),
        sees="xray",
    )


def _of_splats(settings: Settings) -> Iterator[Position]:
    surface = settings.stages["surface"]
    for factor in (0.25, 0.5, 2.0):
        most = round(factor * surface.xray.strategy.most)

        budget = partial(with_xray, strategy=replace(surface.xray.strategy, most=most))
        yield Position("splats", f"{most:,} radiative", budget, sees="xray")
    few = surface.rgb.strategy.most // 4
    budget = partial(with_rgb, strategy=replace(surface.rgb.strategy, most=few))
    yield Position("splats", f"{few:,} of photos at most", budget, sees="photos")


def _of_strategy(settings: Settings) -> Iterator[Position]:
    rgb = settings.stages["surface"].rgb
    share = rgb.iterations / PUBLISHED_ITERATIONS
    mcmc = McmcStrategy(most=rgb.strategy.most).sooner(share)
    yield Position("strategy", "mcmc", partial(with_rgb, strategy=mcmc), sees="photos")
    # What adds splats is made for the preset's iterations already.
    mask = replace(MaskStrategy().sooner(share), densify=rgb.strategy)
    yield Position("strategy", "mask", partial(with_rgb, strategy=mask), sees="photos")


def _of_harmonics(settings: Settings) -> Iterator[Position]:
    for degree in sorted({0, 1, 2, 3} - {settings.stages["surface"].rgb.degree}):
        yield Position("harmonics", f"degree {degree}", partial(with_rgb, degree=degree), sees="photos")


def _of_pixels(settings: Settings) -> Iterator[Position]:
    rgb = settings.stages["surface"].rgb
    if rgb.mip_filter or rgb.low_pass != PUBLISHED_LOW_PASS:
        published = partial(with_rgb, low_pass=PUBLISHED_LOW_PASS, mip_filter=False)
        yield Position("pixels", "widened as in 3DGS", published, sees="photos")
    if rgb.mip_filter:
        yield Position("pixels", "widened, and no fainter", partial(with_rgb, mip_filter=False), sees="photos")
    yield Position("pixels", "integrated", partial(with_rgb, pixel_integration=True), sees="photos")


def _of_rays(settings: Settings) -> Iterator[Position]:
    yield Position("rays", "affine", partial(with_xray, mode="affine"), sees="xray")


def _of_precision(settings: Settings) -> Iterator[Position]:
    """Where the kernels let a splat end in projections and sections: of what they leave out this alone can be seen."""
    usual = settings.stages["surface"].xray.cutoff_sigmas
    for sigmas in (2.0, 2.5, 3.0, 4.0):
        if sigmas != usual:
            yield Position(
                "precision", f"splats end at {sigmas:g} σ", partial(_splats_end_at, sigmas=sigmas), sees="xray"
            )


def _of_smoothness(settings: Settings) -> Iterator[Position]:
    xray = settings.stages["surface"].xray
    yield Position("smoothness", "none", partial(_smoothness, smooth_weight=0.0), sees="xray")
    twice = partial(_smoothness, smooth_weight=2 * xray.smooth_weight)
    yield Position("smoothness", "twice the weight", twice, sees="xray")
    if xray.smooth_trial is not None:
        yield Position("smoothness", "less not tried", partial(with_xray, smooth_trial=None), sees="xray")
    # What does not lower edges may weigh ten times as much.
    if xray.smooth_edge is None:
        edged = partial(_smoothness, smooth_edge=EDGE, smooth_weight=10 * xray.smooth_weight)
        yield Position("smoothness", "edges let be", edged, sees="xray")
    else:
        alike = partial(_smoothness, smooth_edge=None, smooth_weight=xray.smooth_weight / 10)
        yield Position("smoothness", "edges as all else", alike, sees="xray")


def _of_start(settings: Settings) -> Iterator[Position]:
    usual = settings.stages["initialize"].start
    for start in ("coarse", "fdk", "acui"):
        if start != usual:
            yield Position("start", start, partial(with_stage, stage="initialize", start=start), sees="xray")


def _of_sections(settings: Settings) -> Iterator[Position]:
    for millimetres in (3.0, 15.0):
        yield Position(
            "sections",
            f"every {millimetres:g} mm",
            partial(with_stage, stage="internal", step_mm=millimetres),
            sees="inside",
        )
    yield Position("sections", "none", partial(_joint, section_weight=0.0), sees="xray")


def _of_route(settings: Settings) -> Iterator[Position]:
    if settings.refine == "joint":
        yield Position("route", "apart", partial(with_stage, stage="internal", joint=None), sees="xray")


def _of_projections(settings: Settings) -> Iterator[Position]:
    for share in (2, 4):
        yield Position(
            "projections",
            f"1 of {share}",
            thin=partial(with_fewer_projections, share=share),
            sees="xray",
        )


def _of_photos(settings: Settings) -> Iterator[Position]:
    for share in (2, 4):
        yield Position(
            "photos",
            f"1 of {share}",
            thin=partial(with_fewer_photos, share=share),
            sees="photos",
        )


def with_fewer_photos(capture: Capture, share: int) -> Capture:
    """The capture with every `share`-th of its training photos and all held-out ones."""
    photos = capture.photos
    if photos is None:
        return capture
    training = [photo for photo in photos.photos if not photo.held_out]
    kept = {photo.path for photo in training[::share]}
    some = [photo for photo in photos.photos if photo.held_out or photo.path in kept]
    return replace(
        capture, photos=replace(photos, photos=some), digest=f"{capture.digest}, 1 of {share} training photos"
    )


def _of_effects(settings: Settings) -> Iterator[Position]:
    """Each effect as if it had been asked for by name: what it costs where it may not be needed."""
    for names, sees in ((PHOTO_EFFECTS, "photos"), (XRAY_EFFECTS, "xray")):
        for name in names:
            # Pixel integration is the knob `pixels`.
            if name != "pixel_integration":
                yield Position("effects", name, partial(replace, effects=name), sees=sees)


KNOBS: dict[str, Callable[[Settings], Iterator[Position]]] = {
    "iterations": _of_iterations,
    "resolution": _of_resolution,
    "schedule": _of_schedule,
    "splats": _of_splats,
    "strategy": _of_strategy,
    "harmonics": _of_harmonics,
    "pixels": _of_pixels,
    "rays": _of_rays,
    "precision": _of_precision,
    "smoothness": _of_smoothness,
    "start": _of_start,
    "sections": _of_sections,
    "route": _of_route,
    "projections": _of_projections,
    "photos": _of_photos,
    "effects": _of_effects,
}
"""By the name on the command line."""


def positions(settings: Settings, capture: Capture, knobs: Sequence[str], presets: Sequence[str]) -> list[Position]:
    """The rows: the preset itself, the other presets, and each knob's positions that the capture has a use for.

    Args:
        settings: that knobs are turned from.
        knobs: names; all if empty.
        presets: those measured beside that of `settings`, with fewer and more iterations, too, if these are a knob.

    Raises:
        SettingError: there is no such knob or preset.
    """
    for name in knobs:
        if name not in KNOBS:
            raise SettingError(f"--knobs {name}: there is no such knob; choose of {', '.join(KNOBS)}.")
    for name in presets:
        if name not in PRESETS:
            raise SettingError(f"--presets {name}: there is no such preset; choose of {', '.join(PRESETS)}.")
    others = [name for name in presets if name != settings.preset]
    rows = [Position("preset", settings.preset)]
    rows += [Position("preset", name, partial(Settings.with_preset, preset=name)) for name in others]
    for name in knobs or KNOBS:
        rows += KNOBS[name](settings)
        if name == "iterations":
            rows += [row for preset in others for row in _of_iterations_of(preset, settings)]
    photos, projections = capture.photos is not None, capture.projections is not None
    there = {"photos": photos, "xray": projections, "inside": projections or capture.volume is not None, "all": True}
    return [row for row in rows if there[row.sees] and not _is_refused(row, settings, capture)]


def _is_refused(row: Position, settings: Settings, capture: Capture) -> bool:
    """Whether a run of the row would end at once, and all that is measured after it with it: an effect that is asked
    for by name, and that nothing in the capture can have."""
    if row.knob != "effects":
        return False
    try:
        parse_effects(row.change(settings).effects).check(capture)
    except SettingError:
        return True
    return False


def is_dominated(seconds: float, quality: float, others: Sequence[tuple[float, float]]) -> bool:
    """Whether one of the others (seconds, quality) is at least as good in less time, or better in the same."""
    return any(
        (other_seconds <= seconds and other > quality) or (other_seconds < seconds and other >= quality)
        for other_seconds, other in others
    )


def pareto_front(points: Sequence[tuple[float, float]]) -> np.ndarray:
    """Places (M,) of the points (seconds, quality) that no other dominates, the fastest first."""
    kept = [
        place
        for place, (seconds, quality) in enumerate(points)
        if not is_dominated(seconds, quality, [*points[:place], *points[place + 1 :]])
    ]
    return np.array(sorted(kept, key=lambda place: points[place]), dtype=int)
