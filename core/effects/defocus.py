"""Photos with a shallow depth of field: every photo has an aperture and a focus (DoF-Gaussian, arXiv 2503.00746).

Whether photos have it is told by edges, which are the wider the farther they are from a depth that is sharp.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ..errors import SettingError
from ..gaussians import GaussianSet
from ..render.splat import SplatImage
from ..told import Told
from ..train.schedule import Decay
from ..views import Camera
from .blur import scatter_blur
from .finding import EffectFinding
from .imaging import Draw
from .look.focus import Bends, bends
from .numbers import PhotoNumbers
from .photos import PhotoEvidence

# DoF-Gaussian measures apertures in tenths of a pixel's circle at a difference in disparity of 1.
_TENTHS = 10.0
_TRIED_FOCUSES = 7
# A lens that photos open ever wider stays a number.
_MOST_LOG_APERTURE = 30.0

_NAME, _UNIT = "defocus", "px"
# A disc of radius r is as wide as a Gaussian of r / 2. Where sharp edges of height 0.3, in a tenth of all pixels, are
# blurred by that, an image changes by 0.0011 r in mean square: 30 dB at 1 px.
_THRESHOLD, _ERRORS, _SURELY_NOT = 1.0, 3.0, 2.0
_FEWEST_EDGES, _FEWEST_PHOTOS, _MOST_OF_THEM, _FEWEST_POINTS = 100, 3, 0.5, 10
# Half of the range of nearness over nearness: depths that differ by less are all as sharp.
_FLAT = 0.01
# How much of a bend may be of one direction: a lens blurs in all alike.
_ONE_WAY = 0.5
# The focus in halves of the range of nearness from the middle: farther off it cannot be told from a slope.
_FARTHEST = 1.5


def detect(evidence: PhotoEvidence) -> EffectFinding:
    """The radius of circles of confusion in pixels of training: their root mean square over what a photo shows, the
    median over photos.

    Counts from how squared widths of edges bend with inverse depth, beside edges of the same place in other photos.
    """
    points, photos = evidence.points, len(evidence.cameras)
    if len(points) < _FEWEST_POINTS or any(camera.orthographic for camera in evidence.cameras):
        return _unknown(Told("There are no points of the object to tell how far away the edges in photos are."))
    found = bends(evidence.sharpness, photos, _FEWEST_EDGES)
    known = np.isfinite(found.error)
    if known.sum() < max(_FEWEST_PHOTOS, _MOST_OF_THEM * photos):
        few = "Too few photos show {edges} edges of the object to say whether some are out of focus."
        return _unknown(Told(few, edges=_FEWEST_EDGES))
    if found.half < _FLAT:
        return _unknown(Told("What photos show is all about as far away, so that its focus cannot be told."))
    return _finding(found, known, evidence.pixels_of_training)


def _finding(found: Bends, known: np.ndarray, larger: float) -> EffectFinding:
    """Of the photos that are `known` (N,); `larger` is how many pixels of training one of theirs is."""
    bend, error = _median(found.bend[known, 0], found.error[known])
    one_way = float(np.hypot(*np.median(found.bend[known, 1:], axis=0)))

    def radius(bend: float) -> float:
        """With what photos have in common for an aperture, and a focus each."""
        focus = np.clip(-found.slope[known] / (2 * max(bend, 1e-9)), -_FARTHEST, _FARTHEST)
        return larger * float(np.median(2 * np.sqrt(max(bend, 0.0) * (found.spread[known] ** 2 + focus**2))))

    strength = radius(bend) if bend > error else 0.0
    surely_less = radius(max(bend, 0.0) + _SURELY_NOT * error)
    uncertain = 0.5 * strength * error / bend if bend > error else surely_less / _SURELY_NOT
    told = Told(
        "By the widths of edges, photos are out of focus by {px:.2f} px, give or take {error:.2f} px",
        px=strength,
        error=uncertain,
    )
    needed: bool | None = bool(strength >= _THRESHOLD and bend >= _ERRORS * error)
    if needed and one_way > _ONE_WAY * bend:
        needed, reason = None, Told("{told}, but most of it in one direction, as by motion.", told=told)
    elif needed:
        reason = Told("{told}; from {least:g} px on that blurs the model.", told=told, least=_THRESHOLD)
    elif strength + _SURELY_NOT * uncertain < _THRESHOLD:
        needed, reason = False, Told("{told}; less than {least:g} px does no harm.", told=told, least=_THRESHOLD)
    else:
        needed, reason = None, Told("{told}; that is too uncertain to say whether it matters.", told=told)
    return EffectFinding(_NAME, needed, strength, _UNIT, _THRESHOLD, reason, uncertain)


def _median(values: np.ndarray, errors: np.ndarray) -> tuple[float, float]:
    """And its standard error: by how the values differ, or by their own errors, whichever is more."""
    middle = float(np.median(values))
    spread = max(1.4826 * float(np.median(np.abs(values - middle))), float(np.median(errors)))
    return middle, float(np.sqrt(np.pi / 2)) * spread / len(values) ** 0.5


def _unknown(reason: Told) -> EffectFinding:
    return EffectFinding(_NAME, None, None, _UNIT, _THRESHOLD, reason)


@dataclass(frozen=True)
class Defocus:
    """Circles of confusion of radius 10·K·|disparity − focus| pixels, K and focus learnt for each photo.

    Disparity is the scene's extent divided by depth, so that neither number has a unit of length. A thin lens of
    radius R is K = focal length in pixels · R / (10 · extent).

    Attributes:
        start_radius_px: circles that a photo of full size starts with, of what lies one standard deviation of its
            disparity from the focus, which is the mean at first; 0 is a pinhole and stays one. With circles much
            smaller than the true ones splats grow as blurred as the photos before the apertures open.
        aperture_rate: Adam's, of log K.
        focus_rate: Adam's, of the focus in standard deviations of the disparity.
        warm_up: no number moves before this fraction of the iterations: while splats are still too large the
            photos look too sharp for any lens.
        most_radius_px: larger circles are cut to this; the time that blurring takes grows with its square.
    """

    start_radius_px: float = 2.0
    aperture_rate: Decay = Decay(0.1, 0.01)
    focus_rate: Decay = Decay(0.2, 0.02)
    warm_up: float = 0.1
    most_radius_px: float = 16.0

    name: ClassVar[str] = "defocus"
    order: ClassVar[int] = 1
    # The first shows how deep the photo is.
    tries: ClassVar[int] = 1 + _TRIED_FOCUSES
    fit_share: ClassVar[float] = 0.6

    def start(self, cameras: Sequence[Camera], extent: float) -> LensImaging:
        """See `Effect.start`."""
        if not self.start_radius_px >= 0:
            raise SettingError(
                "defocus: start_radius_px {radius} is below 0; choose 0 (a pinhole) or more.",
                radius=self.start_radius_px,
            )
        if not self.most_radius_px > 0:
            raise SettingError(
                "defocus: most_radius_px {radius} is not above 0; choose 1 or more.", radius=self.most_radius_px
            )
        # Not numbers until a photo has been looked at.
        numbers = torch.full((len(cameras), 3), torch.nan)
        return LensImaging(self, PhotoNumbers(numbers), [camera.width for camera in cameras], extent)


class LensImaging:
    """`Defocus` in use; a photo's numbers are log K for its full width, the focus and the disparity's deviation."""

    def __init__(self, settings: Defocus, numbers: PhotoNumbers, widths: list[int], extent: float) -> None:
        self._settings, self._numbers, self._widths, self._extent = settings, numbers, widths, extent

    def render(self, photo: int, draw: Draw, gaussians: GaussianSet, camera: Camera, *per_splat: Tensor) -> SplatImage:
        """The photo in focus where it is; see `Imaging.render`. Depth is that of the sharp image."""
        sharp = draw(gaussians, camera, *per_splat)
        if self._settings.start_radius_px == 0:
            return sharp
        if not bool(torch.isfinite(self._numbers.values[photo]).all()):
            first = self._first(sharp)
            if first is None:
                return sharp
            self._numbers.set_row(photo, first)
        disparity = disparity_image(sharp.depth, sharp.alpha, self._extent, self._settings.most_radius_px)
        log_aperture, focus, _ = self._numbers.row(photo).to(disparity).unbind()
        aperture = log_aperture.clamp(max=_MOST_LOG_APERTURE).exp() * (camera.width / self._widths[photo])
        radii = circles(disparity, aperture, focus, self._settings.most_radius_px)
        color, alpha = scatter_blur(sharp.color, sharp.alpha, radii)
        return replace(sharp, color=color, alpha=alpha)

    def _first(self, sharp: SplatImage) -> Tensor | None:
        """Numbers (3,) to start from, of a photo's sharp image; None for an empty one."""
        seen = _disparities(sharp, self._extent)
        if len(seen) == 0:
            return None
        mean = seen.mean()
        # What is flat has no deviation, and nothing to tell apertures by: circles are then those of 1 % of its depth.
        spread = (seen - mean).square().mean().sqrt().clamp_min(float(0.01 * mean))
        return torch.stack([(self._settings.start_radius_px / (_TENTHS * spread)).log(), mean, spread])

    def penalty(self, photo: int) -> None:
        """None: nothing is known of lenses beforehand."""

    def step(self, photo: int, fraction: float) -> None:
        """See `Imaging.step`."""
        if fraction < self._settings.warm_up:
            self._numbers.forget_gradients()
            return
        spread = float(self._numbers.values[photo, 2])
        rates = self._settings.aperture_rate.at(fraction), self._settings.focus_rate.at(fraction) * spread, 0.0
        self._numbers.step(photo, rates)

    def forget_gradients(self) -> None:
        """See `Imaging.forget_gradients`."""
        self._numbers.forget_gradients()

    def starts(self, draw: Draw, gaussians: GaussianSet, camera: Camera) -> list[Tensor]:
        """The middle aperture of the photos with focuses from the farthest to the nearest that is seen."""
        image = draw(gaussians, camera)
        first = self._first(image)
        if first is None:
            return [torch.full((3,), torch.nan)]
        values, widths = self._numbers.values, torch.tensor(self._widths)
        shown = values.isfinite().all(dim=1)
        if bool(shown.any()):
            first[0] = (values[shown, 0] - widths[shown].log()).median() + math.log(camera.width)
        seen = _disparities(image, self._extent).sort().values
        places = torch.linspace(0.02, 0.98, _TRIED_FOCUSES) * (len(seen) - 1)
        return [torch.stack([first[0], seen[place], first[2]]) for place in places.round().long()]

    def alone(self, camera: Camera, numbers: Tensor) -> LensImaging:
        """See `Imaging.alone`."""
        at_once = replace(self._settings, warm_up=0.0)
        return LensImaging(at_once, PhotoNumbers(numbers[None]), [camera.width], self._extent)

    def report(self) -> dict[str, Any]:
        """K in tenths of a pixel at full width and focus disparity of each photo; null where it was not shown."""
        known = self._numbers.values.isfinite().all(dim=1).tolist()
        rows = [row if shown else [None, None] for row, shown in zip(self._numbers.values.tolist(), known, strict=True)]
        return {
            "aperture_tenths_px": [None if row[0] is None else math.exp(row[0]) for row in rows],
            "focus_disparity": [row[1] for row in rows],
        }

    def state(self) -> dict[str, Any]:
        """See `Imaging.state`."""
        return self._numbers.state()

    def restore(self, state: dict[str, Any]) -> None:
        """See `Imaging.restore`."""
        self._numbers.restore(state)


