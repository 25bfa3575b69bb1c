"""COLMAP models (sparse/0, binary or text) -> Photos with known poses and sparse points."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .findings import CaptureProblem, name_some
from .model import Lens, Photos
from .photos import posed_photo
from .projections import every_eighth
from .transforms import PosedPhotos

if TYPE_CHECKING:
    import pycolmap

# Models whose parameters after the intrinsics are the first of OpenCV's k1, k2, p1, p2, k3..k6 (fisheye: k1..k4).
_SUPPORTED = {
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "FULL_OPENCV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "OPENCV_FISHEYE",
}
_MOST_ERROR_PX = 2.0


def find_colmap(folder: Path) -> Path | None:
    """The folder of a COLMAP model: sparse/0, sparse, or colmap/sparse/0."""
    for place in ("sparse/0", "sparse", "colmap/sparse/0"):
        candidate = folder / place
        if any((candidate / f"cameras.{kind}").is_file() for kind in ("bin", "txt")):
            return candidate
    return None


def read_colmap(model: Path, images: dict[str, Path]) -> PosedPhotos:
    """Reads a COLMAP model.

    Args:
        model: what `find_colmap` returned.
        images: the capture's photos by the name relative to the photo folder.

    Raises:
        CaptureError: the model is damaged, or names images that are not there.
    """
    import pycolmap

    try:
        reconstruction = pycolmap.Reconstruction(model)
    except (RuntimeError, ValueError, OSError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CaptureProblem(
            model,
            f"cannot be read as a COLMAP model ({reason})",
            "copy cameras, images and points3D again, or delete the folder to have the poses found anew",
        ) from error
    by_base = {path.name: path for path in images.values()}
    paths = {
        image.name: images.get(image.name) or by_base.get(Path(image.name).name)
        for image in reconstruction.images.values()
        if image.has_pose
    }
    missing = sorted(name for name, path in paths.items() if path is None)
    if missing:
        raise CaptureProblem(
            model,
            f"names {len(missing)} of {len(paths)} images that are missing: {name_some(missing)}",
            "copy them into the photos folder",
        )
    photos = photos_from(reconstruction, {name: path for name, path in paths.items() if path is not None})
    if not photos.photos:
        raise CaptureProblem(model, "has no registered image", "delete the folder to have the poses found anew")
    return PosedPhotos(photos, sorted(path for path in model.iterdir() if path.suffix in (".bin", ".txt")))


def photos_from(reconstruction: pycolmap.Reconstruction, paths: dict[str, Path], upright: bool | None = None) -> Photos:
    """Photos (sorted by path, every eighth held out) and points of a reconstruction.

    Args:
        paths: the image file of each registered image's name.
        upright: whether the poses belong to the upright images; None to tell from their shape.
    """
    registered = sorted(
        (image for image in reconstruction.images.values() if image.has_pose and image.name in paths),
        key=lambda image: paths[image.name].as_posix(),
    )
    held_out = every_eighth(len(registered))
    photos = []
    for image, out in zip(registered, held_out, strict=True):
        matrix = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        lens = lens_of(reconstruction.cameras[image.camera_id])
        photos.append(posed_photo(paths[image.name], lens, matrix, bool(out), upright))
    points, colors = points_of(reconstruction)
    return Photos(photos, points, colors)


def points_of(reconstruction: pycolmap.Reconstruction) -> tuple[np.ndarray, np.ndarray]:
    """(P, 3) sparse points with a reprojection error under 2 px, in order of their ids, and (P, 3) colours 0..1."""
    kept = [point for _, point in sorted(reconstruction.points3D.items()) if not point.error > _MOST_ERROR_PX]
    points = np.array([point.xyz for point in kept], np.float64).reshape(-1, 3)
    colors = np.array([point.color for point in kept], np.float64).reshape(-1, 3) / 255.0
    return points, colors


def lens_of(camera: Any) -> Lens:
    """The lens of a pycolmap.Camera. Raises CaptureError for a camera model without a pinhole equivalent here."""
    model = camera.model_name
    if model not in _SUPPORTED:
        raise CaptureProblem(
            "sparse model", f"camera model {model} is not supported", "run COLMAP's image_undistorter first"
        )
    fisheye = model.endswith("FISHEYE")
    extra = [camera.params[i] for i in camera.extra_params_idxs()]
    coefficients = np.zeros(4 if fisheye else 8)
    coefficients[: len(extra)] = extra
    return Lens(
        width=camera.width,
        height=camera.height,
        fx=camera.focal_length_x,
        fy=camera.focal_length_y,
        cx=camera.principal_point_x,
        cy=camera.principal_point_y,
        coefficients=tuple(float(k) for k in coefficients),
        fisheye=fisheye,
    )
