"""How long a training step takes on this machine with a capture's own images: measured in about two seconds."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ..capture.model import Capture, Photo, Projections
from ..gaussians import GaussianSet
from ..progress import Tick, unstopped
from ..threads import Alone
from ..views import Camera, Plane
from .crowd import crowded, filling, object_cells
from .detail import PhotoLook, look_at_photos
from .points import PointsTime, time_points

if TYPE_CHECKING:
    from ..effects import Effect
    from ..stages.surface.rgb import RgbSettings

# Splats that steps are timed with: as a training begins, and as it goes on.
_FEW, _MANY = 3_000, 30_000
# A timing ends after so many seconds and steps, whichever is later.
_SECONDS, _STEPS = 0.15, 3
# What a reference machine takes for a step on a section of a cube, or where nothing was X-rayed for one on a photo of a
# ball (`Speed.slowness`); the latter by what it takes over the former, 1.6 times as long, on another machine.
_CUBE_S, _BALL_S = 0.010, 0.016
# What steps of a training take over the fastest of the same step made again and again, whose data the processor has at
# hand, and whose splats are not as the trained ones.
_PHOTO, _PROJECTION, _SECTION = 1.2, 0.9, 1.8
# What of a training step threads do not share, beside what they do not of the timed ones, which two threads nearly
# halve: over these whole trainings of five captures took 1.25 times as long with two threads as with one.
_UNSHARED = 0.28
# How far a camera moves while its shutter is open where that is to be seen: `MotionBlur` starts with less.
_MOTION_PX = 4.0
# What photos of an object usually show of it, where they do not tell: its radius over its distance from the camera.
_APPARENT_RADIUS = 0.25
# Nothing at all before the background is no object.
_LEAST_COVERED = 0.005
# Opacity and size over spacing of splats whose steps take as long as those of trained ones: 0.92 to 1.0 times as long
# on the sample and the five phantoms (`draft`), whose objects cover 12 to 38 % of a photo.
_OPACITY, _OVERLAP = 0.3, 1.0


@dataclass(frozen=True)
class StepTime:
    """Seconds of a step: `fixed` + `by_splat` · splats + `by_pixel` · pixels, none of them below 0."""

    fixed: float
    by_splat: float
    by_pixel: float

    def seconds(self, splats: float, pixels: float) -> float:
        return self.fixed + self.by_splat * splats + self.by_pixel * pixels

    def slower(self, times: float) -> StepTime:
        return StepTime(times * self.fixed, times * self.by_splat, times * self.by_pixel)


@dataclass(frozen=True)
class Speed:
    """What was measured; None for a half that the capture does not have.

    Attributes:
        photo: of a step of `surface.rgb`.
        projection: of a step of `surface.xray`.
        section: of a step on a section of the X-rayed box: occupancy, forward and backward.
        slowness: how many times as long as the reference machine this one takes for one and the same step, whatever
            the capture shows: large images and effects make no machine slow.
        alone: the same of one thread, for work that is not shared out among threads.
        points: of sparse points, where they have to be triangulated.
        look: what photos show at the size that they are trained at.
    """

    photo: StepTime | None
    projection: StepTime | None
    section: StepTime | None
    slowness: float = 1.0
    alone: float = 1.0
    points: PointsTime | None = None
    look: PhotoLook = PhotoLook()


def drawn_with(capture: Capture) -> tuple[str, ...]:
    """The renderers that a reconstruction of the capture trains with."""
    scanned = capture.projections is not None, capture.projections is not None or capture.volume is not None
    there = zip(("splat", "radiograph", "section"), (capture.photos is not None, *scanned), strict=True)
    return tuple(renderer for renderer, wanted in there if wanted)


def measure_speed(
    capture: Capture,
    long_side: int,
    tick: Tick = unstopped,
    known: Speed | None = None,
    rgb: RgbSettings | None = None,
) -> Speed:
    """Times steps of the two trainings and of sections, with splats that lie where a model's would, and sparse points;
    and looks at a few photos.

    Kernels must be compiled (`render.kernels.cpu.is_compiled`), or their compilation is timed.

    Args:
        long_side: of the photos in pixels.
        tick: called between timings; may raise to stop.
        known: what was measured of the capture with photos of another size, other colours or effects; all but steps on
            photos and what these show is taken over.
        rgb: with effects, colours and splats drawn as photos are trained with; 3DGS's if None.

    Raises:
        CaptureError: a photo cannot be read.
        DiskFullError, RunFolderError: as `time_points`.
    """
    from numba import get_num_threads

    # Sections are cut from the user's volume where there is one.
    scanned = capture.projections if capture.volume is None else capture.volume
    photo, points, look = None, None, PhotoLook()
    if capture.photos is not None:
        look = look_at_photos(capture.photos.photos, long_side, tick)
        photo = _photo_time(before_the_object(capture.photos.photos[0], look.covered), long_side, rgb, tick)
    if known is not None:
        return replace(known, photo=_trained(photo, known.slowness, known.alone), look=look)
    if capture.photos is not None and capture.photos.posed and capture.photos.points is None:
        points = time_points(capture.photos, tick)
    projection = section = None
    if scanned is not None:
        projection = None if capture.projections is None else _projection_time(capture.projections, tick)
        section = _section_time(scanned.box_mm, tick)
    usual, usual_s = (_ball_time, _BALL_S) if scanned is None else (_cube_time, _CUBE_S)
    slowness = alone = usual(tick) / usual_s
    if get_num_threads() > 1:
        with Alone(True):
            alone = usual(tick) / usual_s
    photo, projection, section = (_trained(step, slowness, alone) for step in (photo, projection, section))
    return Speed(photo, projection, section, slowness, alone, points, look)


def _trained(step: StepTime | None, slowness: float, alone: float) -> StepTime | None:
    """The step as trainings make it, with as many threads as gain so much over one."""
    return None if step is None else step.slower(1 + _UNSHARED * max(alone / slowness - 1, 0.0))


def photo_size(photo: Photo) -> tuple[int, int]:
    """Width and height in pixels as the photo is trained on, without reading them all."""
    from ..capture.photos import image_facts

    if photo.camera is not None:
        return photo.camera.width, photo.camera.height
    facts = image_facts(photo.path)
    return facts.upright if photo.upright else facts.stored


def trained_size(capture: Capture, long_side: int) -> int:
    """The long side that photos are trained at: they are never enlarged."""
    return long_side if capture.photos is None else min(long_side, max(photo_size(capture.photos.photos[0])))


def _photo_time(photo: Photo, long_side: int, rgb: RgbSettings | None, tick: Tick) -> StepTime:
    from ..stages.surface.photos import TrainingPhotos
    from ..stages.surface.rgb import RgbSettings, RgbTrainer
    from ..train.schedule import Growth
    from ..train.strategy import DefaultStrategy

    photos = TrainingPhotos([replace(photo, held_out=False)], long_side, None)
    nobody = TrainingPhotos([], long_side, None)
    drawn = RgbSettings()
    if rgb is not None:
        drawn = replace(drawn, degree=rgb.degree, effects=_as_learnt(rgb.effects), **vars(rgb.options))
    # Effects are learnt, and colours go by the direction, from some iterations on.
    first = drawn.iterations // 2

    def step(splats: int, share: float) -> Callable[[int], object]:
        settings = replace(
            drawn, long_side=long_side, growth=Growth(((1.0, share),)), strategy=DefaultStrategy(start=1.0, stop=0.0)
        )
        trainer = RgbTrainer(_shell(splats), photos, nobody, None, settings, 0, "cpu")
        return lambda iteration: trainer.step(first + iteration)

    camera = photos.cameras[0]
    return _step_time(step, camera.width * camera.height, _PHOTO, tick)


def _as_learnt(effects: tuple[Effect, ...]) -> tuple[Effect, ...]:
    """Effects as they are in the middle of a training: the farther a camera moves the more views are drawn of its
    way."""
    if not effects:
        return effects
    from ..effects import MotionBlur

    return tuple(replace(one, start_px=_MOTION_PX) if isinstance(one, MotionBlur) else one for one in effects)


def before_the_object(photo: Photo, covered: float | None) -> Photo:
    """The photo with a camera that sees a ball of radius 1 around the origin as large as photos show the object.

    What takes a step its time is how many pixels splats cover, and a thin or a far object covers few.

    Args:
        covered: share of the photo that the object covers; as of most captures if None.
    """
    camera, radius = _camera(photo), _APPARENT_RADIUS
    if covered is not None:
        tangent = np.sqrt(max(covered, _LEAST_COVERED) * camera.width * camera.height / np.pi) / camera.fx
        radius = float(np.sin(np.arctan(tangent)))
    pose = np.eye(4)
    pose[2, 3] = 1 / radius
    return replace(photo, camera=replace(camera, world_to_camera=pose))


def _camera(photo: Photo) -> Camera:
    """The photo's, or what phones usually have."""
    if photo.camera is not None:
        return photo.camera
    width, height = photo_size(photo)
    focal = 1.2 * max(width, height)
    return Camera(width, height, focal, focal, width / 2, height / 2, np.eye(4))


