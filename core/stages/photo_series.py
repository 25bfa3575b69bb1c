"""The photos of a run in the world frame, as the stages after `align` train and measure on them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from ..evaluate import heldout
from ..evaluate.photos import kept_effects, photo_background, registered_photos
from ..gaussians import GaussianSet
from ..render import splat
from ..render.options import SplatOptions
from ..render.splat import SplatImage
from ..train.schedule import shuffled
from ..views import Camera
from .context import StageContext
from .surface.photos import TrainingPhotos


class Shot(NamedTuple):
    """A training photo: its place among them, its camera, and (H, W, 3) float32 in 0..1."""

    place: int
    camera: Camera
    photo: torch.Tensor


class PhotoSeries:
    """Training photos by iteration, held-out ones to measure on.

    Args:
        context: of a run whose `align` is done.
        long_side: largest side in pixels.

    Attributes:
        background: (3,) float32 tensor, the plain colour behind the object, black where there is none.
        options: how `surface` drew its photo splats.
        effects: what it found the training photos to show besides the object; None where it was asked for nothing.

    Raises:
        CaptureError: a photo cannot be read.
    """

    def __init__(self, context: StageContext, long_side: int) -> None:
        photos = registered_photos(context)
        similarity = context.run.similarity()
        moved = [
            replace(photo, camera=photo.camera.transformed(similarity))
            for photo in (photos.photos if photos is not None else [])
            if photo.camera is not None
        ]
        plain = None if photos is None else photo_background(photos, tick=context.reporter.check)
        self.background = torch.from_numpy(np.asarray(np.zeros(3) if plain is None else plain, np.float32))
        self._training, self._held_out = (
            TrainingPhotos(
                [photo for photo in moved if photo.held_out is kept], long_side, plain, tick=context.reporter.check
            )
            for kept in (False, True)
        )
        self._names = [str(photo.path) for photo in moved if not photo.held_out]
        self._seed, self.options = context.seed, SplatOptions.of(context.run)
        cameras = {str(photo.path): photo.camera for photo in moved if photo.camera is not None}
        self.effects = kept_effects(context, cameras, similarity.scale)

    def __len__(self) -> int:
        return len(self._training)

    def training(self, iteration: int) -> Shot:
        """The photo of an iteration. Each comes once a round."""
        place = shuffled(range(len(self)), iteration, self._seed, 2)
        return Shot(place, *self.read_training(place))

    def read_training(self, index: int) -> tuple[Camera, torch.Tensor]:
        """A training photo by its place: its camera and (H, W, 3) float32 in 0..1."""
        return self._training.read(index)[:2]

    def draw_training(self, gaussians: GaussianSet, index: int, camera: Camera, kernel: str) -> SplatImage:
        """What a torch set looks like in a training photo, its effects included.

        Args:
            camera: the photo's, perhaps moved.
        """

        def draw(shown: GaussianSet, seen_from: Camera) -> SplatImage:
            return self.draw(shown, seen_from, kernel)

        if self.effects is None:
            return draw(gaussians, camera)
        return self.effects.render(self._names[index], draw, gaussians, camera)

    def draw(self, gaussians: GaussianSet, camera: Camera, kernel: str) -> SplatImage:
        """What a camera sees of a torch set in front of the background."""
        return splat(gaussians, camera, self.background, kernel=kernel, **vars(self.options))

    def measure(self, gaussians: GaussianSet, kernel: str, tick: Callable[[], None]) -> heldout.Figures:
        """Mean PSNR in dB and SSIM over held-out photos; see `core.evaluate.heldout.photo_figures`."""
        return self._figures(self._held_out, range(len(self._held_out)), gaussians, kernel, tick)

    def measure_some(self, gaussians: GaussianSet, kernel: str, tick: Callable[[], None]) -> heldout.Figures:
        """As `measure` on up to `heldout.MOST_COMPARED` of them: for the course of a training."""
        return self._figures(self._held_out, heldout.some_of(len(self._held_out)), gaussians, kernel, tick)

    def measure_training(self, gaussians: GaussianSet, kernel: str, tick: Callable[[], None]) -> heldout.Figures:
        """As `measure_some` on training photos: for decisions, which held-out ones must not make."""
        chosen = heldout.some_of(len(self._training))
        names = [self._names[int(index)] for index in chosen]
        return self._figures(self._training, chosen, gaussians, kernel, tick, names)

    def _figures(
        self,
        photos: TrainingPhotos,
        chosen: Iterable[int],
        gaussians: GaussianSet,
        kernel: str,
        tick: Callable[[], None],
        names: Sequence[str] | None = None,
    ) -> heldout.Figures:
        views = [photos.read(int(index))[:2] for index in chosen]
        shown = [(camera, image.numpy()) for camera, image in views]
        behind = self.background.numpy()
        return heldout.photo_figures(gaussians, shown, behind, kernel, tick, self.options, self.effects, names)