def circles(disparity: Tensor, aperture: Tensor, focus: Tensor, most_px: float) -> Tensor:
    """(H, W) radii in pixels of circles of confusion, 10·K·|disparity − focus|, at most `most_px`."""
    return (_TENTHS * aperture * (disparity - focus)).abs().clamp(max=most_px)


def disparity_image(depth: Tensor, alpha: Tensor, extent: float, reach_px: float) -> Tensor:
    """(H, W) extent / depth; where an image is clear, that of the covered pixels around.

    The scatter weight knows no background behind an object: with a disparity of its own (of 0, say) it would be
    spread over the object's rim as if it stood in front. With that of the object nearby it takes part in the
    object's blur like paper that the object is painted on.

    Args:
        depth: (H, W) camera z, 0 where nothing is.
        alpha: (H, W) coverage 0..1.
        reach_px: how far around; farther off it is the image's mean.
    """
    known = depth > 0
    own = torch.where(known, extent / torch.where(known, depth, 1.0), 0.0)
    weight = torch.where(known, alpha.detach(), 0.0)
    with torch.no_grad():
        around = _box_mean(torch.stack([weight * own, weight]), int(reach_px))
        filled = torch.where(around[1] > 1e-6, around[0] / around[1].clamp_min(1e-6), mean_disparity(own, weight))
    return weight * own + (1 - weight) * filled


def _disparities(image: SplatImage, extent: float) -> Tensor:
    """(M,) disparities in float64 of the pixels that are covered rather than not."""
    return extent / image.depth.detach()[(image.alpha > 0.5) & (image.depth > 0)].double()


def mean_disparity(disparity: Tensor, alpha: Tensor) -> Tensor:
    """The mean of an image, weighted by coverage; 0, infinity, for an empty one."""
    covered = alpha.sum()
    return torch.where(covered > 0, (alpha * disparity).sum() / torch.where(covered > 0, covered, 1.0), 0.0)


def _box_mean(images: Tensor, half: int) -> Tensor:
    """(C, H, W) means over squares of 2·half + 1 pixels, of what lies within the image."""
    rows = avg_pool2d(images[None], (2 * half + 1, 1), 1, (half, 0), count_include_pad=False)
    return avg_pool2d(rows, (1, 2 * half + 1), 1, (0, half), count_include_pad=False)[0]
