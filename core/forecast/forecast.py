"""What a run will take: the steps of each part times what a step takes on this machine with this capture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..capture.model import Capture, Projections
from ..settings import Settings
from ..stages.internal.joint_settings import without_photos
from ..train.schedule import Growth
from ..train.strategy import DefaultStrategy
from .speed import Speed, StepTime, photo_size

# Photo splats that a training ends with, as a multiple of those it begins with, where the strategy's limit lies higher.
_GROWN = 3.0
# Of those, structure from motion or the visual hull leave about so many of objects.
_FIRST_RGB = 7_000
# Steps of the schedule that are looked at: splats and image sizes change slowly.
_SAMPLES = 50
# Seconds of what is no training, on a machine whose step of 30,000 splats on 20,000 pixels takes `_REFERENCE_STEP_S`.
_REFERENCE_STEP_S = 0.02
_FDK_START_S, _FDK_PER_VOXEL_S = 8.0, 1.5e-9
_POINTS_PER_PHOTO_S, _CAMERAS_PER_PAIR_S, _CAMERAS_PER_PHOTO_S = 0.12, 0.02, 1.0
_ALIGN_S, _REPORT_S = 6.0, 12.0
# A view that is only measured takes such a share of a training step on it.
_FORWARD = 0.4


@dataclass(frozen=True)
class Forecast:
    """What a run will take.

    Attributes:
        settings: of the run.
        parts: seconds by "stage part", in the order of the run.
        cameras: whether cameras have to be found first, whose time nobody can tell well.
    """

    settings: Settings
    parts: dict[str, float]
    cameras: bool

    @property
    def seconds(self) -> float:
        return sum(self.parts.values())


def forecast(capture: Capture, settings: Settings, speed: Speed) -> Forecast:
    """The parts of a whole run with these settings; those that the capture does not call for are left out."""
    return _Plan(capture, settings, speed).forecast()


class _Plan:
    def __init__(self, capture: Capture, settings: Settings, speed: Speed) -> None:
        self._capture, self._settings, self._speed = capture, settings, speed
        self._stages: dict[str, Any] = settings.stages
        some = speed.photo or speed.projection
        self._slowness = 1.0 if some is None else some.seconds(30_000, 20_000) / _REFERENCE_STEP_S

    def forecast(self) -> Forecast:
        capture, parts = self._capture, self._begin()
        if self._speed.photo is not None:
            parts["surface rgb"] = self._surface_rgb(self._speed.photo)
        if self._speed.projection is not None:
            parts["surface xray"] = self._surface_xray(self._speed.projection)
        both = capture.photos is not None and self._speed.projection is not None
        if both:
            parts["align"] = self._slowness * _ALIGN_S
        if self._speed.projection is not None and self._speed.section is not None:
            parts |= self._internal(self._speed.projection, self._speed.section, both)
        parts["report"] = self._slowness * _REPORT_S
        return Forecast(self._settings, parts, capture.photos is not None and not capture.photos.posed)

    def _begin(self) -> dict[str, float]:
        found, photos, projections = {}, self._capture.photos, self._capture.projections
        if photos is not None:
            count = len(photos.photos)
            pairs = 0.0 if photos.posed else _CAMERAS_PER_PAIR_S * count**2 / 2 + _CAMERAS_PER_PHOTO_S * count
            found["initialize photos"] = self._slowness * (pairs + _POINTS_PER_PHOTO_S * count)
        if projections is not None:
            work = float(np.prod(projections.voxels)) * len(projections.images)
            found["initialize xray"] = self._slowness * (_FDK_START_S + _FDK_PER_VOXEL_S * work)
        return found

    def _surface_rgb(self, step: StepTime) -> float:
        settings = self._stages["surface"].rgb
        pixels = self._photo_pixels(settings.long_side)
        return settings.iterations * _mean_step(step, self._rgb_splats(), pixels, settings.growth, settings.strategy)

    def _rgb_splats(self) -> tuple[float, float]:
        """At the beginning and in the end."""
        most = getattr(self._stages["surface"].rgb.strategy, "most", 1e9)
        first = min(_FIRST_RGB, self._stages["initialize"].most_rgb)
        return first, min(_GROWN * first, most)

    def _photo_pixels(self, long_side: int) -> float:
        photos = self._capture.photos
        if photos is None:
            return 0.0
        width, height = photo_size(photos.photos[0])
        share = min(1.0, long_side / max(width, height))
        return float(width * height * share**2)

    def _surface_xray(self, step: StepTime) -> float:
        settings = self._stages["surface"].xray
        return settings.iterations * _mean_step(
            step, self._xray_splats(), self._projection_pixels(), settings.growth, settings.strategy
        )

    def _xray_splats(self) -> tuple[float, float]:
        start, strategy = self._stages["initialize"], self._stages["surface"].xray.strategy
        first = {"coarse": start.coarse_splats, "fdk": start.xray_splats}.get(start.start)
        if first is None:
            first = float(np.prod(self._projections.voxels)) / start.acui_stride**3
        return first, strategy.most if strategy.budget else min(2 * first, strategy.most)

    @property
    def _projections(self) -> Projections:
        found = self._capture.projections
        if found is None:
            raise AssertionError("only asked where there are projections")
        return found

    def _projection_pixels(self) -> float:
        return float(np.prod(self._projections.images.shape[1:]))

    def _internal(self, projection: StepTime, section: StepTime, both: bool) -> dict[str, float]:
        settings, joint = self._stages["internal"], self._stages["internal"].joint
        radiative, rgb = self._xray_splats()[1], self._rgb_splats()[1] if both else 0.0
        voxels = np.sort(self._projections.voxels)
        cut = section.seconds(radiative, float(voxels[-1] * voxels[-2]))
        ray = projection.seconds(radiative, self._projection_pixels())
        found = {"internal display": settings.display_iterations * cut}
        if joint is None:
            found["internal xray"] = settings.xray_iterations * (cut + ray)
            found["internal rgb"] = settings.rgb_iterations * cut if both else 0.0
            return found
        if not both or self._speed.photo is None:
            alone = without_photos(joint)
            return {**found, "internal joint": alone.iterations * ray}
        photo = self._speed.photo.seconds(radiative + rgb, self._photo_pixels(joint.photo_size))
        step = photo + ray / joint.xray_every + cut / joint.section_every
        return {**found, "internal joint": joint.iterations * step}


def _mean_step(
    step: StepTime, splats: tuple[float, float], pixels: float, growth: Growth, strategy: DefaultStrategy
) -> float:
    """Mean seconds of a step while splats grow from the first number to the last and images to their full size."""
    first, last = splats
    total = 0.0
    for fraction in (np.arange(_SAMPLES) + 0.5) / _SAMPLES:
        grown = np.clip((fraction - strategy.start) / max(strategy.stop - strategy.start, 1e-9), 0.0, 1.0)
        total += step.seconds(first + (last - first) * grown, pixels * growth.share(fraction) ** 2)
    return total / _SAMPLES
