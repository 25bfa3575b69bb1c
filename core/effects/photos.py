"""Effects of photos: what they are looked for in.

Each that is looked for is a module of this package with `detect(evidence: PhotoEvidence) -> EffectFinding`. What is
found is not taken out of photos but drawn while splats are trained, all but a background that stands still
(`moving_background`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..capture.model import Photo, Photos
from ..capture.photos import fitted_size, read_photo
from ..capture.tracks import Tracks, read_tracks
from ..evaluate.photos import spread
from ..progress import Tick, unstopped
from ..views import Camera

if TYPE_CHECKING:
    from .look.focus import Sharpness

# Colours and brightness are told from small photos: reading many takes a second or two.
_LONGEST, _MOST_PHOTOS = 400, 40


@dataclass(frozen=True, eq=False)
class PhotoEvidence:
    """The photos of a capture and what was computed of them, each once.

    Attributes:
        photos: with the cameras that were found.
        points: (P, 3) of the object in the photo frame: sparse ones, or of the visual hull.
        long_side: pixels that photos are scaled down to before they are trained on.
        model: the folder of the model of structure from motion; None where there is none.
        mip_filter: whether splats become fainter by as much as images widen them; see `core.render.splat`.
        tick: called between photos; may raise to stop.
    """

    photos: Photos
    points: np.ndarray
    long_side: int
    model: Path | None = None
    mip_filter: bool = False
    tick: Tick = unstopped

    @cached_property
    def training(self) -> list[Photo]:
        """Up to 40 photos with cameras, evenly over those that are not held out."""
        known = [photo for photo in self.photos.photos if photo.camera is not None and not photo.held_out]
        return spread(known, _MOST_PHOTOS)

    @cached_property
    def cameras(self) -> list[Camera]:
        """Of `training`, with as many pixels as are trained on."""
        full = [photo.camera for photo in self.training if photo.camera is not None]
        return [camera.resized(*fitted_size(camera.width, camera.height, self.long_side)) for camera in full]

    @cached_property
    def views(self) -> list[tuple[np.ndarray, Camera]]:
        """Pixels (H, W, 3) in 0..1 of `training`, at most 400 a side, and their cameras. Raises CaptureError."""
        views = []
        for photo in self.training:
            self.tick()
            views.append(read_photo(photo, _LONGEST))
        return views

    @cached_property
    def sharpness(self) -> Sharpness:
        """The edges of `views` that points lie beside. Raises CaptureError."""
        from .look.focus import sharpness

        return sharpness(self.views, self.points, self.tick)

    @cached_property
    def pixels_of_training(self) -> float:
        """How many of them one pixel of `views` is, along a side; the median. Raises CaptureError."""
        pairs = zip(self.cameras, self.views, strict=True)
        return float(np.median([camera.width / image.shape[1] for camera, (image, _) in pairs]))

    @cached_property
    def tracks(self) -> Tracks | None:
        """Which of `training` see which sparse points; None where that is not known."""
        return None if self.model is None else read_tracks(self.model, self.cameras, self.tick)
