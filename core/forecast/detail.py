"""How much there is to see on photos, which is what the number of their splats grows with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..capture.model import Photo
from ..progress import Tick, unstopped

_LOOK_AT = 4
# Differences between neighbours up to this, of 0..1, may be noise.
_NOISE = 0.02


def photo_detail(photos: Sequence[Photo], long_side: int, tick: Tick = unstopped) -> float:
    """Differences between neighbouring pixels, 0..1 each, summed over a photo as it is trained on; the mean of up to
    four photos.

    An edge counts by its length and its contrast; a photo twice as large has twice as much of the same edges.

    Args:
        photos: with cameras.
        long_side: of a photo that is trained on, pixels.
        tick: called between photos; may raise to stop.

    Raises:
        CaptureError: a photo cannot be read.
    """
    from ..evaluate.photos import spread
    from ..stages.surface.photos import TrainingPhotos

    looked = TrainingPhotos(spread(photos, _LOOK_AT), long_side, None, tick=tick)
    return float(np.mean([_differences(looked.read(index)[1].numpy()) for index in range(len(looked))]))


def _differences(image: np.ndarray) -> float:
    """Of (H, W, 3), of the channel that differs most."""
    down, across = np.diff(image, axis=0)[:, :-1], np.diff(image, axis=1)[:-1]
    return float(np.maximum(np.hypot(down, across).max(axis=-1) - _NOISE, 0.0).sum())
