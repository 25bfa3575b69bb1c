"""Photos whose exposure and white balance differ: each has a gain of its own for red, green and blue.

As in NeRF in the Wild (arXiv 2008.02268) each photo has an appearance of its own, here three numbers and no more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from ..errors import SettingError
from ..gaussians import GaussianSet
from ..render.splat import SplatImage
from ..train.schedule import Decay
from ..views import Camera
from .imaging import Draw
from .numbers import PhotoNumbers

# sRGB is nearly light to the power of 1 / 2.2: in it a gain of light is a factor, too, the 2.2nd root of it.
_GAMMA = 2.2


@dataclass(frozen=True)
class Exposure:
    """Colours times exp(a / 2.2), background and all, with three numbers a for each photo: log gains of light.

    Their mean over the photos stays 0, for no photo tells how bright the object is. What is brighter than white is
    white in the photo as well.

    Attributes:
        rate: Adam's, of a.
    """

    rate: Decay = Decay(0.02, 0.002)

    name: ClassVar[str] = "exposure"
    order: ClassVar[int] = 3

    def start(self, cameras: Sequence[Camera], extent: float) -> ExposureImaging:
        """See `Effect.start`."""
        if not self.rate.at(0.0) > 0:
            raise SettingError(f"exposure: rate {self.rate.at(0.0)} is not above 0; choose 0.02 or about that.")
        return ExposureImaging(self, PhotoNumbers(torch.zeros((len(cameras), 3))))


class ExposureImaging:
    """`Exposure` in use; a photo's numbers are log gains of red, green and blue light."""

    def __init__(self, settings: Exposure, numbers: PhotoNumbers) -> None:
        self._settings, self._numbers = settings, numbers

    def render(self, photo: int, draw: Draw, gaussians: GaussianSet, camera: Camera, *per_splat: Tensor) -> SplatImage:
        """The photo as bright as it is; see `Imaging.render`."""
        image = draw(gaussians, camera, *per_splat)
        factor = (self._numbers.row(photo) / _GAMMA).exp().to(image.color)
        return replace(image, color=(image.color * factor).clamp(max=1.0))

    def penalty(self, photo: int) -> None:
        """None: any exposure is as likely."""

    def step(self, photo: int, fraction: float) -> None:
        """See `Imaging.step`."""
        self._numbers.step(photo, [self._settings.rate.at(fraction)] * 3)
        if len(self._numbers) > 1:
            self._numbers.values -= self._numbers.values.mean(dim=0)

    def forget_gradients(self) -> None:
        """See `Imaging.forget_gradients`."""
        self._numbers.forget_gradients()

    def starts(self, draw: Draw, gaussians: GaussianSet, camera: Camera) -> list[Tensor]:
        """The mean of all photos."""
        return [torch.zeros(3)]

    def alone(self, camera: Camera, numbers: Tensor) -> ExposureImaging:
        """See `Imaging.alone`."""
        return ExposureImaging(self._settings, PhotoNumbers(numbers[None]))

    def report(self) -> dict[str, Any]:
        """Gains of red, green and blue light of each photo, whose product over the photos is 1."""
        return {"gain": self._numbers.values.exp().tolist()}

    def state(self) -> dict[str, Any]:
        """See `Imaging.state`."""
        return self._numbers.state()

    def restore(self, state: dict[str, Any]) -> None:
        """See `Imaging.restore`."""
        self._numbers.restore(state)
