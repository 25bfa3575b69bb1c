"""transforms.json of instant-ngp, nerfstudio and NeRF's synthetic scenes -> Photos with known poses."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .findings import CaptureProblem, name_some
from .model import Lens, Photo, Photos
from .photos import image_facts, posed_photo
from .values import every_eighth, listed, number, positive, read_json

_OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
_PERSPECTIVE = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "PERSPECTIVE")
_FISHEYE = ("OPENCV_FISHEYE", "FISHEYE")


@dataclass
class PosedPhotos:
    """Photos with known poses and the files that say so.

    Attributes:
        photos: sorted by file name.
        files: every file read besides the images, for the capture's digest.
    """

    photos: Photos
    files: list[Path] = field(default_factory=list)


def read_transforms(paths: Sequence[Path]) -> PosedPhotos:
    """Photos and cameras that transforms files list.

    A camera-to-world matrix has OpenGL axes (x right, y up, z backward). Intrinsics may stand at the top or with a
    frame: fl_x, fl_y, cx, cy, w, h, or camera_angle_x; k1..k4, p1, p2 are OpenCV's distortion. Held out are the
    frames of transforms_test.json, or test_filenames and val_filenames, else every eighth.

    Raises:
        CaptureError: a file is broken, lacks a value, or names images that are not there.
    """
    photos: list[Photo] = []
    split = len(paths) > 1
    contents = [read_json(path) for path in paths]
    listed_frames = [_frames(path, content) for path, content in zip(paths, contents, strict=True)]
    found = [_images(path, frames) for path, frames in zip(paths, listed_frames, strict=True)]
    _check_once(paths, found)
    # A file that was split keeps its head: names of one part's frames stand in the other, too.
    known = {image for images in found for image in images}
    for path, content, frames, images in zip(paths, contents, listed_frames, found, strict=True):
        declared = _declared_held_out(path, content, known)
        split = split or bool(declared)
        for frame, image in zip(frames, images, strict=True):
            held_out = path.name == "transforms_test.json" or image in declared
            photos.append(_photo(path, content, frame, image, held_out))
    photos.sort(key=lambda photo: photo.path.as_posix())
    if not split:
        held = every_eighth(len(photos))
        photos = [Photo(p.path, p.camera, bool(out), p.lens, p.upright) for p, out in zip(photos, held, strict=True)]
    if sum(not photo.held_out for photo in photos) < 2:
        raise CaptureProblem(
            paths[-1],
            "holds out {held} of {count} photos for measuring",
            "leave at least two to learn from: take names out of test_filenames and val_filenames",
            held=sum(photo.held_out for photo in photos),
            count=len(photos),
        )
    return PosedPhotos(Photos(photos), list(paths))


def _frames(path: Path, content: Any) -> list[dict[str, Any]]:
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise CaptureProblem(path, "lists no 'frames'", "export the poses again")
    for index, frame in enumerate(frames):
        if not (isinstance(frame.get("file_path"), str) and Path(_name(frame)).name):
            raise CaptureProblem(path, "frame {index} has no 'file_path'", "name its image", index=index)
    return frames


def _images(path: Path, frames: list[dict[str, Any]]) -> list[Path]:
    images = [_find_image(path.parent, _name(frame)) for frame in frames]
    missing = [_name(frame) for frame, image in zip(frames, images, strict=True) if image is None]
    if missing:
        raise CaptureProblem(
            path,
            "names {gone} of {count} images that are missing: {missing}",
            "copy them beside it, or take their frames out",
            gone=len(missing),
            count=len(frames),
            missing=name_some(missing),
        )
    return [image for image in images if image is not None]


def _check_once(paths: Sequence[Path], found: list[list[Path]]) -> None:
    """Raises CaptureError where an image would be learnt from and held out, or have two cameras."""
    frames = [(path, image) for path, images in zip(paths, found, strict=True) for image in images]
    counts = Counter(image.resolve() for _, image in frames)
    twice = {image.resolve(): path for path, image in frames if counts[image.resolve()] > 1}
    if twice:
        raise CaptureProblem(
            next(reversed(twice.values())),
            "names {count} images that have a frame already: {names}",
            "let each image have one frame, in one of the files",
            count=len(twice),
            names=name_some(sorted({image.name for image in twice})),
        )


def _find_image(folder: Path, name: str) -> Path | None:
    """The image of that name, or with the extension that NeRF's scenes leave out, or moved into the folder."""
    for place in (folder / name, folder / Path(name).name):
        for suffix in ("", ".png", ".jpg", ".jpeg", ".JPG"):
            candidate = place.with_name(place.name + suffix)
            if candidate.is_file():
                return candidate
    return None


