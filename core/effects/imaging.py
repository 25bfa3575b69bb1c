"""What effects have in common: how they draw, learn, are kept in a checkpoint, and are fitted to a new photo."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Protocol

import numpy as np
import torch
from torch import Tensor

from ..effect_names import NOT_TOGETHER
from ..errors import SettingError
from ..gaussians import GaussianSet
from ..progress import Tick, unstopped
from ..render.splat import SplatImage
from ..train.losses import image_loss
from ..views import Camera

_STRUCTURE_WEIGHT = 0.2
FIT_STEPS = 40
"""In which the numbers of a photo that was not trained on are fitted to it."""


Draw = Callable[..., SplatImage]
"""(torch set, camera, *per_splat) -> image: `splat` with all other options chosen. `per_splat` are more tensors with a
row for each splat, for options of a renderer that need them."""


class Effect(Protocol):
    """Settings of an effect, frozen.

    Attributes:
        name: as in reports and checkpoints.
        order: effects with a smaller number lie nearer to the splats.
        tries: at most so many images are drawn to choose what numbers of another photo begin with (`Imaging.starts`).
        fit_share: of a training step with the effect, what a step of fitting its numbers to another photo takes; less
            where nothing is sent back through the splats. Measured on matryoshkas of 96 x 128 pixels that have it.
    """

    name: ClassVar[str]
    order: ClassVar[int]
    tries: ClassVar[int]
    fit_share: ClassVar[float]

    def start(self, cameras: Sequence[Camera], extent: float) -> Imaging:
        """Numbers for photos in capture order.

        Args:
            cameras: of each photo, at full size.
            extent: radius of the scene in the cameras' unit.

        Raises:
            SettingError: a setting is out of range.
        """


class Imaging(Protocol):
    """An effect in use: its numbers for each photo."""

    def render(self, photo: int, draw: Draw, gaussians: GaussianSet, camera: Camera, *per_splat: Tensor) -> SplatImage:
        """The photo with the effect; differentiable in the splats and in the photo's own numbers."""

    def penalty(self, photo: int) -> Tensor | None:
        """What is added to the loss of a photo."""

    def step(self, photo: int, fraction: float) -> None:
        """Moves a photo's numbers down the gradients gathered, at a fraction 0..1 of the iterations."""

    def forget_gradients(self) -> None:
        """Drops gradients of a step that is not made."""

    def starts(self, draw: Draw, gaussians: GaussianSet, camera: Camera) -> list[Tensor]:
        """Numbers (K,) worth trying first for a photo that was not trained on."""

    def alone(self, camera: Camera, numbers: Tensor) -> Imaging:
        """The effect for one other photo, with numbers (K,) to start from."""

    def report(self) -> dict[str, Any]:
        """The numbers of all photos with their units in their names."""

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""

    def restore(self, state: dict[str, Any]) -> None:
        """Becomes what `state()` was taken of, bit for bit."""


class PhotoEffects:
    """The effects of one training, each drawing upon the one before.

    Args:
        effects: settings, at least one.
        cameras: of the training photos in capture order, at full size.
        extent: radius of the scene in the cameras' unit.

    Attributes:
        extent: the same.

    Raises:
        SettingError: an effect is chosen twice, two cannot be learned at once, or a setting is out of range.
    """

    def __init__(self, effects: Sequence[Effect], cameras: Sequence[Camera], extent: float) -> None:
        ordered = sorted(effects, key=lambda effect: effect.order)
        names = [effect.name for effect in ordered]
        if len(set(names)) < len(names):
            raise SettingError("effects: {names} were chosen; choose each at most once.", names=", ".join(names))
        for one, other in sorted(NOT_TOGETHER):
            if {one, other} <= set(names):
                raise SettingError(
                    "effects: {one} and {other} cannot be learned at once; choose one of them.", one=one, other=other
                )
        self.extent = extent
        self._parts: dict[str, Imaging] = {effect.name: effect.start(cameras, extent) for effect in ordered}

    def render(self, photo: int, draw: Draw, gaussians: GaussianSet, camera: Camera, *per_splat: Tensor) -> SplatImage:
        """A training photo as its camera saw it; arguments as of `Imaging.render`."""
        return _chained(draw, [(part, photo) for part in self._parts.values()])(gaussians, camera, *per_splat)

    def penalty(self, photo: int) -> Tensor | float:
        """The sum of the effects' own terms in the loss of a photo."""
        terms = [part.penalty(photo) for part in self._parts.values()]
        return sum((term for term in terms if term is not None), 0.0)

    def step(self, photo: int, fraction: float) -> None:
        """One step of a photo's numbers."""
        for part in self._parts.values():
            part.step(photo, fraction)

    def forget_gradients(self) -> None:
        """The step is not made."""
        for part in self._parts.values():
            part.forget_gradients()

    def fitted(
        self,
        draw: Draw,
        gaussians: GaussianSet,
        camera: Camera,
        target: Tensor,
        steps: int = FIT_STEPS,
        tick: Tick = unstopped,
    ) -> SplatImage:
        """A photo that was not trained on, with its own few numbers fitted to it and the splats as they are.

        A held-out photo has an aperture, a focus or a motion of its own that no other photo tells: those numbers
        alone are fitted, and what it shows of the object stays a prediction. Effects that were not trained can be
        fitted too: they start from their settings.

        Args:
            gaussians: torch set, without gradients.
            target: (H, W, 3) the photo.
            tick: called between steps; may raise to stop.
        """
        chain: list[tuple[Imaging, int]] = []
        for part in self._parts.values():
            below = _chained(draw, chain)
            with torch.no_grad():
                tries = [part.alone(camera, numbers) for numbers in part.starts(below, gaussians, camera)]
                losses = [_loss(one.render(0, below, gaussians, camera), target) for one in tries]
            # What is not a number is never the least.
            best = int(np.argmin([np.nan_to_num(float(loss), nan=np.inf) for loss in losses]))
            chain.append((tries[best], 0))
        whole = _chained(draw, chain)
        with torch.enable_grad():
            for step in range(steps):
                tick()
                loss = _loss(whole(gaussians, camera), target)
                if loss.requires_grad:
                    loss.backward()
                for part, _ in chain:
                    part.step(0, step / steps)
        with torch.no_grad():
            return whole(gaussians, camera)

    def report(self) -> dict[str, Any]:
        """The numbers of all photos by the effects' names."""
        return {name: part.report() for name, part in self._parts.items()}

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {name: part.state() for name, part in self._parts.items()}

    def restore(self, state: dict[str, Any]) -> None:
        """From a checkpoint. Raises KeyError for one without these effects."""
        for name, part in self._parts.items():
            part.restore(state[name])


def _chained(draw: Draw, chain: Sequence[tuple[Imaging, int]]) -> Draw:
    for part, photo in chain:
        draw = _upon(part, photo, draw)
    return draw


def _upon(part: Imaging, photo: int, below: Draw) -> Draw:
    def render(gaussians: GaussianSet, camera: Camera, *per_splat: Tensor) -> SplatImage:
        return part.render(photo, below, gaussians, camera, *per_splat)

    return render


def _loss(image: SplatImage, target: Tensor) -> Tensor:
    return image_loss(image.color, target, _STRUCTURE_WEIGHT)
