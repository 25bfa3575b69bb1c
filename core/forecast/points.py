"""What sparse points of photos take on this machine: how much there is to find on them two of them tell."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir

import numpy as np

from ..capture.model import Photo, Photos
from ..files import explained
from ..progress import Reporter, Tick
from ..views import Camera


@dataclass(frozen=True)
class PointsTime:
    """Seconds of finding the features of a photo, and of matching those of two photos."""

    photo: float
    pair: float

    def seconds(self, photos: Photos) -> float:
        """Of all photos that points are looked for in."""
        training, _, pairs = _matched(photos)
        return self.photo * len(training) + self.pair * len(pairs)


def time_points(photos: Photos, tick: Tick) -> PointsTime | None:
    """Timed with two photos, where there are more neither next to each other nor far apart: a pair's time is the longer
    the more its photos share. None where none share anything, and their features are not worth counting.

    Args:
        photos: with cameras.
        tick: called now and then; may raise to stop.

    Raises:
        CaptureError: a photo cannot be read.
        DiskFullError, RunFolderError: the system's folder for temporary files cannot be written.
    """
    from ..capture.sfm import time_features

    def stops() -> bool:
        tick()
        return False

    training, cameras, pairs = _matched(photos)
    if not pairs:
        return None
    first = pairs[0][0]
    away = {
        second: np.linalg.norm(cameras[second].center - cameras[first].center) for one, second in pairs if one == first
    }
    partners = sorted(away, key=lambda other: away[other])
    pair = training[first], training[partners[(len(partners) - 1) // 2]]
    # What a virus scanner holds is no reason to fail.
    with (
        explained(Path(gettempdir())),
        TemporaryDirectory(prefix="insideout-", ignore_cleanup_errors=True) as folder,
    ):
        return PointsTime(*time_features(pair, Path(folder), Reporter(None, stops)))


def _matched(photos: Photos) -> tuple[list[Photo], list[Camera], list[tuple[int, int]]]:
    """The photos that points are looked for in, their cameras, and which are matched, by their places among these."""
    from ..capture.sfm_steps import pairs_by_pose

    training = [photo for photo in photos.photos if not photo.held_out]
    cameras = [photo.camera for photo in training if photo.camera is not None]
    pairs = pairs_by_pose([f"{index:05d}" for index in range(len(training))], cameras) if training else []
    return training, cameras, sorted((int(one), int(other)) for one, other in pairs)
