"""Photos read out row by row while the camera moves: two poses a photo (RS-NeRF, arXiv 2407.10267).

Whether cameras moved is told by sparse points that are seen above or below, left or right of where they should be, the
more so the farther from the middle row.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
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
from .bands import Band, draw_bands, members
from .finding import EffectFinding
from .imaging import Draw
from .look.readout import Motions, chosen, motions
from .numbers import PhotoNumbers
from .paths import MOTION, farthest_way, row_poses
from .photos import PhotoEvidence

_NAME, _UNIT = "rolling_shutter", "px"
# Between the first row and the last; what photos are shifted by is a quarter of it on average. A shift by d changes an
# image of edges of height 0.3, in a tenth of its pixels, by 0.009 d in mean square: 29.5 dB.
_THRESHOLD, _ERRORS, _SURELY_NOT, _CHANCE = 0.5, 3.0, 2.0, 1e-4
# Points 0.5 px off leave 0.12 px of error to a photo of 200, and 0.3 px to one of 30.
_FEWEST_POINTS, _FEWEST_PHOTOS, _MOST_OF_THEM = 30, 3, 0.5
# How many times as much a readout by rows has to explain as one by columns, which fits whatever else is not right.
_TIMES = 2.0
# Evenly over the rows, the time of a readout has a variance of 1 / 12.
_EVENLY = 12.0


def detect(evidence: PhotoEvidence) -> EffectFinding:
    """How many pixels of training points move between the first row of a photo and the last, as far as the photos' own
    poses have not taken it up; the median over photos.

    Counts from what points of structure from motion are off by, less what a readout of columns would explain of it.
    """
    if evidence.tracks is None or any(camera.orthographic for camera in evidence.cameras):
        return _unknown(
            Told("No points of structure from motion tell whether cameras moved while photos were read out.")
        )
    photos = len(evidence.cameras)
    tracks = chosen(evidence.tracks, photos, _FEWEST_POINTS)
    seen = np.bincount(tracks.photo, minlength=photos) > 0
    if seen.sum() < max(_FEWEST_PHOTOS, _MOST_OF_THEM * photos):
        few = "Too few photos share {points} points to say whether cameras moved while rows were read out."
        return _unknown(Told(few, points=_FEWEST_POINTS))
    evidence.tick()
    return _finding(motions(evidence.cameras, tracks), seen)


def _finding(found: Motions, seen: np.ndarray) -> EffectFinding:
    square, uncertain = _median(_EVENLY * (found.square - found.across)[seen])
    strength, most = max(square, 0.0) ** 0.5, max(square + _SURELY_NOT * uncertain, 0.0) ** 0.5
    error = (max(square, 0.0) + uncertain) ** 0.5 - strength
    told = Told(
        "Between the first row of a photo and the last, points move by {px:.2f} px, give or take {error:.2f} px",
        px=strength,
        error=error,
    )
    sure = square >= _ERRORS * uncertain and found.chance < _CHANCE and found.by_rows >= _TIMES * found.by_columns
    needed: bool | None = bool(strength >= _THRESHOLD and sure)
    if needed:
        why = "{told}: the camera moved while rows were read out; from {least:g} px on that blurs the model."
        reason = Told(why, told=told, least=_THRESHOLD)
    elif most < _THRESHOLD and -square < _THRESHOLD**2:
        reason = Told("{told}; less than {least:g} px does no harm.", told=told, least=_THRESHOLD)
    elif found.by_columns >= _TIMES * found.by_rows and found.chance_across < _CHANCE:
        needed = None
        reason = Told(
            "The camera moved while photos were read out column by column, as if held upright; only rows are learned."
        )
    else:
        needed, reason = None, Told("{told}; that is too uncertain to say whether it matters.", told=told)
    return EffectFinding(_NAME, needed, strength, _UNIT, _THRESHOLD, reason, error)


def _median(values: np.ndarray) -> tuple[float, float]:
    """Of normal values with a few that are not, and its standard error."""
    middle = float(np.median(values))
    spread = 1.4826 * float(np.median(np.abs(values - middle)))
    return middle, float(np.sqrt(np.pi / 2)) * spread / len(values) ** 0.5


def _unknown(reason: Told) -> EffectFinding:
    return EffectFinding(_NAME, None, None, _UNIT, _THRESHOLD, reason)


@dataclass(frozen=True)
class RollingShutter:
    """A pose at the start and at the end of the readout of each photo, learnt with the splats.

    Row j of H is seen at t = j / (H − 1) from the pose between the two, rotations slerped and positions lerped. The
    numbers are the motion from start to end and the change of the pose in the middle, which is the given one at
    first. Images are drawn in bands of rows with one pose each.

    Attributes:
        motion_rate: Adam's, of the motion in radians and in shares of the scene's extent.
        middle_rate: Adam's, of the middle pose; 0 keeps the given one.
        smoothness: weight of the squared difference of the motions of neighbours in capture order, in shares of
            the image's width.
        tolerance_px: bands are so low that none of their rows is farther than this from where it belongs.
        least_bands: while motions are learnt; without bands a camera that stands still would never start to move.
        warm_up: no number moves before this fraction of the iterations.
    """

    motion_rate: Decay = Decay(2e-3, 2e-4)
    middle_rate: Decay = Decay(0.0)
    smoothness: float = 0.01
    tolerance_px: float = 0.1
    least_bands: int = 8
    warm_up: float = 0.05

    name: ClassVar[str] = "rolling_shutter"
    order: ClassVar[int] = 0
    tries: ClassVar[int] = 2
    fit_share: ClassVar[float] = 1.1

    def start(self, cameras: Sequence[Camera], extent: float) -> ShutterImaging:
        """See `Effect.start`."""
        if not self.tolerance_px > 0:
            raise SettingError(
                "rolling shutter: a tolerance of {tolerance} pixels; choose more than 0.", tolerance=self.tolerance_px
            )
        return ShutterImaging(self, PhotoNumbers(torch.zeros(len(cameras), 12)), list(cameras), extent)


class ShutterImaging:
    """`RollingShutter` in use."""

    def __init__(self, settings: RollingShutter, numbers: PhotoNumbers, cameras: list[Camera], extent: float) -> None:
        self._settings, self._numbers, self._cameras, self._extent = settings, numbers, cameras, extent

    def render(self, photo: int, draw: Draw, gaussians: GaussianSet, camera: Camera, *per_splat: Tensor) -> SplatImage:
        """The photo row by row; see `Imaging.render`. A camera that stands still gives the image of `draw` itself."""
        still = not bool(self._numbers.values[photo].any())
        learns = torch.is_grad_enabled()
        if still and not learns:
            return draw(gaussians, camera, *per_splat)
        numbers = self._numbers.row(photo)
        with torch.no_grad():
            ends = row_poses(camera.world_to_camera, numbers, torch.tensor([0.0, 1.0]), self._extent)
        cameras = [replace(camera, world_to_camera=pose.numpy()) for pose in ends]
        count = math.ceil(0.5 * farthest_way(gaussians, cameras) / self._settings.tolerance_px)
        count = min(max(count, self._settings.least_bands if learns else 1), camera.height)
        edges = [int(edge) for edge in np.linspace(0, camera.height, count + 1).round()]
        middles = torch.tensor([0.5 * (first + stop - 1) for first, stop in pairwise(edges)], dtype=torch.float64)
        times = middles / max(camera.height - 1, 1) if camera.height > 1 else torch.tensor([0.5])
        poses = row_poses(camera.world_to_camera, numbers, times, self._extent)
        found = members(gaussians, cameras, edges)
        bands = [Band(camera.rows(*rows), which) for rows, which in zip(pairwise(edges), found, strict=True)]
        return draw_bands(draw, gaussians, bands, poses, *per_splat)

    def penalty(self, photo: int) -> Tensor | None:
        """How much the motion differs from the neighbours', which this step leaves as they are."""
        beside = [other for other in (photo - 1, photo + 1) if 0 <= other < len(self._numbers)]
        if self._settings.smoothness <= 0 or not beside:
            return None
        camera = self._cameras[photo]
        differences = self._numbers.row(photo)[MOTION] - self._numbers.values[beside][:, MOTION]
        return self._settings.smoothness * (differences * (camera.fx / camera.width)).square().sum(1).mean().float()

    def step(self, photo: int, fraction: float) -> None:
        """See `Imaging.step`."""
        if fraction < self._settings.warm_up:
            self._numbers.forget_gradients()
            return
        motion, middle = self._settings.motion_rate.at(fraction), self._settings.middle_rate.at(fraction)
        self._numbers.step(photo, [motion] * 6 + [middle] * 6)

    def forget_gradients(self) -> None:
        """See `Imaging.forget_gradients`."""
        self._numbers.forget_gradients()

    def starts(self, draw: Draw, gaussians: GaussianSet, camera: Camera) -> list[Tensor]:
        """A camera that stands still, and one that moves as the others do on average."""
        return [torch.zeros(12, dtype=torch.float64), self._numbers.values.mean(dim=0)]

    def alone(self, camera: Camera, numbers: Tensor) -> ShutterImaging:
        """See `Imaging.alone`."""
        at_once = replace(self._settings, warm_up=0.0)
        return ShutterImaging(at_once, PhotoNumbers(numbers[None]), [camera], self._extent)

    def ends(self, photo: int) -> Tensor:
        """(2, 4, 4) world to camera at the start and at the end of a photo's readout, float64."""
        values = self._numbers.values[photo]
        return row_poses(self._cameras[photo].world_to_camera, values, torch.tensor([0.0, 1.0]), self._extent)

    def report(self) -> dict[str, Any]:
        """(4, 4) world to camera of each photo at the start and at the end of its readout, as lists."""
        ends = [self.ends(photo).tolist() for photo in range(len(self._numbers))]
        return {"start_world_to_camera": [start for start, _ in ends], "end_world_to_camera": [end for _, end in ends]}

    def state(self) -> dict[str, Any]:
        """See `Imaging.state`."""
        return self._numbers.state()

    def restore(self, state: dict[str, Any]) -> None:
        """See `Imaging.restore`."""
        self._numbers.restore(state)
