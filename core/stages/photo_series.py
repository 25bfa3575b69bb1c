"""The photos of a run in the world frame, as the stages after `align` train and measure on them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import torch

from ..evaluate import heldout
from ..evaluate.photos import photo_background, registered_photos
from ..gaussians import GaussianSet
from ..render import splat
from ..render.options import SplatOptions
from ..render.splat import SplatImage
from ..views import Camera
from .context import StageContext
from .surface.photos import TrainingPhotos


class PhotoSeries:
    """Training photos by iteration, held-out ones to measure on.

    Args:
        context: of a run whose `align` is done.
        long_side: largest side in pixels.

    Attributes:
        background: (3,) float32 tensor, the plain colour behind the object, black where there is none.
        options: how `surface` drew its photo splats.

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
        plain = None if photos is None else photo_background(photos)
        self.background = torch.from_numpy(np.asarray(np.zeros(3) if plain is None else plain, np.float32))
        self._training, self._held_out = (
            TrainingPhotos(
                [photo for photo in moved if photo.held_out is kept], long_side, plain, tick=context.reporter.check
            )
            for kept in (False, True)
        )
        self._seed, self.options = context.seed, SplatOptions.of(context.run)

    def __len__(self) -> int:
        return len(self._training)

    def training(self, iteration: int) -> tuple[Camera, torch.Tensor]:
        """The photo of an iteration: its camera and (H, W, 3) float32 in 0..1. Each comes once a round."""
        lap, place = divmod(iteration, len(self))
        order = np.random.default_rng([self._seed, 2, lap]).permutation(len(self))
        return self.read_training(int(order[place]))

    def read_training(self, index: int) -> tuple[Camera, torch.Tensor]:
        """A training photo by its place: its camera and (H, W, 3) float32 in 0..1."""
        return self._training.read(index)[:2]

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
        return self._figures(self._training, heldout.some_of(len(self._training)), gaussians, kernel, tick)

    def _figures(
        self,
        photos: TrainingPhotos,
        chosen: Iterable[int],
        gaussians: GaussianSet,
        kernel: str,
        tick: Callable[[], None],
    ) -> heldout.Figures:
        views = [photos.read(int(index))[:2] for index in chosen]
        shown = [(camera, image.numpy()) for camera, image in views]
        return heldout.photo_figures(gaussians, shown, self.background.numpy(), kernel, tick, self.options)
