"""What each effect in use is worth: short fits with all of them and with one left out at a time.

They are compared on training views that are set aside for it, as the scanner or the camera has them, never on held-out
ones. Where an effect has numbers of its own for each view, the fit with it has them of these views, too, and so much of
the difference proves nothing. Only an effect that a capture shows costs this, and nothing of it goes into the model.
One that `auto` found and that surely does harm is named, so that whoever chose it can leave it out.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from statistics import fmean as mean
from typing import Any

import numpy as np
import torch

from ..capture.model import Photo, Photos, Projections
from ..effect_names import TOLD, XRAY_EFFECTS
from ..effects import EFFECTS
from ..effects.choose import Choice, effect_module, without_effects
from ..effects.exposure import before
from ..effects.finding import say
from ..effects.rays import RayEvidence
from ..effects.request import Request
from ..evaluate.metrics import psnr
from ..evaluate.photos import shown_or_put_background
from ..gaussians import GaussianSet
from ..progress import Progress
from ..render import radiograph
from ..render.kernels.cpu import announce
from ..told import Told
from ..train.schedule import Growth, Stop
from ..views import Camera
from .context import StageContext
from .short_fit import short_settings, short_trainer
from .surface.photos import TrainingPhotos
from .surface.rgb import RgbTrainer
from .surface.stage import PRESETS

STEPS, MIDDLE_PX = 300, 256
"""Of a fit: its steps, and pixels to which photos are cut, not scaled down: many effects are blur of a pixel or two."""
TRIED_RAYS = ("scatter", "focal_spot", "beam_hardening", "motion", "geometry")
"""Effects of X-rays that are tried: what only the FDK sees is not, nor what a fit has told already, nor noise, which so
short a fit hardly fits."""
FEWEST = 8
"""Training views, without which nothing is tried."""
# One view in so many is set aside; of photos a few, for an effect's numbers have to be fitted to each.
_EVERY, _MOST_PHOTOS = 5, 4
# What two fits differ by anyway. What seems to do harm is tried twice more, and these alone decide: of many trials the
# first one that looks bad looks worse than it is. Their mean differs by 0.14 dB anyway.
_NOTHING_DB, _HARM_DB = 0.2, 0.5
_MORE = 2


def photos_aside(count: int) -> int:
    """How many of so many training photos are set aside."""
    return min(_MOST_PHOTOS, count // _EVERY)


def tell_gains_of_rays(context: StageContext, evidence: RayEvidence, choice: Choice) -> str | None:
    """Adds `gain_db`, and a sentence to the `reason`, to the rows of effects of X-rays that are in use.

    Args:
        evidence: the projections as they were given.

    Returns:
        The name of an effect that is in use no longer, since it does harm: of those that the user did not ask for the
        worst. What was found of the others hangs on it and has to be looked for again.

    Raises:
        CaptureError: the projections cannot be reconstructed.
        Cancelled: the user asked to stop.
    """
    tried = [row for row in choice.rows if row["used"] and row["name"] in TRIED_RAYS]
    if tried and len(evidence.training) >= FEWEST:
        said = partial(context.progress, "initialize", part="effects", fraction=0.74)
        fitted = _fitted_to_views(choice.numbers)
        return _tell(said, tried, _RayTrial(context, evidence, choice).quality, context.request, fitted)
    return None


def tell_gains_of_photos(
    context: StageContext, photos: Photos, rows: Sequence[dict[str, Any]], stage: str, fraction: float
) -> str | None:
    """The same for effects of photos that are drawn with the splats, and `times_as_long`, what a step takes with one
    beside one without.

    Args:
        photos: with the cameras that were found.
        stage, fraction: where the run is meanwhile.

    Returns:
        As `tell_gains_of_rays`.

    Raises:
        CaptureError: a photo cannot be read.
        Cancelled: the user asked to stop.
    """
    tried = [row for row in rows if row["used"] and (row["name"] in EFFECTS or row["name"] == "pixel_integration")]
    shown = [photo for photo in photos.photos if photo.camera is not None and not photo.held_out]
    if tried and len(shown) >= FEWEST:
        here = Progress(stage, "effects", fraction)
        trial = _PhotoTrial(context, photos, shown, [row["name"] for row in tried], here)
        said = partial(context.progress, stage, part="effects", fraction=fraction)
        return _tell(said, tried, trial.quality, context.request, EFFECTS, trial.paces)
    return None


def _tell(
    said: Callable[..., None],
    tried: list[dict[str, Any]],
    quality: Callable[[str | None, int], float],
    request: Request | None,
    fitted: Collection[str],
    paces: Mapping[str | None, float] | None = None,
) -> str | None:
    """Adds to rows what their effects are worth and cost; the name of the one that is to be left out, if any.

    Args:
        said: takes a message for the user.
        tried: the rows.
        quality: PSNR in dB of views set aside, with one effect left out, or with all, in the first trial or another.
        request: what the user asked for.
        fitted: names of effects that have numbers of their own for each view.
        paces: seconds of a step in the first trial by the same names, filled by `quality`; None where effects were
            taken out before, so that no step takes longer.
    """
    if request is None:
        raise AssertionError("nobody asks for effects")
    said(message="trying the model with the effects that were found")
    first, others, harmful = quality(None, 0), list[float](), list[dict[str, Any]]()
    for row in tried:
        name, automatic = row["name"], row["chosen_by"] == "auto"
        said(message=Told("trying the model without {effect}", effect=TOLD[name]))
        best, rest, repeated = first, quality(name, 0), False
        if automatic and best - rest < -_NOTHING_DB:
            said(message=Told("{effect} seems to do harm: trying it again", effect=TOLD[name]))
            others = others or [quality(None, again) for again in range(1, 1 + _MORE)]
            best, rest = mean(others), mean(quality(name, again) for again in range(1, 1 + _MORE))
            repeated = True
        row["gain_db"] = best - rest
        told = Told(
            "In {count} short trials, on average, views set aside have {best:.1f} dB with it, {rest:.1f} dB without."
            if repeated
            else "In a short trial views set aside have {best:.1f} dB with it, {rest:.1f} dB without.",
            count=_MORE,
            best=best,
            rest=rest,
        )
        say(row, told)
        if name in fitted:
            say(row, Told("With it, they had numbers of their own fitted to them, which is part of the difference."))
        if paces:
            row["times_as_long"] = paces[None] / paces[name]
            say(row, Told("A step takes {times:.1f} times as long with it.", times=row["times_as_long"]))
        if automatic and row["gain_db"] < -_HARM_DB:
            harmful.append(row)
        elif row["gain_db"] < -_NOTHING_DB:
            harm = "So it may do harm: compare a run with --effects {effects}."
            say(row, Told(harm, effects=request.without(name)))
    if not harmful:
        return None
    worst = min(harmful, key=lambda row: float(row["gain_db"]))
    worst["used"] = False
    other = "So it is not used; --effects {effects} uses it all the same."
    say(worst, Told(other, effects=request.using(worst["name"])))
    return str(worst["name"])


def _fitted_to_views(numbers: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Effects of X-rays with numbers for each view, those set aside, too; a detector may be off in all views alike."""
    places = [np.asarray(rows) for rows in numbers.get("geometry", {}).values()]
    return ["motion", "geometry"] if any((rows != rows[:1]).any() for rows in places) else ["motion"]


