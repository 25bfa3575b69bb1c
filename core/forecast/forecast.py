"""What a run will take: the steps of each part times what a step takes on this machine with this capture."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..capture.model import Capture, Projections
from ..capture.sfm_steps import pairs_by_name
from ..capture.values import every_eighth
from ..evaluate.heldout import MOST_COMPARED
from ..evaluate.report import PHOTO_SIZE
from ..evaluate.residual import MOST_VIEWS
from ..settings import Settings
from ..stages.internal.joint_settings import joint_of, without_photos
from ..stages.measures import UNTIL, measured_with_effects
from .fitting import FORWARD, learnt_effects, steps_to_measure
from .growth import grown, mean_step, splats_then
from .pace import measuring_of
from .speed import Speed, StepTime, photo_size

if TYPE_CHECKING:
    from ..stages.surface.rgb import RgbSettings

# Photo splats grow towards so many for each unit of detail of a photo (`PhotoLook`), half as many with six photos, for
# few do not show an object from all around. Those of `standard` came to 16 to 29 on five phantoms with 60 photos, 24 on
# the sample with 44 and 14 on a puppet of felt with 11.
_SPLATS_PER_DETAIL, _HALF_SEEN_BY = 24.0, 6
# The visual hull leaves about so many, structure from motion of so many a photo (106 of the puppet, 165 of a skull).
_OF_HULL, _POINTS_PER_PHOTO = 10_000, 130
# Seconds below are of the reference machine of `Speed.slowness`. What takes as long with two threads as with one goes
# by `Speed.alone`: the hull, the alignment, the mesh and what the report measures of volumes and surfaces.
# Programs and kernels are loaded before the first part; ITK-RTK while photos are looked at or, without any, before it
# reconstructs.
_BEGIN_S, _FDK_START_S, _LOADING_S, _FDK_PER_VOXEL_S = 4.5, 6.0, 3.0, 1.5e-9
# Looking for effects: see `_Plan._looking_at_rays` and `_looking_at_photos`.
_LOOK_S, _LOOK_PER_PIXEL_S = 1.0, 3.75e-6
_LOOK_EDGES_PER_PIXEL_S, _LOOK_EDGES_PIXELS = 4e-6, 2_000_000
_LOOK_MOVED_PER_PIXEL_S, _LOOK_MOVED_VIEWS = 5.5e-6, 72
_LOOK_PHOTOS_S, _LOOK_PHOTOS, _LOOK_PER_PHOTO_PIXEL_S = 1.0, 40, 1e-8
_LOOK_MOTION_S, _LOOK_FOCUS_S, _LOOK_STILL_S, _LOOK_LENS_S = 1.0, 3.0, 1.2, 2.0
# Taking effects out of projections, by the pixel: a spot whose half-shadow deviates by a pixel (a half takes half as
# long, three twice as long), scattered light on large detectors, and a hardened beam behind metal. The rest is less.
_CORRECT_PER_PIXEL_S = {"focal_spot": 8e-7, "scatter": 1.2e-7, "beam_hardening": 2.5e-8}
# JPEGs are read at a fraction of their size; whatever else is read whole takes so many times as long.
_JPEG, _READ_WHOLE = (".jpg", ".jpeg"), 20
# Points triangulated of what was matched, the visual hull and splats there; and cameras that have to be found.
_SPLATS_PER_PHOTO_S, _CAMERAS_PER_PAIR_S, _CAMERAS_PER_PHOTO_S = 0.03, 0.02, 0.7
_ALIGN_S, _CHAMFER_S = 10.0, 1.0
# A set's mean density in all voxels.
_AVERAGE_PER_VOXEL_S = 1e-6
# Of a step of the joint refinement, what is done once for all splats together.
_JOINT_PER_SPLAT_S = 1.7e-7
# The report averages two models over all voxels, makes a mesh of one, and compares every fifth section of them.
_REPORT_PER_VOXEL_S = 4e-6
# A residual draws a view and sends it back twice, of splats that end at 5.3 σ and not at 3: so many training steps.
_RESIDUAL = 3.6
# Photo splats, radiative ones and the finished model are compared with projections that were held out.
_MODELS = 3


@dataclass(frozen=True)
class Forecast:
    """What a run will take.

    Attributes:
        settings: of the run.
        parts: seconds by "stage part", in the order of the run.
        cameras: whether cameras have to be found first, whose time nobody can tell well.
        speed: of steps, that it was made with.
    """

    settings: Settings
    parts: dict[str, float]
    cameras: bool
    speed: Speed = Speed(None, None, None)

    @property
    def seconds(self) -> float:
        return sum(self.parts.values())


def forecast(capture: Capture, settings: Settings, speed: Speed, splats: Mapping[str, int] | None = None) -> Forecast:
    """The parts of a whole run with these settings; those that the capture does not call for are left out.

    Args:
        splats: how many a run that is under way has, see `RunFolder.splats`.
    """
    return _Plan(capture, settings, speed, splats or {}).forecast()


class _Plan:
    def __init__(self, capture: Capture, settings: Settings, speed: Speed, splats: Mapping[str, int]) -> None:
        self._capture, self._settings, self._speed, self._splats = capture, settings, speed, splats
        self._stages: dict[str, Any] = settings.stages
        self._slowness, self._alone = speed.slowness, speed.alone
        self._effects = learnt_effects(settings) if speed.photo is not None else ()

    def forecast(self) -> Forecast:
        capture, parts = self._capture, self._begin()
        if self._speed.photo is not None:
            parts |= self._surface_rgb(self._speed.photo)
        if self._speed.projection is not None:
            parts["surface xray"] = self._surface_xray(self._speed.projection)
        photo = self._speed.photo if self._speed.section is not None else None
        if photo is not None:
            parts["align"] = self._alone * _ALIGN_S + (self._averaging() if capture.needs_fdk else 0.0)
        if self._speed.section is not None:
            parts |= self._internal(photo, self._speed.projection, self._speed.section)
        parts["report"] = self._report()
        cameras = capture.photos is not None and not capture.photos.posed
        return Forecast(self._settings, parts, cameras, self._speed)

    def _begin(self) -> dict[str, float]:
        found, photos, projections = {}, self._capture.photos, self._capture.projections
        if photos is not None:
            count = len(photos.photos)
            cameras = 0.0
            if not photos.posed:
                pairs = len(pairs_by_name([f"{index:05d}" for index in range(count)]))
                cameras = _CAMERAS_PER_PAIR_S * pairs + _CAMERAS_PER_PHOTO_S * count
            points = 0.0 if self._speed.points is None else self._speed.points.seconds(photos)
            splats = self._alone * _SPLATS_PER_PHOTO_S * count
            found["initialize photos"] = self._slowness * cameras + splats + points
        if projections is not None and self._capture.needs_fdk:
            work = float(np.prod(projections.voxels)) * len(projections.images)
            loading = _LOADING_S if photos is None else 0.0
            found["initialize xray"] = self._slowness * (loading + _FDK_START_S + _FDK_PER_VOXEL_S * work)
        elif photos is None:
            # The user's volume is only read.
            found["initialize xray"] = 0.0
        found[next(iter(found))] += self._slowness * _BEGIN_S
        looking = self._slowness * (self._looking_at_photos() + self._looking_at_rays() + self._correcting_rays())
        if not looking:
            return found
        return {**found, "initialize effects": looking + self._telling_rings() + self._trying()}

    def _looking_at_photos(self) -> float:
        """Seconds of looking for effects in the photos; 0 where none is looked for.

        For exposure, defocus and motion blur forty of them are read, 0.1 s for a JPEG of 12 million pixels, 2 s for a
        PNG; the rest takes a second, measured on 52 photos with 1500 sparse points. A rolling shutter takes half a
        second on 40 photos with 7000 sightings, of up to 12,000 that are looked at; defocus 1.3 s on 40 photos of 256 x
        256, of up to 400 x 300 pixels, and as many times less as there are fewer. Motion blur is looked for in the same
        edges. A lens that is not told takes 0.4 s on 32 photos with 2300 sightings, 2.5 s on the 40,000 that are looked
        at at most; nobody knows before whether there is one, and then points are looked for three or four times. A
        background that stands still takes 1.2 s on 40 photos of 3 million pixels beside reading them, which is done
        before there are cameras and again after that; nobody knows before whether there is one, and then each photo
        takes a fifth of a second longer to read.
        """
        photos = self._capture.photos
        if photos is None or self._settings.effects == "none":
            return 0.0
        from ..effect_names import PHOTO_EFFECTS
        from ..effects.request import parse_effects

        request, first = parse_effects(self._settings.effects), photos.photos[0]
        wanted = {name for name in PHOTO_EFFECTS if request.wants(name)}
        if not wanted:
            return 0.0
        read = min(_LOOK_PHOTOS, len(photos.photos))
        looking = _LOOK_PHOTOS_S if wanted & {"exposure", "pixel_integration"} else 0.0
        looking += _LOOK_MOTION_S if "rolling_shutter" in wanted else 0.0
        looking += _LOOK_LENS_S if "lens" in wanted and photos.posed and first.lens is None else 0.0
        readings = ("moving_background" in wanted) + bool(wanted & {"exposure", "defocus", "motion_blur"})
        if not readings:
            return looking
        looking += _LOOK_STILL_S * read / _LOOK_PHOTOS if "moving_background" in wanted else 0.0
        looking += _LOOK_FOCUS_S * read / _LOOK_PHOTOS if wanted & {"defocus", "motion_blur"} else 0.0
        width, height = photo_size(first)
        slower = 1 if first.path.suffix.lower() in _JPEG else _READ_WHOLE
        return looking + readings * slower * _LOOK_PER_PHOTO_PIXEL_S * read * width * height

    def _looking_at_rays(self) -> float:
        """Seconds of looking for effects in the projections; 0 where none is looked for.

        FDKs, reprojections and their registration, all on coarse views (`effects.rays.coarse_block`), so it grows with
        the pixels of these. From one measurement: scatter, hardening and geometry in 60 views of a
        matryoshka, 148 x 120 pixels, took about 5 s, and 3 s more where ITK-RTK has to be loaded, which a capture
        without a volume needs anyway. That 1 s of the five does not depend on the size is assumed; fewer effects take
        less. Noise is looked for in a third of a second. Edges, for a focal spot, took 1 s in 50 views of 72 x 60
        pixels; of at most 60 views so many rows are looked at as make two million pixels. For a
        motion up to 72 views are drawn in seven places, 1.5 s for 66 of 64 x 64 pixels; where there is one this is done
        three or four times, which nobody knows before.
        """
        projections = self._capture.projections
        if projections is None or self._settings.effects == "none":
            return 0.0
        from ..effects.request import parse_effects

        request = parse_effects(self._settings.effects)
        if not request.concerns("xray"):
            return 0.0
        count, coarse = len(projections.images), _coarse_pixels(projections)
        loading = 0.0 if self._capture.volume is None else _LOADING_S
        edges = min(projections.images.size, _LOOK_EDGES_PIXELS) if request.wants("focal_spot") else 0
        looking = _LOOK_S + _LOOK_PER_PIXEL_S * count * coarse
        if request.wants("motion"):
            looking += _LOOK_MOVED_PER_PIXEL_S * min(count, _LOOK_MOVED_VIEWS) * coarse
        return loading + looking + _LOOK_EDGES_PER_PIXEL_S * edges

    def _correcting_rays(self) -> float:
        """Seconds of taking the effects that are asked for by name out of all projections at full size, on one core;
        which others are found nobody knows before."""
        projections = self._capture.projections
        if projections is None or self._settings.effects == "none":
            return 0.0
        from ..effects.request import parse_effects

        return _correcting(parse_effects(self._settings.effects).on, projections.images.size)

    def _telling_rings(self) -> float:
        """Seconds of the fit that tells detector pixels from the object, if it is asked for by name. Whether there is
        anything to tell, and whether the object may be told from it, nobody knows before."""
        from ..effects.request import parse_effects
        from ..stages.initialize.rings import OF_BUDGET, settings_of_fit
        from ..stages.short_fit import FIRST_SPLATS

        step, budget_s = self._speed.projection, self._settings.time_budget_s
        if step is None or "ring" not in parse_effects(self._settings.effects).on:
            return 0.0
        fit = settings_of_fit(against_time=budget_s is not None)
        splats = FIRST_SPLATS, fit.strategy.most
        seconds = fit.iterations * mean_step(step, splats, self._projection_pixels(), fit.growth, fit.strategy)
        return seconds if budget_s is None else min(seconds, OF_BUDGET * budget_s)

    def _trying(self) -> float:
        """Seconds of trying what effects are worth that are asked for by name; which others are found nobody knows
        before, and against a time none is tried."""
        if self._settings.effects == "none" or self._settings.time_budget_s is not None:
            return 0.0
        from ..effect_names import BEFORE_CAMERAS, BEFORE_SPLATS, PHOTO_EFFECTS
        from ..effects.request import parse_effects
        from ..stages.effect_gains import FEWEST, MIDDLE_PX, STEPS, TRIED_RAYS, photos_aside
        from ..stages.short_fit import MOST_SPLATS

        on, seconds, shown = parse_effects(self._settings.effects).on, 0.0, self._photos() - self._held_out()
        photos = on.intersection(PHOTO_EFFECTS).difference(BEFORE_CAMERAS + BEFORE_SPLATS)
        if photos and self._speed.photo is not None and shown >= FEWEST:
            pixels = min(self._photo_pixels(self._stages["surface"].rgb.long_side), MIDDLE_PX**2)
            for left_out in (None, *photos):
                fitted = [effect for effect in self._effects if effect.name != left_out]
                steps = STEPS + photos_aside(shown) * steps_to_measure(fitted)
                seconds += steps * self._speed.photo.seconds(self._rgb_splats()[0], pixels)
        rays, projections = on.intersection(TRIED_RAYS), self._capture.projections
        if rays and self._speed.projection is not None and projections is not None:
            if (~projections.held_out).sum() < FEWEST:
                return seconds
            coarse = _coarse_pixels(projections)
            for left_out in (None, *rays):
                seconds += STEPS * self._speed.projection.seconds(MOST_SPLATS, coarse)
                seconds += self._slowness * _correcting(on - {left_out}, len(projections.images) * coarse)
        return seconds

    def _surface_rgb(self, step: StepTime) -> dict[str, float]:
        settings, splats, part = self._rgb(), self._rgb_splats(), "surface rgb"
        pixels = self._photo_pixels(settings.long_side)
        seconds = settings.iterations * mean_step(step, splats, pixels, settings.growth, settings.strategy)

        def then(fraction: float) -> float:
            return splats_then(splats, settings.strategy, fraction)

        return {part: seconds, **self._on_the_way(part, then, settings.long_side)}

    def _on_the_way(self, part: str, splats: Callable[[float], float], long_side: int) -> dict[str, float]:
        """Measuring some held-out photos while a part is trained. Nothing where no effects are fitted to them: that
        takes as long as a few steps, like all that is not told apart from these.

        Args:
            splats: of the model, by the fraction of the part that is done.
            long_side: of the photos in pixels.
        """
        count = min(self._held_out(), MOST_COMPARED)
        if not self._effects or not count:
            return {}
        times = measured_with_effects(part, self._settings.until_db is not None)
        models = [splats((place + 1) / times) for place in range(times)]
        return {measuring_of(part): sum(self._measuring(count, model, long_side) for model in models)}

    def _beside(self, name: str, models: Sequence[float], long_side: int) -> dict[str, float]:
        """The same for measuring all of them before or after a training.

        Args:
            models: splats of each that is measured.
        """
        count = self._held_out()
        if not self._effects or not count:
            return {}
        return {name: sum(self._measuring(count, model, long_side) for model in models)}

    def _measuring(self, photos: int, splats: float, long_side: int) -> float:
        """Seconds of comparing so many held-out photos with a model."""
        step = self._speed.photo
        if step is None:
            raise AssertionError("only asked where there are photos")
        return photos * steps_to_measure(self._effects) * step.seconds(splats, self._photo_pixels(long_side))

    def _rgb_splats(self) -> tuple[float, float]:
        """At the beginning and in the end."""
        settings, count = self._rgb(), self._photos()
        first = self._splats.get("initialize rgb", min(self._found(), self._stages["initialize"].most_rgb))
        densify = settings.strategy.densify
        most = _SPLATS_PER_DETAIL * self._speed.look.detail * count / (count + _HALF_SEEN_BY)
        most_grown = grown(first, most, densify, settings.iterations)
        return first, self._splats.get("surface rgb", max(first, min(most_grown, densify.most)))

    def _rgb(self) -> RgbSettings:
        """How the photos are trained on, as many as there are."""
        settings: RgbSettings = self._stages["surface"].rgb
        return settings.for_photos(self._photos() - self._held_out())

    def _photos(self) -> int:
        return 0 if self._capture.photos is None else len(self._capture.photos.photos)

    def _held_out(self) -> int:
        """How many photos are."""
        photos = self._capture.photos
        if photos is None:
            return 0
        known = sum(photo.held_out for photo in photos.photos)
        return known if photos.posed else int(every_eighth(len(photos.photos)).sum())

    def _found(self) -> int:
        """Photo splats that a training begins with, unless those are too many."""
        from ..stages.initialize.photos import FEW_POINTS, RANDOM_POINTS

        photos = self._capture.photos
        if photos is None:
            return 0
        points = 0 if photos.posed else _POINTS_PER_PHOTO * len(photos.photos)
        if photos.points is not None:
            points = len(photos.points)
        if self._speed.look.covered is not None and self._stages["initialize"].hull_cells:
            return points + _OF_HULL
        return points + (RANDOM_POINTS if points < FEW_POINTS else 0)

    def _photo_pixels(self, long_side: int) -> float:
        photos = self._capture.photos
        if photos is None:
            return 0.0
        width, height = photo_size(photos.photos[0])
        share = min(1.0, long_side / max(width, height))
        return float(width * height * share**2)

    def _surface_xray(self, step: StepTime) -> float:
        settings, splats, pixels = self._stages["surface"].xray, self._xray_splats(), self._projection_pixels()
        seconds = settings.iterations * mean_step(step, splats, pixels, settings.growth, settings.strategy)
        trial, projections = settings.smooth_trial, self._capture.projections
        training = 0 if projections is None else int((~projections.held_out).sum())
        if trial is not None and trial.suits(settings.iterations, training):
            # A second fit beside the first, when nearly all splats are there, and looks at both. A time that leaves too
            # few steps for it has a little less of them than it could.
            seconds += (trial.steps + 2 * trial.looks * FORWARD) * step.seconds(splats[1], pixels)
        return seconds

    def _xray_splats(self) -> tuple[float, float]:
        """At the beginning and in the end."""
        start, strategy = self._stages["initialize"], self._stages["surface"].xray.strategy
        voxels, known = float(np.prod(self._voxels)), self._splats
        if self._capture.projections is None:
            # Taken from the volume, where nothing splits them.
            taken = known.get("initialize xray", min(start.xray_splats, voxels))
            return taken, taken
        first = {"coarse": start.coarse_splats, "fdk": start.xray_splats}.get(start.start)
        if first is None:
            first = voxels / start.acui_stride**3
        last = strategy.most if strategy.budget else min(2 * first, strategy.most)
        return known.get("initialize xray", first), known.get("surface xray", last)

    @property
    def _voxels(self) -> tuple[int, ...]:
        """Of the volume that sections are cut from, in any order."""
        if self._capture.volume is not None:
            return self._capture.volume.values.shape
        if self._capture.projections is None:
            raise AssertionError("only asked where there are X-rays")
        return self._capture.projections.voxels

    def _projection_pixels(self) -> float:
        projections = self._capture.projections
        return 0.0 if projections is None else float(np.prod(projections.images.shape[1:]))

    def _internal(self, photo: StepTime | None, projection: StepTime | None, section: StepTime) -> dict[str, float]:
        """From the refinement to the finish of what was refined apart: in the order of the run, by which `Pace` knows
        what lies ahead.

        Args:
            photo: None where there are no photos to refine.
        """
        settings, joint = self._stages["internal"], joint_of(self._stages["internal"].joint, self._capture)
        radiative = self._xray_splats()[1]
        voxels = np.sort(self._voxels)
        plane = float(voxels[-1] * voxels[-2])
        cut = section.seconds(radiative, plane)
        ray = 0.0 if projection is None else projection.seconds(radiative, self._projection_pixels())
        display = {"internal display": settings.display_iterations * cut}
        if joint is not None and photo is None:
            return {"internal joint": without_photos(joint).iterations * ray, **display}
        rgb = self._rgb_splats()[1]
        both = radiative + rgb
        if joint is not None and photo is not None:
            seen = photo.seconds(both, self._photo_pixels(joint.photo_size))
            step = seen + ray / joint.xray_every + joint.section_until * cut / joint.section_every
            step += self._slowness * _JOINT_PER_SPLAT_S * both
            found = {**display, "internal joint": joint.iterations * step}
            found |= self._on_the_way("internal joint", lambda _: both, joint.photo_size)
            return found | self._beside("fuse measuring", [both], self._stages["fuse"].photo_size)
        follows = settings.xray_iterations if self._capture.can_follow_volume else 0
        # What densities follow is also what they are measured by: before, on the way, and after.
        whole = self._averaging() if self._capture.can_follow_volume else 0.0
        times = 2 if self._settings.until_db is None else UNTIL
        measured = {measuring_of("internal xray"): times * whole, "internal voxels after": whole}
        found = {"internal voxels": whole, "internal xray": follows * (cut + ray), **measured, **display}
        if photo is not None:
            fuse = self._stages["fuse"]
            step = photo.seconds(rgb, self._photo_pixels(settings.photo_size)) + section.seconds(rgb, plane)
            found |= self._beside("internal measuring", [rgb], settings.photo_size)
            found["internal rgb"] = settings.rgb_iterations * step
            found |= self._on_the_way("internal rgb", lambda _: rgb, settings.photo_size)
            found |= self._beside("internal measuring after", [rgb], settings.photo_size)
            found |= self._beside("fuse measuring", [rgb, both], fuse.photo_size)
            finish = photo.seconds(both, self._photo_pixels(fuse.photo_size))
            found["fuse finish"] = fuse.iterations * finish
            found |= self._on_the_way("fuse finish", lambda _: both, fuse.photo_size)
            found |= self._beside("fuse measuring after", [both, both], fuse.photo_size)
        return found

    def _averaging(self) -> float:
        return self._slowness * _AVERAGE_PER_VOXEL_S * float(np.prod(self._voxels))

    def _report(self) -> float:
        """All models in all views that are held out, the last one's residuals, its voxels."""
        photos, projections, seconds = self._capture.photos, self._capture.projections, 0.0
        xray = 0.0 if self._speed.section is None else self._xray_splats()[1]
        if photos is not None and self._speed.photo is not None:
            rgb = self._rgb_splats()[1]
            models = [rgb] if self._speed.section is None else [rgb, xray, rgb + xray]
            seconds += sum(self._measuring(self._held_out(), model, PHOTO_SIZE) for model in models)
        if projections is not None and self._speed.projection is not None:
            view = self._speed.projection.seconds(xray, self._projection_pixels())
            residuals = _RESIDUAL * min(MOST_VIEWS, len(projections.images))
            seconds += (_MODELS * int(projections.held_out.sum()) * FORWARD + residuals) * view
        if self._speed.section is not None:
            seconds += self._alone * _REPORT_PER_VOXEL_S * float(np.prod(self._voxels))
        if photos is not None and self._speed.section is not None:
            seconds += self._alone * _CHAMFER_S
        return seconds


def _coarse_pixels(projections: Projections) -> int:
    """Of a view as effects are looked for in it."""
    from ..effects.rays import coarse_block

    height, width = projections.images.shape[1:]
    block = coarse_block(height, width)
    return (height // block) * (width // block)


def _correcting(effects: Collection[str | None], pixels: float) -> float:
    """Seconds on the reference machine of taking these effects out of projections of so many pixels in all."""
    return sum(seconds * pixels for name, seconds in _CORRECT_PER_PIXEL_S.items() if name in effects)
