"""Photos taken while the camera moved: each is the mean of what was seen on the way (BAD-Gaussians, arXiv 2403.11831).

Whether photos have it is told by edges, which are wide in one direction and not in the other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from ..errors import SettingError
from ..gaussians import GaussianSet
from ..render.splat import SplatImage
from ..told import Told
from ..train.schedule import Decay
from ..views import Camera
from .bands import Band, draw_bands
from .finding import EffectFinding
from .imaging import Draw
from .look.sway import Sways, sways
from .numbers import PhotoNumbers
from .paths import farthest_way, row_poses
from .photos import PhotoEvidence

# Darker pixels pass gradients as if they were this bright: the root of the light has no slope in the dark.
_DARK = 1e-6
# Directions that a photo which was not trained on may have moved along; the opposite ones are the same.
_DIRECTIONS = 4
# Motions of neighbours start this far from each other's direction, in radians: never close, never in line.
_GOLDEN = math.pi * (3 - math.sqrt(5))

_NAME, _UNIT = "motion_blur", "px"
# A camera that moves by d at an even speed makes edges d / √12 wide. Where sharp edges of height 0.3, in a tenth of all
# pixels, are blurred by that, an image changes by 0.0006 d in mean square: 28 dB at 2.5 px. From 1.75 px, 30 dB, edges
# of clean phantoms cannot be told apart: what is painted soft in one direction looks like 1.4 to 1.6 px.
_THRESHOLD, _ERRORS, _SURELY_NOT = 2.5, 3.0, 2.0
_FEWEST_EDGES, _FEWEST_PHOTOS, _MOST_OF_THEM, _FEWEST_POINTS = 100, 3, 0.5, 10
# How much squares of widths differ between directions, over what they are in all. A motion that is much wider than
# edges are otherwise gets near 2; soft photos and a lens, whose edges differ by chance or by depth, stay below 0.75.
_ONE_WAY = 0.8


def detect(evidence: PhotoEvidence) -> EffectFinding:
    """How many pixels of training the camera, or the object, moves while photos are taken: the fourth root of the mean
    fourth power over photos, so that a few blurred ones among many sharp ones count.

    Counts from how squared widths of edges differ between directions in each photo, beside edges of the same place in
    other photos.
    """
    points, photos = evidence.points, len(evidence.cameras)
    if len(points) < _FEWEST_POINTS or any(camera.orthographic for camera in evidence.cameras):
        return _unknown(Told("There are no points of the object to tell which edges in photos belong to it."))
    found = sways(evidence.sharpness, photos, _FEWEST_EDGES)
    known = np.isfinite(found.error)
    if known.sum() < max(_FEWEST_PHOTOS, _MOST_OF_THEM * photos):
        few = "Too few photos show {edges} edges of the object to say whether some are blurred."
        return _unknown(Told(few, edges=_FEWEST_EDGES))
    return _finding(found, known, evidence.pixels_of_training)


def _finding(found: Sways, known: np.ndarray, larger: float) -> EffectFinding:
    """Of the photos that are `known` (N,); `larger` is how many pixels of training one of theirs is."""
    # Noise alone makes lengths of vectors, too: its part is taken off.
    square, noise = (found.tensor[known] ** 2).sum(axis=1), 2 * found.error[known] ** 2
    energy = 4 * float((square - noise).mean())
    uncertain = 4 * float(np.sqrt((2 * square.clip(min=0) * noise + noise**2).sum())) / int(known.sum())

    def way(energy: float) -> float:
        """Of uniform motion, in pixels of training."""
        return larger * (12 * max(energy, 0.0) ** 0.5) ** 0.5

    # Photos that are looked at smaller than they are trained hide what is narrower than a pixel of theirs.
    threshold = _THRESHOLD * max(1.0, larger)
    strength = way(energy)
    error = way(max(energy, 0.0) + uncertain) - strength
    told = Told(
        "By the widths of edges, the camera or the object moves by {px:.2f} px, give or take {error:.2f} px, while "
        "photos are taken",
        px=strength,
        error=error,
    )
    level = float(np.median(found.level[known]))
    needed: bool | None = bool(strength >= threshold and energy >= _ERRORS * uncertain)
    if needed and energy**0.5 < _ONE_WAY * level:
        lens = "{told}, but edges are nearly as wide in all other directions, as by a lens."
        needed, reason = None, Told(lens, told=told)
    elif needed:
        reason = Told("{told}; from {least:g} px on that blurs the model.", told=told, least=threshold)
    elif way(energy + _SURELY_NOT * uncertain) < threshold:
        less = "{told}; less than {least:g} px is not told from what the object shows itself."
        needed, reason = False, Told(less, told=told, least=threshold)
    else:
        needed, reason = None, Told("{told}; that is too uncertain to say whether it matters.", told=told)
    return EffectFinding(_NAME, needed, strength, _UNIT, threshold, reason, error)


def _unknown(reason: Told) -> EffectFinding:
    return EffectFinding(_NAME, None, None, _UNIT, _THRESHOLD, reason)


@dataclass(frozen=True)
class MotionBlur:
    """A motion of the camera while the shutter is open, learnt for each photo with the splats.

    A photo is the mean light of views that are spread evenly over the motion, from half of it before the given pose to
    half of it after: turned about one axis at an even rate, moved straight. Forwards and backwards are the same photo.

    Attributes:
        start_px: motion at first, each photo's in a direction of its own. Without any there would be no gradient, for
            a photo does not tell forwards from backwards.
        rate: Adam's, in radians and in shares of the scene's extent.
        least_views: of a photo.
        most_views: of a photo; the time a step takes grows with them.
        spacing_px: more views than the least are drawn where splats would else move farther between two of them.
        warm_up: no number moves before this fraction of the iterations.
    """

    start_px: float = 1.0
    rate: Decay = Decay(4e-3, 4e-4)
    least_views: int = 5
    most_views: int = 9
    spacing_px: float = 1.0
    warm_up: float = 0.05

    name: ClassVar[str] = "motion_blur"
    order: ClassVar[int] = 0
    tries: ClassVar[int] = 1 + _DIRECTIONS
    fit_share: ClassVar[float] = 0.9

    def start(self, cameras: Sequence[Camera], extent: float) -> MotionImaging:
        """See `Effect.start`."""
        if not 2 <= self.least_views <= self.most_views:
            raise SettingError(
                "motion blur: {least} to {most} views a photo; choose 2 or more, and the least not above the most.",
                least=self.least_views,
                most=self.most_views,
            )
        for name in ("start_px", "spacing_px"):
            if not 0 < getattr(self, name) < math.inf:
                raise SettingError(
                    "motion blur: {name} is {value}; choose a number above 0.", name=name, value=getattr(self, name)
                )
        first = [_across(camera, place * _GOLDEN, self.start_px) for place, camera in enumerate(cameras)]
        numbers = torch.stack(first) if first else torch.zeros(0, 6)
        return MotionImaging(self, PhotoNumbers(numbers), list(cameras), extent)


class MotionImaging:
    """`MotionBlur` in use; a photo's numbers are a turn in radians and a shift in extents, in the camera's axes."""

    def __init__(self, settings: MotionBlur, numbers: PhotoNumbers, cameras: list[Camera], extent: float) -> None:
        self._settings, self._numbers, self._cameras, self._extent = settings, numbers, cameras, extent

    def render(self, photo: int, draw: Draw, gaussians: GaussianSet, camera: Camera, *per_splat: Tensor) -> SplatImage:
        """The mean of the views on the way; see `Imaging.render`. Colours are mixed as squares, light at a gamma of 2.
        A camera that stands still gives the image of `draw` itself."""
        if not torch.is_grad_enabled() and not bool(self._numbers.values[photo].any()):
            return draw(gaussians, camera, *per_splat)
        numbers = self._numbers.row(photo)
        with torch.no_grad():
            ends = self._poses(camera, numbers, torch.tensor([0.0, 1.0]))
        way = farthest_way(gaussians, [replace(camera, world_to_camera=pose.numpy()) for pose in ends])
        settings = self._settings
        count = min(max(math.ceil(way / settings.spacing_px), settings.least_views), settings.most_views)
        poses = self._poses(camera, numbers, (torch.arange(count, dtype=torch.float64) + 0.5) / count)
        whole = Band(camera, torch.arange(len(gaussians)))
        seen = draw_bands(draw, gaussians, [whole] * count, poses, *per_splat)
        shape = count, camera.height, camera.width
        light = seen.color.reshape(*shape, 3).square().mean(dim=0)
        alpha, depth = seen.alpha.reshape(shape), seen.depth.reshape(shape)
        shown = (alpha * depth).sum(dim=0) / alpha.sum(dim=0).clamp_min(_DARK)
        return SplatImage(light.clamp_min(_DARK**2).sqrt(), alpha.mean(dim=0), shown, seen.info)

    def _poses(self, camera: Camera, numbers: Tensor, times: Tensor) -> Tensor:
        still = torch.zeros(6, dtype=numbers.dtype)
        return row_poses(camera.world_to_camera, torch.cat([numbers, still]), times, self._extent)

    def penalty(self, photo: int) -> None:
        """None: hands shake any way."""

    def step(self, photo: int, fraction: float) -> None:
        """See `Imaging.step`."""
        if fraction < self._settings.warm_up:
            self._numbers.forget_gradients()
            return
        self._numbers.step(photo, [self._settings.rate.at(fraction)] * 6)

    def forget_gradients(self) -> None:
        """See `Imaging.forget_gradients`."""
        self._numbers.forget_gradients()

    def starts(self, draw: Draw, gaussians: GaussianSet, camera: Camera) -> list[Tensor]:
        """A camera that nearly stands still, and ones that move as far as the middle one of the others, in several
        directions."""
        values = self._numbers.values
        tries = [_across(camera, 0.0, 0.1)]
        if len(values):
            middle = values[values.norm(dim=1).argsort()[len(values) // 2]]
            tries += [_rolled(middle, index * math.pi / _DIRECTIONS) for index in range(_DIRECTIONS)]
        return tries

    def alone(self, camera: Camera, numbers: Tensor) -> MotionImaging:
        """See `Imaging.alone`."""
        at_once = replace(self._settings, warm_up=0.0)
        return MotionImaging(at_once, PhotoNumbers(numbers[None]), [camera], self._extent)

    def ends(self, photo: int) -> Tensor:
        """(2, 4, 4) world to camera when a photo's shutter opened and closed, or the other way round, float64."""
        return self._poses(self._cameras[photo], self._numbers.values[photo], torch.tensor([0.0, 1.0]))

    def report(self) -> dict[str, Any]:
        """(4, 4) world to camera of each photo at both ends of its motion, as lists; which was first is not told."""
        ends = [self.ends(photo).tolist() for photo in range(len(self._numbers))]
        return {"one_world_to_camera": [one for one, _ in ends], "other_world_to_camera": [other for _, other in ends]}

    def state(self) -> dict[str, Any]:
        """See `Imaging.state`."""
        return self._numbers.state()

    def restore(self, state: dict[str, Any]) -> None:
        """See `Imaging.restore`."""
        self._numbers.restore(state)


def _across(camera: Camera, direction: float, px: float) -> Tensor:
    """Numbers (6,) of a turn that moves the middle of an image by `px` along a direction in rad, from right to down."""
    turn = [-px * math.sin(direction) / camera.fy, px * math.cos(direction) / camera.fx]
    return torch.tensor([*turn, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)


def _rolled(numbers: Tensor, angle: float) -> Tensor:
    """The same motion (6,) along a direction that is turned about the viewing axis."""
    turned = numbers.clone()
    for first in (0, 3):
        x, y = float(numbers[first]), float(numbers[first + 1])
        turned[first] = math.cos(angle) * x - math.sin(angle) * y
        turned[first + 1] = math.sin(angle) * x + math.cos(angle) * y
    return turned
