"""Photos whose exposure and white balance differ: each has a gain of its own for red, green and blue.

As in NeRF in the Wild (arXiv 2008.02268) each photo has an appearance of its own, here three numbers and no more.
Whether photos differ is told by points that several of them show, else by a plain background.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from ..errors import SettingError
from ..gaussians import GaussianSet
from ..render.splat import SplatImage
from ..srgb import srgb_to_linear
from ..told import Told
from ..train.schedule import Decay
from ..views import Camera
from .finding import EffectFinding
from .imaging import Draw, Effect
from .look.colors import BRIGHTEST, DARKEST, Colors, View, of_borders, of_objects, of_points
from .look.gains import photo_levels
from .numbers import PhotoNumbers
from .photos import PhotoEvidence

# sRGB is nearly light to the power of 1 / 2.2: in it a gain of light is a factor, too, the 2.2nd root of it.
_GAMMA = 2.2
_NAME, _UNIT = "exposure", "%"
# Of light; 3 % of half of white is about 1 % of full scale, which alone would be 40 dB.
_THRESHOLD, _ERRORS, _SURELY_NOT = 3.0, 3.0, 2.0
_FEWEST_PHOTOS, _FEWEST_COLORS, _FEWEST_PARTS, _MOST_OF_THEM = 3, 20, 4, 0.5
# How much of what a background becomes brighter its object does: all where exposures differ, nothing where it is the
# background that does.
_ON_OBJECT = 0.5


def detect(evidence: PhotoEvidence) -> EffectFinding:
    """How much the photos' gains of red, green and blue light differ: their deviation over photos, in percent.

    Points that several photos see tell, where structure from motion left its tracks. Else a plain background does,
    where the objects of photos from nearly the same side follow it: one that is lit unevenly differs, too.
    """
    views = evidence.views
    fewest = max(_FEWEST_PHOTOS, _MOST_OF_THEM * len(views))
    if evidence.tracks is not None:
        gains = _gains(of_points(views, evidence.tracks), len(views), _FEWEST_COLORS)
        if _compared(gains) >= fewest:
            return _finding(Told("points that they share"), gains)
    gains = _gains(of_borders(views), len(views), _FEWEST_PARTS)
    if _compared(gains) < fewest:
        return _unknown(
            Told("The photos share neither points nor a plain background, neither black nor white, to compare.")
        )
    found = _finding(Told("their plain background"), gains)
    return _with_objects(found, np.where(np.isfinite(gains[1]), gains[0], np.nan), views) if found.found else found


def _gains(colors: Colors, photos: int, fewest: int) -> tuple[np.ndarray, np.ndarray]:
    """(photos, 3) log gains of light and their errors, infinite where fewer things than that can be compared."""
    found = []
    for light in colors.light.T:
        known = np.isfinite(light)
        known &= np.bincount(colors.photo[known], minlength=photos)[colors.photo] >= fewest
        found.append(photo_levels(colors.photo[known], colors.thing[known], light[known], photos))
    return np.stack([levels for levels, _ in found], axis=1), np.stack([errors for _, errors in found], axis=1)


def _compared(gains: tuple[np.ndarray, np.ndarray]) -> int:
    """How many photos have gains."""
    return int(np.isfinite(gains[1]).any(axis=1).sum())


def _finding(told_by: Told, gains: tuple[np.ndarray, np.ndarray]) -> EffectFinding:
    levels, errors = gains
    known = np.isfinite(errors)
    noise = float((errors[known] ** 2).mean())
    square = max(float((levels[known] ** 2).mean()) - noise, 0.0)
    # Of the square; the channels of a photo count as one.
    uncertain = ((2 * noise**2 + 4 * square * noise) / _compared(gains)) ** 0.5
    strength = 100 * square**0.5
    error = 100 * (square + uncertain) ** 0.5 - strength
    told = Told(
        "By {told_by} the photos' brightness and colors differ by {percent:.1f} %, give or take {error:.1f} %",
        told_by=told_by,
        percent=strength,
        error=error,
    )
    found: bool | None = bool(strength >= max(_THRESHOLD, _ERRORS * error))
    if found:
        reason = Told("{told}; from {least:g} % on that blurs the colors of the model.", told=told, least=_THRESHOLD)
    elif strength + _SURELY_NOT * error < _THRESHOLD:
        reason = Told("{told}; less than {least:g} % does no harm.", told=told, least=_THRESHOLD)
    else:
        found, reason = None, Told("{told}; that is too uncertain to say whether they matter.", told=told)
    return EffectFinding(_NAME, found, strength, _UNIT, _THRESHOLD, reason, error)


def _with_objects(found: EffectFinding, levels: np.ndarray, views: Sequence[View]) -> EffectFinding:
    """The finding where the objects become brighter with their backgrounds, whose `levels` (N, 3) are not numbers where
    they are not known; else what to think of it."""
    objects = of_objects(views)
    pairs = _neighbours([camera for _, camera in views])
    behind, before = (each[pairs[:, 0]] - each[pairs[:, 1]] for each in (levels, objects))
    known = np.isfinite(behind) & np.isfinite(before)
    share, error = _share(behind[known], before[known])
    # Nothing of it, or all of it, has to be ruled out.
    if share > _ON_OBJECT and share >= _ERRORS * error:
        return found
    if share < _ON_OBJECT and 1 - share >= _ERRORS * error:
        reason = Told(
            "The photos' plain backgrounds differ by {percent:.1f} %, but what stands before them does not follow: "
            "they are lit unevenly.",
            percent=found.strength,
        )
        return replace(found, found=False, strength=max(share, 0.0) * (found.strength or 0.0), reason=reason)
    reason = Told(
        "The photos' plain backgrounds differ by {percent:.1f} %, but photos from one side are too few to say whether "
        "the object does, too.",
        percent=found.strength,
    )
    return replace(found, found=None, reason=reason)


def _neighbours(cameras: Sequence[Camera]) -> np.ndarray:
    """(M, 2) every camera and the one that stands nearest to it, each pair once."""
    centers = np.array([camera.center for camera in cameras])
    apart = np.linalg.norm(centers[:, None] - centers, axis=2) + np.diag(np.full(len(centers), np.inf))
    pairs = np.stack([np.arange(len(centers)), apart.argmin(axis=1)], axis=1)
    return np.unique(np.sort(pairs, axis=1), axis=0)


def _share(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """The slope of y over x through 0 and its error; the three channels of a photo count as one."""
    count, squares = len(x) / 3, float((x**2).sum())
    if count <= 1 or not squares > 0:
        return 0.0, np.inf
    slope = float((x * y).sum()) / squares
    return slope, float(np.sqrt(((y - slope * x) ** 2).sum() / (count - 1) / squares))


def _unknown(reason: Told) -> EffectFinding:
    return EffectFinding(_NAME, None, None, _UNIT, _THRESHOLD, reason)


@dataclass(frozen=True)
class Exposure:
    """Colours times exp(a / 2.2), a photographed background's, too, with three numbers a for each photo: log gains of
    light.

    Their mean over the photos stays 0, for no photo tells how bright the object is; before a plain background, neither
    black nor white, its colour does. What is brighter than white is white in the photo as well.

    Attributes:
        rate: Adam's, of a.
        behind: a colour in 0..1 that was put behind objects which were cut out: no camera exposed it. None where what
            is behind them was photographed.
        plain: what was photographed behind them is one colour, neither black nor white, which the model is drawn
            before.
    """

    rate: Decay = Decay(0.02, 0.002)
    behind: tuple[float, float, float] | None = None
    plain: bool = False

    name: ClassVar[str] = "exposure"
    order: ClassVar[int] = 3
    tries: ClassVar[int] = 1
    fit_share: ClassVar[float] = 0.45

    def start(self, cameras: Sequence[Camera], extent: float) -> ExposureImaging:
        """See `Effect.start`."""
        if not self.rate.at(0.0) > 0:
            raise SettingError(
                "exposure: rate {rate} is not above 0; choose 0.02 or about that.", rate=self.rate.at(0.0)
            )
        return ExposureImaging(self, PhotoNumbers(torch.zeros((len(cameras), 3))))


class ExposureImaging:
    """`Exposure` in use; a photo's numbers are log gains of red, green and blue light."""

    def __init__(self, settings: Exposure, numbers: PhotoNumbers) -> None:
        self._settings, self._numbers = settings, numbers

    def render(self, photo: int, draw: Draw, gaussians: GaussianSet, camera: Camera, *per_splat: Tensor) -> SplatImage:
        """The photo as bright as it is; see `Imaging.render`."""
        image = draw(gaussians, camera, *per_splat)
        factor = (self._numbers.row(photo) / _GAMMA).exp().to(image.color)
        color = image.color * factor
        if self._settings.behind is not None:
            put = (1 - image.alpha)[..., None] * torch.tensor(self._settings.behind).to(image.color)
            color = color + (1 - factor) * put
        return replace(image, color=color.clamp(max=1.0))

    def penalty(self, photo: int) -> None:
        """None: any exposure is as likely."""

    def step(self, photo: int, fraction: float) -> None:
        """See `Imaging.step`."""
        self._numbers.step(photo, [self._settings.rate.at(fraction)] * 3)
        if len(self._numbers) > 1 and not self._settings.plain:
            self._numbers.values -= self._numbers.values.mean(dim=0)

    def forget_gradients(self) -> None:
        """See `Imaging.forget_gradients`."""
        self._numbers.forget_gradients()

    def starts(self, draw: Draw, gaussians: GaussianSet, camera: Camera) -> list[Tensor]:
        """The plain background's, or the mean of all photos."""
        return [torch.zeros(3)]

    def alone(self, camera: Camera, numbers: Tensor) -> ExposureImaging:
        """See `Imaging.alone`."""
        return ExposureImaging(self._settings, PhotoNumbers(numbers[None]))

    def report(self) -> dict[str, Any]:
        """Gains of red, green and blue light of each photo, over the background's where that is plain; elsewhere their
        product is 1."""
        return {"gain": self._numbers.values.exp().tolist()}

    def state(self) -> dict[str, Any]:
        """See `Imaging.state`."""
        return {**self._numbers.state(), "behind": self._settings.behind}

    def restore(self, state: dict[str, Any]) -> None:
        """See `Imaging.restore`."""
        self._numbers.restore(state)
        # Older versions took what was put behind objects for photographed.
        self._settings = replace(self._settings, behind=state.get("behind"))


def before(effects: Sequence[Effect], background: np.ndarray | None, is_put: bool) -> tuple[Effect, ...]:
    """The effects of photos before a plain background (3,), photographed or put behind objects that were cut out; as
    they are without one."""
    if background is None:
        return tuple(effects)
    red, green, blue = (float(value) for value in background)
    light = srgb_to_linear(np.asarray(background))
    # Black is as black in any exposure, and what is cut off at white as white.
    told = bool((light >= DARKEST).all() and (light <= BRIGHTEST).all())
    known: dict[str, Any] = {"behind": (red, green, blue)} if is_put else {"plain": told}
    return tuple(replace(one, **known) if isinstance(one, Exposure) else one for one in effects)
