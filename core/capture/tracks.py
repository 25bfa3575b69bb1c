"""Which photos see which sparse points, from the model that structure from motion left."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..progress import Tick, unstopped
from ..views import Camera
from .layout import find_colmap, find_parts

_MOST_ERROR_PX = 2.0
# Poses of a model and of a run's photos are the same numbers, but for a quaternion's rounding.
_SAME = 1e-6
# Points between two ticks: a tenth of a second.
_POINTS_A_TICK = 5000


@dataclass(frozen=True, eq=False)
class Tracks:
    """Sparse points and the photos that they were found in.

    Attributes:
        points: (P, 3) in the photo frame.
        photo, point: (E,) of each sighting the place of its photo among those asked for, and of its point.
    """

    points: np.ndarray
    photo: np.ndarray
    point: np.ndarray


def find_model(workdir: Path, capture: Path) -> Path | None:
    """The folder of the model that a run's sparse points are from: its own, else the one that the capture brought.

    Args:
        workdir: of `sfm.reconstruct` or `sfm.triangulate`.
        capture: the capture folder.
    """
    if (workdir / "model" / "points3D.bin").is_file():
        return workdir / "model"
    try:
        places = (find_parts(capture)[0], capture)
    except OSError:
        return None
    return next((model for model in map(find_colmap, filter(None, places)) if model), None)


def read_tracks(model: Path, cameras: Sequence[Camera], tick: Tick = unstopped) -> Tracks | None:
    """Points with a reprojection error under 2 px that two or more of the photos see; None where the model cannot be
    read, or is of other photos.

    Photos are known by their poses, for names differ: structure from motion works on copies. Of photos with the very
    same pose it cannot be told which is which, so they see nothing.

    Args:
        cameras: of the photos, in the model's frame.
        tick: called between some thousand points; may raise to stop.
    """
    import pycolmap

    try:
        reconstruction = pycolmap.Reconstruction(model)
    except (RuntimeError, ValueError, OSError):
        return None
    places = _places(reconstruction, np.array([_pose(camera.world_to_camera) for camera in cameras]).reshape(-1, 12))
    points: list[np.ndarray] = []
    photo: list[int] = []
    point: list[int] = []
    for count, (_, one) in enumerate(sorted(reconstruction.points3D.items())):
        if count % _POINTS_A_TICK == 0:
            tick()
        seen = sorted({places[each.image_id] for each in one.track.elements if each.image_id in places})
        if len(seen) < 2 or one.error > _MOST_ERROR_PX:
            continue
        photo += seen
        point += [len(points)] * len(seen)
        points.append(one.xyz)
    if not points:
        return None
    return Tracks(np.array(points, np.float64), np.array(photo, np.int64), np.array(point, np.int64))


def _places(reconstruction: object, poses: np.ndarray) -> dict[int, int]:
    """The place of each image's pose among `poses` (N, 12), by the image's id."""
    found: dict[int, list[int]] = {}
    for image_id, image in reconstruction.images.items():  # type: ignore[attr-defined]
        if image.has_pose:
            apart = np.abs(poses - _pose(image.cam_from_world().matrix())).max(axis=1)
            found[image_id] = np.flatnonzero(apart <= _SAME * (1 + np.abs(poses).max(axis=1))).tolist()
    claimed = [place for places in found.values() for place in places]
    return {
        image_id: places[0] for image_id, places in found.items() if len(places) == 1 and claimed.count(places[0]) == 1
    }


def _pose(matrix: np.ndarray) -> np.ndarray:
    return np.asarray(matrix, np.float64)[:3, :4].ravel()
