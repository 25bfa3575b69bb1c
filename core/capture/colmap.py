"""COLMAP models (sparse/0, binary or text) -> Photos with known poses and sparse points."""

from __future__ import annotations

from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .bindings import load_pycolmap
from .findings import CaptureProblem, name_some
from .model import Lens, Photos
from .photos import posed_photo
from .transforms import PosedPhotos
from .values import every_eighth

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


def read_colmap(model: Path, images: dict[str, Path]) -> PosedPhotos:
    """Reads a COLMAP model.

    Args:
        model: what `layout.find_colmap` returned.
        images: the capture's photos by the name relative to the photo folder.

    Raises:
        CaptureError: the model is damaged, or names images that are not there.
    """
    pycolmap = load_pycolmap()

    try:
        reconstruction = pycolmap.Reconstruction(model)
    except (RuntimeError, ValueError, OSError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CaptureProblem(
            model,
            "cannot be read as a COLMAP model ({reason})",
            "copy cameras, images and points3D again, or delete the folder to have the poses found anew",
            reason=reason,
        ) from error
    paths = _files_of(model, [image.name for image in reconstruction.images.values() if image.has_pose], images)
    missing = sorted(name for name, path in paths.items() if path is None)
    if missing:
        raise CaptureProblem(
            model,
            "names {gone} of {count} images that are missing: {missing}",
            "copy them into the photos folder",
            gone=len(missing),
            count=len(paths),
            missing=name_some(missing),
        )
    photos = photos_from(reconstruction, {name: path for name, path in paths.items() if path is not None})
    if not photos.photos:
        raise CaptureProblem(model, "has no registered image", "delete the folder to have the poses found anew")
    return PosedPhotos(photos, sorted(path for path in model.iterdir() if path.suffix in (".bin", ".txt")))


def _files_of(model: Path, names: list[str], images: dict[str, Path]) -> dict[str, Path | None]:
    """The image file of each name: of that very name, else the one that shares the longest end of its path.

    Raises:
        CaptureError: two files fit a name equally well, or two names one file.
    """
    by_base: dict[str, list[str]] = {}
    for known in images:
        by_base.setdefault(known.rpartition("/")[2], []).append(known)
    files: dict[str, Path | None] = {}
    for name in sorted(names):
        wanted = name.replace("\\", "/")
        near = [wanted] if wanted in images else by_base.get(wanted.rpartition("/")[2], [])
        shared = [_shared_end(wanted, known) for known in near]
        best = [known for known, count in zip(near, shared, strict=True) if count == max(shared)]
        if len(best) > 1:
            raise _ambiguous(model, name, best)
        files[name] = images[best[0]] if best else None
    owner: dict[Path, str] = {}
    for name, file in files.items():
        if file is not None and owner.setdefault(file, name) != name:
            raise _ambiguous(model, file.name, [owner[file], name])
    return files


def _shared_end(first: str, second: str) -> int:
    """How many folders and file names two paths share, from the end on."""
    pairs = zip(reversed(first.split("/")), reversed(second.split("/")), strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))


def _ambiguous(model: Path, name: str, others: list[str]) -> CaptureProblem:
    return CaptureProblem(
        model,
        "cannot tell which image {name} is: {images}",
        "keep the folders below photos/ as they were when the model was made",
        name=name,
        images=name_some(others),
    )


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
    training = {image.image_id for image, out in zip(registered, held_out, strict=True) if not out}
    points, colors = points_of(reconstruction, training)
    return Photos(photos, points, colors)


def points_of(reconstruction: pycolmap.Reconstruction, training: set[int]) -> tuple[np.ndarray, np.ndarray]:
    """Sparse points with a reprojection error under 2 px that would be there without the held-out photos.

    Args:
        training: ids of the images that are not held out; a point needs two of them.

    Returns:
        (P, 3) points, in order of their ids, and (P, 3) colours 0..1.
    """
    kept = [
        point
        for _, point in sorted(reconstruction.points3D.items())
        if not point.error > _MOST_ERROR_PX
        and len(training & {element.image_id for element in point.track.elements}) >= 2
    ]
    points = np.array([point.xyz for point in kept], np.float64).reshape(-1, 3)
    colors = np.array([point.color for point in kept], np.float64).reshape(-1, 3) / 255.0
    return points, colors


def lens_of(camera: Any) -> Lens:
    """The lens of a pycolmap.Camera. Raises CaptureError for a camera model without a pinhole equivalent here."""
    model = camera.model_name
    if model not in _SUPPORTED:
        raise CaptureProblem(
            "sparse model", "camera model {model} is not supported", "run COLMAP's image_undistorter first", model=model
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