def _shell(splats: int) -> GaussianSet:
    """Splats on a ball's surface, as those of photos lie."""
    from ..evaluate.histogram import fibonacci_sphere

    points = fibonacci_sphere(splats)
    spacing = np.sqrt(4 * np.pi / splats)
    scales = np.full((splats, 3), _OVERLAP * spacing, np.float32)
    return GaussianSet.create(points.astype(np.float32), scales, opacities=_OPACITY)


def _projection_time(projections: Projections, tick: Tick) -> StepTime:
    from ..stages.surface.stage import PRESETS
    from ..stages.surface.xray import XrayTrainer
    from ..train.schedule import Growth
    from ..train.strategy import DefaultStrategy

    few = replace(projections, images=projections.images[:1], detectors=projections.detectors[:1])
    few = replace(few, held_out=np.zeros(1, bool), angles_rad=projections.angles_rad[:1])
    settings = replace(PRESETS["standard"].xray, strategy=DefaultStrategy(start=1.0, stop=0.0), smooth_every=1)
    voxel_mm = float(np.mean((projections.box_mm[1] - projections.box_mm[0]) / np.array(projections.voxels)))
    box_mm, cells = projections.box_mm, object_cells(projections)

    def step(splats: int, share: float) -> Callable[[int], object]:
        grown = replace(settings, growth=Growth(((1.0, share),)))
        # They begin all over the box and go where there is something: every other one of either.
        ways = filling(box_mm, splats), crowded(box_mm, splats, cells)
        both = GaussianSet.concatenate([way.select(np.arange(0, len(way), 2)) for way in ways])
        return XrayTrainer(both, few, voxel_mm, 0.01, grown, 0, "cpu").step

    height, width = projections.images.shape[1:]
    return _step_time(step, height * width, _PROJECTION, tick)