def _name(frame: dict[str, Any]) -> str:
    return str(frame["file_path"]).replace("\\", "/")


def _declared_held_out(path: Path, content: dict[str, Any], images: set[Path]) -> set[Path]:
    """Those of the frames' images that are to be held out; written in whatever way frames may name theirs."""
    keys = ("test_filenames", "val_filenames")
    names = [str(name).replace("\\", "/") for key in keys for name in listed(path, content, key)]
    found = {name: _find_image(path.parent, name) for name in names}
    of_no_frame = [name for name, image in found.items() if image not in images]
    if of_no_frame:
        raise CaptureProblem(
            path,
            "holds out {names}, of which no frame has the pose",
            "name frames' images in test_filenames and val_filenames",
            names=name_some(of_no_frame),
        )
    return {image for image in found.values() if image is not None}


def _photo(path: Path, content: dict[str, Any], frame: dict[str, Any], image: Path, held_out: bool) -> Photo:
    try:
        camera_to_world = np.asarray(frame["transform_matrix"], np.float64)
    except (KeyError, TypeError, ValueError):
        camera_to_world = np.full((4, 4), np.nan)
    if camera_to_world.shape == (3, 4):
        camera_to_world = np.vstack([camera_to_world, [0, 0, 0, 1]])
    if camera_to_world.shape != (4, 4) or not np.isfinite(camera_to_world).all():
        raise CaptureProblem(
            path,
            "'transform_matrix' of {name} is not a finite 4 x 4 matrix",
            "export the poses again",
            name=_name(frame),
        )
    rotation = camera_to_world[:3, :3]
    if not np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-2) or np.linalg.det(rotation) < 0:
        raise CaptureProblem(
            path,
            "'transform_matrix' of {name} is not a rotation and a position",
            "export the poses without scaling or mirroring",
            name=_name(frame),
        )
    lens = _lens(path, {**content, **frame}, image)
    return posed_photo(image, lens, _invert(camera_to_world @ _OPENGL_TO_OPENCV), held_out)


def _invert(camera_to_world: np.ndarray) -> np.ndarray:
    """The inverse of a rigid motion, its rotation made exactly orthogonal."""
    left, _, right = np.linalg.svd(camera_to_world[:3, :3])
    turn = (left @ right).T
    inverse = np.eye(4)
    inverse[:3, :3], inverse[:3, 3] = turn, -turn @ camera_to_world[:3, 3]
    return inverse


def _lens(path: Path, values: dict[str, Any], image: Path) -> Lens:
    model = str(values.get("camera_model", "OPENCV")).upper()
    if model not in _PERSPECTIVE + _FISHEYE:
        raise CaptureProblem(
            path,
            "camera model {model} is not supported",
            "undistort the images to PINHOLE and export again",
            model=model,
        )
    fisheye = model in _FISHEYE or bool(values.get("is_fisheye"))
    if "w" in values and "h" in values:
        width, height = round(number(path, values, "w")), round(number(path, values, "h"))
        positive(path, "w, h", np.array([width, height]))
    else:
        width, height = image_facts(image).stored
    fx = _focal(path, values, "x", width)
    fy = _focal(path, values, "y", height) if "fl_y" in values or "camera_angle_y" in values else fx
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    return Lens(
        width=width,
        height=height,
        fx=fx,
        fy=fy,
        cx=number(path, values, "cx", width / 2),
        cy=number(path, values, "cy", height / 2),
        coefficients=tuple(number(path, values, name, 0.0) for name in names),
        fisheye=fisheye,
    )


def _focal(path: Path, values: dict[str, Any], axis: str, pixels: int) -> float:
    if f"fl_{axis}" in values:
        focal = number(path, values, f"fl_{axis}")
    elif f"camera_angle_{axis}" in values:
        angle = number(path, values, f"camera_angle_{axis}")
        if not 0 < angle < np.pi:
            raise CaptureProblem(
                path, "'camera_angle_{axis}' is {angle:g}", "give radians above 0 and below π", axis=axis, angle=angle
            )
        focal = 0.5 * pixels / np.tan(0.5 * angle)
    else:
        raise CaptureProblem(path, "lacks 'fl_{axis}'", "add fl_x in pixels, or camera_angle_x in radians", axis=axis)
    if not focal > 0:
        raise CaptureProblem(path, "has a focal length of {focal:g} px", "give a value above zero", focal=focal)
    return float(focal)
