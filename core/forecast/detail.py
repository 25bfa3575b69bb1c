"""What photos show, as far as a forecast needs it: how much there is to see, and how large the object is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..capture.model import Photo
from ..progress import Tick, unstopped

_LOOK_AT = 4
# Differences between neighbours up to this, of 0..1, may be noise.
_NOISE = 0.02
# Pixels along a side that tell the background.
_SMALL = 200


@dataclass(frozen=True)
class PhotoLook:
    """What a few photos show.

    Attributes:
        detail: differences between neighbouring pixels, 0..1 each, summed over a photo as it is trained on. An edge
            counts by its length and its contrast; a photo twice as large has twice as much of the same edges.
        covered: share of a photo that the object covers, None where the background is not plain.
    """

    detail: float = 0.0
    covered: float | None = None


def look_at_photos(photos: Sequence[Photo], long_side: int, tick: Tick = unstopped) -> PhotoLook:
    """The mean of up to four photos.

    Args:
        photos: with cameras or without.
        long_side: of the photos as they are trained on, pixels.
        tick: called between photos; may raise to stop.

    Raises:
        CaptureError: a photo cannot be read.
    """
    from ..capture.background import foreground_masks, plain_background
    from ..capture.photos import read_bare
    from ..evaluate.photos import spread

    details, small = [], []
    for photo in spread(photos, _LOOK_AT):
        tick()
        image = read_bare(photo, long_side)
        details.append(_detail(image))
        stride = max(max(image.shape[:2]) // _SMALL, 1)
        small.append(image[::stride, ::stride])
    background = plain_background(small)
    masks = None if background is None else foreground_masks(small, background)
    covered = None if masks is None else float(np.mean([mask.mean() for mask in masks]))
    return PhotoLook(float(np.mean(details)), covered)


def _detail(image: np.ndarray) -> float:
    """Of an image (H, W, 3): the gradient's length beyond noise, of the channel where it is longest, summed."""
    down, across = np.diff(image, axis=0)[:, :-1], np.diff(image, axis=1)[:-1]
    return float(np.maximum(np.hypot(down, across).max(axis=-1) - _NOISE, 0.0).sum())