@dataclass(frozen=True)
class _RayTrial:
    context: StageContext
    evidence: RayEvidence
    choice: Choice

    def quality(self, left_out: str | None, again: int) -> float:
        given, training = self.evidence.views, self.evidence.training
        # Rings stay in both: their offsets are of the detector's own pixels, not of blocks. So does noise, of which
        # blocks have less.
        never = (left_out, "ring", "noise")
        numbers = {name: held for name, held in self.choice.numbers.items() if name not in never}
        views = without_effects(given, numbers, self.context.reporter.check)
        aside = training[_EVERY // 2 :: _EVERY]
        held_out = views.held_out.copy()
        held_out[aside] = True
        splats, peak, found = self._fitted(replace(views, held_out=held_out), again), given.peak(training), []
        for index in aside:
            self.context.reporter.check()
            with torch.no_grad():
                image = radiograph(splats, views.detectors[index], self.context.kernel).numpy()
            for name in reversed(XRAY_EFFECTS):
                if name in numbers and name in TRIED_RAYS:
                    image = effect_module(name).drawn(image, index, given, numbers[name])
            seen = np.isfinite(given.images[index])
            found.append(psnr(image[seen], given.images[index][seen], peak))
        return float(np.mean(found))

    def _fitted(self, views: Projections, again: int) -> GaussianSet:
        """A torch set."""
        context = replace(self.context, seed=self.context.seed + again)
        here = Progress("initialize", "effects", 0.74)
        trainer = short_trainer(context, views, self.evidence.reconstructed(views), short_settings(STEPS), here)
        for step in range(STEPS):
            context.reporter.check()
            trainer.step(step)
        return trainer.parameters.to_set().to_torch()


class _PhotoTrial:
    def __init__(
        self, context: StageContext, photos: Photos, shown: list[Photo], names: list[str], here: Progress
    ) -> None:
        self._context, self._names, self._here = context, names, here
        self.paces: dict[str | None, float] = {}
        self._start = context.run.read_set("initialize", "rgb")
        self._background, self._is_put = shown_or_put_background(photos, tick=context.reporter.check)
        places = Stop(views=photos_aside(len(shown))).set_aside(len(shown))
        middle = np.median(np.asarray(self._start.means, np.float64), axis=0)
        self._shown, self._aside = (
            _Middles(
                [photo for place, photo in enumerate(shown) if (place in places) is aside],
                context.photo_side,
                self._background,
                tick=context.reporter.check,
                middle=middle,
            )
            for aside in (False, True)
        )

    def quality(self, left_out: str | None, again: int) -> float:
        names = [name for name in self._names if name != left_out]
        effects = tuple(EFFECTS[name]() for name in names if name in EFFECTS)
        settings = replace(
            PRESETS["draft"].rgb,
            iterations=STEPS,
            growth=Growth(),
            **vars(replace(self._context.photo_options, pixel_integration="pixel_integration" in names)),
            effects=before(effects, self._background, self._is_put),
        )
        context, shown, aside = self._context, self._shown, self._aside
        announce(context.reporter, self._here, context.compiled(*settings.renderers))
        trainer = RgbTrainer(
            self._start,
            shown,
            aside,
            self._background,
            settings,
            context.seed + again,
            context.kernel,
            validation=aside,
        )
        began = time.perf_counter()
        for step in range(STEPS):
            context.reporter.check()
            if step == STEPS // 2:
                # Kernels are compiled, and buffers there.
                began = time.perf_counter()
            trainer.step(step)
        self.paces.setdefault(left_out, (time.perf_counter() - began) / (STEPS - STEPS // 2))
        found = trainer.validate(context.reporter.check)
        return 0.0 if found is None else found


class _Middles(TrainingPhotos):
    """Photos of which no more is seen than some pixels around a point."""

    def __init__(self, *given: Any, middle: np.ndarray, **options: Any) -> None:
        super().__init__(*given, **options)
        self._windows = [_window(camera, middle) for camera in self.cameras]
        pairs = zip(self.cameras, self._windows, strict=True)
        self.cameras = [_cut(camera, rows, columns) for camera, (rows, columns) in pairs]

    def read(self, index: int, share: float = 1.0) -> tuple[Camera, torch.Tensor, torch.Tensor | None]:
        _, color, mask = super().read(index)
        rows, columns = self._windows[index]
        seen = None if mask is None else mask[rows, columns].contiguous()
        return self.cameras[index], color[rows, columns].contiguous(), seen


def _window(camera: Camera, middle: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns about where a point (3,) is seen; of a camera that does not see it about the image's middle."""
    column, row, inside = (value[0] for value in camera.pixels_of(middle[None]))
    place = (row, column) if inside else (camera.height // 2, camera.width // 2)
    windows = []
    for at, size in zip(place, (camera.height, camera.width), strict=True):
        side = min(size, MIDDLE_PX)
        first = int(np.clip(at - side // 2, 0, size - side))
        windows.append(slice(first, first + side))
    return windows[0], windows[1]


def _cut(camera: Camera, rows: slice, columns: slice) -> Camera:
    return replace(
        camera,
        width=columns.stop - columns.start,
        height=rows.stop - rows.start,
        cx=camera.cx - columns.start,
        cy=camera.cy - rows.start,
        slopes=camera.field_of_view(),
    )