def _section_time(box_mm: np.ndarray, tick: Tick) -> StepTime:
    step, plane = _section_steps(box_mm)
    return _step_time(step, plane.width * plane.height, _SECTION, tick)


def _cube_time(tick: Tick) -> float:
    """Seconds of a step on a section of 128 x 128 pixels through a cube of 30,000 splats."""
    tick()
    step, _ = _section_steps(np.array([[-50.0] * 3, [50.0] * 3]))
    return _timed(step(_MANY, 1.0))


def _ball_time(tick: Tick) -> float:
    """Seconds of a step on a photo of 160 x 160 pixels of a ball of 30,000 splats."""
    from ..render import splat

    tick()
    pose = np.eye(4)
    pose[2, 3] = 1 / _APPARENT_RADIUS
    camera = Camera(160, 160, 190.0, 190.0, 80.0, 80.0, pose)
    ball = _shell(_MANY).to_torch()
    ball = replace(ball, means=ball.means.requires_grad_(), opacities=ball.opacities.requires_grad_())
    return _timed(lambda _: splat(ball, camera).color.sum().backward())


def _section_steps(box_mm: np.ndarray) -> tuple[Callable[[int, float], Callable[[int], object]], Plane]:
    """Steps on the middle axial plane of a box (2, 3) mm, by splats and the share of the plane's side; the plane."""
    from ..render import section
    from ..sections import choose_planes

    planes = [view.plane for view in choose_planes(box_mm, planes=("axial",))]
    plane = planes[len(planes) // 2]

    def step(splats: int, share: float) -> Callable[[int], object]:
        width, height = max(round(share * plane.width), 1), max(round(share * plane.height), 1)
        u, v = np.asarray(plane.u) * (plane.width / width), np.asarray(plane.v) * (plane.height / height)
        coarser = replace(plane, u=u, v=v, width=width, height=height)
        tensors = filling(box_mm, splats).to_torch()
        tensors = replace(tensors, opacities=tensors.opacities.requires_grad_())
        return lambda iteration: section(tensors, coarser, "occupancy").sum().backward()

    return step, plane


def _step_time(
    step: Callable[[int, float], Callable[[int], object]], pixels: int, longer: float, tick: Tick
) -> StepTime:
    """From steps with few and many splats, and with many on a half of the image's side; in a training they take so
    many times as long."""
    timed = []
    for splats, share in ((_FEW, 1.0), (_MANY, 1.0), (_MANY, 0.5)):
        tick()
        timed.append(longer * _timed(step(splats, share)))
    few, many, small = timed
    by_splat = max(many - few, 0.0) / (_MANY - _FEW)
    by_pixel = max(many - small, 0.0) / (0.75 * pixels)
    return StepTime(max(few - by_splat * _FEW - by_pixel * pixels, 0.0), by_splat, by_pixel)


def _timed(step: Callable[[int], object]) -> float:
    """Seconds of the fastest of a few steps, the first left out: what else runs on a machine only makes it slower."""
    step(0)
    taken: list[float] = []
    while len(taken) < _STEPS or sum(taken) < _SECONDS:
        begin = time.perf_counter()
        step(len(taken) + 1)
        taken.append(time.perf_counter() - begin)
    return min(taken)
