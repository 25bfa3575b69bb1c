"""Which photos see which sparse points, from the model that structure from motion left."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import CaptureError
from ..progress import Tick, unstopped
from ..views import Camera
from .bindings import load_pycolmap
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
        seen: (E, 2) where it was seen, column and row in pixels of the camera that was asked for; not where the point
            would be drawn.
    """

    points: np.ndarray
    photo: np.ndarray
    point: np.ndarray
    seen: np.ndarray


def find_model(workdir: Path, capture: Path) -> Path | None:
    """The folder of the model that a run's sparse points are from: its own, else the one that the capture brought.

    Args:
        workdir: of `sfm.reconstruct` or `sfm.triangulate`.
        capture: the capture folder.
    """
    own = workdir / "model"
    return own if (own / "points3D.bin").is_file() else brought_model(capture)


def brought_model(capture: Path) -> Path | None:
    """The folder of the COLMAP model in a capture folder; None where there is none."""
    try:
        places = (find_parts(capture)[0], capture)
    except (OSError, CaptureError):
        return None
    return next((model for model in map(find_colmap, filter(None, places)) if model), None)


def read_tracks(
    model: Path, cameras: Sequence[Camera], tick: Tick = unstopped, most_error_px: float = _MOST_ERROR_PX
) -> Tracks | None:
    """Points with a reprojection error of up to 2 px that two or more of the photos see; None where the model cannot be
    read, or is of other photos.

    Photos are known by their poses, for names differ: structure from motion works on copies. Of photos with the very
    same pose it cannot be told which is which, so they see nothing.

    Args:
        cameras: of the photos, in the model's frame.
        tick: called between some thousand points; may raise to stop.
        most_error_px: in pixels of the images that structure from motion worked on, at most 1600 a side.
    """
    pycolmap = load_pycolmap()

    try:
        reconstruction = pycolmap.Reconstruction(model)
    except (RuntimeError, ValueError, OSError):
        return None
    places = _places(reconstruction, np.array([_pose(camera.world_to_camera) for camera in cameras]).reshape(-1, 12))
    ideal = _ideal(reconstruction, places)
    points: list[np.ndarray] = []
    photo: list[int] = []
    point: list[int] = []
    seen: list[np.ndarray] = []
    for count, (_, one) in enumerate(sorted(reconstruction.points3D.items())):
        if count % _POINTS_A_TICK == 0:
            tick()
        # Lenses fold beyond some radius, where nothing says which way a ray came.
        found = {
            places[each.image_id]: each
            for each in one.track.elements
            if each.image_id in places and np.isfinite(ideal[each.image_id][each.point2D_idx]).all()
        }
        if len(found) < 2 or one.error > most_error_px:
            continue
        for place in sorted(found):
            seen.append(ideal[found[place].image_id][found[place].point2D_idx])
        photo += sorted(found)
        point += [len(points)] * len(found)
        points.append(one.xyz)
    if not points:
        return None
    where = np.array(photo, np.int64)
    focal, middle = (np.array([pair(camera) for camera in cameras])[where] for pair in (_focal, _middle))
    return Tracks(np.array(points, np.float64), where, np.array(point, np.int64), np.array(seen) * focal + middle)


def _ideal(reconstruction: Any, places: Mapping[int, int]) -> dict[int, np.ndarray]:
    """(K, 2) of each image's features x / z and y / z, its lens taken out, by the image's id."""
    found = {}
    for image_id in places:
        image = reconstruction.images[image_id]
        features = np.array([feature.xy for feature in image.points2D], np.float64).reshape(-1, 2)
        found[image_id] = np.asarray(reconstruction.cameras[image.camera_id].cam_from_img(features))
    return found


def _focal(camera: Camera) -> tuple[float, float]:
    return camera.fx, camera.fy


def _middle(camera: Camera) -> tuple[float, float]:
    return camera.cx, camera.cy


def _places(reconstruction: Any, poses: np.ndarray) -> dict[int, int]:
    """The place of each image's pose among `poses` (N, 12), by the image's id."""
    found: dict[int, list[int]] = {}
    for image_id, image in reconstruction.images.items():
        if image.has_pose:
            apart = np.abs(poses - _pose(image.cam_from_world().matrix())).max(axis=1)
            found[image_id] = np.flatnonzero(apart <= _SAME * (1 + np.abs(poses).max(axis=1))).tolist()
    claimed = [place for places in found.values() for place in places]
    return {
        image_id: places[0] for image_id, places in found.items() if len(places) == 1 and claimed.count(places[0]) == 1
    }


def _pose(matrix: np.ndarray) -> np.ndarray:
    return np.asarray(matrix, np.float64)[:3, :4].ravel()
