"""What sparse points of photos take on this machine: how much there is to find on them only they tell."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from ..capture.model import Photo, Photos
from ..progress import Reporter, Tick


@dataclass(frozen=True)
class PointsTime:
    """Seconds of finding the features of a photo, and of matching those of two photos."""

    photo: float
    pair: float

    def seconds(self, photos: Photos) -> float:
        """Of all photos that points are looked for in."""
        training, pairs = _matched(photos)
        return self.photo * len(training) + self.pair * len(pairs)


def time_points(photos: Photos, tick: Tick) -> PointsTime | None:
    """Timed with three photos of which two are neither next to the first nor far from it, as a pair's time is the
    longer the more two photos share; None where there are too few to match.

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

    training, pairs = _matched(photos)
    if not pairs:
        return None
    first = pairs[0][0]
    others = [second for one, second in pairs if one == first]
    middle = max(len(others) // 2, 1)
    some = [first, *others[middle - 1 : middle + 1]]
    with TemporaryDirectory(prefix="insideout-") as folder:
        return PointsTime(*time_features([training[index] for index in some], Path(folder), Reporter(None, stops)))


def _matched(photos: Photos) -> tuple[list[Photo], list[tuple[int, int]]]:
    """The photos that points are looked for in, and which of them are matched, by their places among these."""
    from ..capture.sfm_steps import pairs_by_pose

    training = [photo for photo in photos.photos if not photo.held_out]
    cameras = [photo.camera for photo in training if photo.camera is not None]
    pairs = pairs_by_pose([str(index) for index in range(len(training))], cameras) if training else []
    return training, sorted((int(one), int(other)) for one, other in pairs)
