"""Image files -> pixels and pinhole cameras: orientation, focal length from EXIF, lens distortion, size."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, UnidentifiedImageError

from ..progress import Tick, unstopped
from ..views import Camera
from .findings import CaptureProblem
from .image_file import open_image
from .layout import IMAGE_SUFFIXES
from .model import Lens, Photo

# Cameras and phones write these; their photos have to be exported first.
_FOREIGN_SUFFIXES = {".heic", ".heif", ".avif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef"}

_ORIENTATION, _EXIF, _MAKE, _MODEL = 0x0112, 0x8769, 0x010F, 0x0110
_FOCAL_MM, _FOCAL_35MM, _FULL_WIDTH, _FULL_HEIGHT = 0x920A, 0xA405, 0xA002, 0xA003
_PLANE_X, _PLANE_UNIT = 0xA20E, 0xA210
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}
_FULL_FRAME_DIAGONAL_MM = 43.2666
# What brings an image upright, by its orientation in EXIF; from 5 on width and height change places.
_TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
# Lenses are taken out of photos so many times as large as they are asked for, where they are that large.
_FINER = 2
_READ_ERRORS = (
    OSError,
    UnidentifiedImageError,
    SyntaxError,
    ValueError,
    struct.error,
    Image.DecompressionBombError,
)


@dataclass(frozen=True)
class ImageFacts:
    """What an image file says about itself without decoding its pixels.

    Attributes:
        stored: (width, height) of the pixels as stored.
        turned: whether EXIF orientation swaps width and height or flips the image.
        upright: (width, height) once turned upright.
        focal_px: focal length in pixels of the stored size, from EXIF; None when it does not say enough.
        camera_name: maker, model and focal length: photos with equal names share one lens.
        alpha: whether there is a transparency channel.
    """

    stored: tuple[int, int]
    turned: bool
    upright: tuple[int, int]
    focal_px: float | None
    camera_name: str
    alpha: bool


def list_images(folder: Path) -> list[Path]:
    """Image files of a folder and its subfolders, hidden ones and masks left out, sorted by name."""
    return _list_files(folder, IMAGE_SUFFIXES)


def list_foreign_images(folder: Path) -> list[Path]:
    """Photos in a format that cannot be read (HEIC, AVIF, raw), as `list_images`."""
    return _list_files(folder, _FOREIGN_SUFFIXES)


def _list_files(folder: Path, suffixes: set[str]) -> list[Path]:
    found = [
        path
        for path in folder.rglob("*")
        if path.suffix.lower() in suffixes and path.is_file() and not _is_hidden(path.relative_to(folder))
    ]
    return sorted(found, key=lambda path: path.relative_to(folder).as_posix())


def image_facts(path: Path) -> ImageFacts:
    """Size, orientation and focal length of an image file. Raises CaptureError when it cannot be opened or has more
    than `image_file.MOST_PIXELS`."""
    try:
        with open_image(path) as image:
            exif = image.getexif()
            orientation = _orientation(image)
            details = {**exif, **exif.get_ifd(_EXIF)}
            stored = image.size
            alpha = image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info
    except _READ_ERRORS as error:
        raise _unreadable(path, error) from error
    upright = stored[::-1] if orientation >= 5 else stored
    name = " ".join(str(details.get(key, "")).strip("\0 ") for key in (_MAKE, _MODEL))
    return ImageFacts(
        stored=stored,
        turned=orientation in _TURNS,
        upright=upright,
        focal_px=exif_focal_px(details, stored),
        camera_name=f"{name} {_positive(details.get(_FOCAL_MM)) or 0:g} mm",
        alpha=alpha,
    )


def exif_focal_px(exif: dict[int, Any], size: tuple[int, int]) -> float | None:
    """Focal length in pixels of an image of `size` from its EXIF.

    Either from the 35 mm equivalent, which compares diagonals (CIPA DCG-001), or from the focal length in mm
    and the sensor's pixel pitch (FocalPlaneXResolution, which belongs to the full-size image).
    """
    diagonal = float(np.hypot(*size))
    equivalent = _positive(exif.get(_FOCAL_35MM))
    if equivalent:
        return equivalent / _FULL_FRAME_DIAGONAL_MM * diagonal
    focal, density = _positive(exif.get(_FOCAL_MM)), _positive(exif.get(_PLANE_X))
    if not focal or not density:
        return None
    full = (_positive(exif.get(_FULL_WIDTH)) or size[0], _positive(exif.get(_FULL_HEIGHT)) or size[1])
    unit = _MM_PER_UNIT.get(int(_positive(exif.get(_PLANE_UNIT)) or 2), 25.4)
    pixels = focal * density / unit * max(size) / max(full)
    # Some cameras write a resolution of the thumbnail: an implausible lens is worse than none.
    return pixels if 0.2 * max(size) < pixels < 20 * max(size) else None


def verify_images(paths: Sequence[Path], tick: Tick = unstopped) -> list[CaptureProblem]:
    """Decodes every image, small where the format allows, and returns one problem for each damaged or too large file.

    Args:
        tick: called between images; may raise to stop.
    """
    problems = []
    with ThreadPoolExecutor(max_workers=4) as pool:
        try:
            for problem in pool.map(_verify, paths):
                tick()
                problems += [] if problem is None else [problem]
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return problems


def read_photo(
    photo: Photo, long_side: int | None = None, background: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> tuple[np.ndarray, Camera]:
    """A photo's pixels as its pinhole camera sees them, no larger than `long_side`, its backdrop taken out.

    Args:
        long_side: longest side in pixels; larger photos are scaled down while they are read, so that a capture of
            any size fits into memory.
        background: RGB 0..1 that shows through transparent pixels.

    Returns:
        (height, width, 3) float32 in 0..1, and the camera resized to it.

    Raises:
        CaptureError: the file cannot be read, has another shape than its camera, or has no camera yet.
    """
    if photo.camera is None:
        raise CaptureProblem(photo.path, "has no camera yet", "run structure from motion first")
    width, height = fitted_size(photo.camera.width, photo.camera.height, long_side)
    target = photo.camera.resized(width, height)
    # JPEG decodes little larger than it is asked to.
    times = 1 if photo.lens is None else _FINER
    pixels = read_pixels(photo.path, upright=photo.upright, long_side=times * max(width, height), background=background)
    _check_shape(photo, pixels)
    pixels = _without_backdrop(pixels, photo, (width, height))
    if photo.lens is None:
        return resized(pixels, width, height), target
    # Between pixels of half the size it is interpolated with half of the blur, which the smaller image hardly shows.
    times = times if pixels.shape[1] >= times * width else 1
    finer = target.resized(times * width, times * height)
    pixels = undistort(resized(pixels, finer.width, finer.height), photo.lens, finer)
    return resized(pixels, width, height), target


def read_bare(photo: Photo, long_side: int, size: tuple[int, int] | None = None) -> np.ndarray:
    """(height, width, 3) float32 in 0..1 of a photo that may have no camera yet, its backdrop taken out, its lens not.

    Args:
        size: width and height; if not given, no side is longer than `long_side`.

    Raises:
        CaptureError: the file cannot be read.
    """
    pixels = read_pixels(photo.path, upright=photo.upright, long_side=long_side)
    size = size or fitted_size(pixels.shape[1], pixels.shape[0], long_side)
    pixels = _without_backdrop(pixels, photo, size)
    return resized(pixels, *size)


def read_pixels(
    path: Path,
    *,
    upright: bool = True,
    long_side: int | None = None,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> np.ndarray:
    """(height, width, 3) float32 in 0..1 of an image file, at least `long_side` long but perhaps longer.

    Raises:
        CaptureError: the file is unreadable, truncated or larger than `image_file.MOST_PIXELS`.
    """
    try:
        with open_image(path) as image:
            # JPEG decodes at 1/2, 1/4 or 1/8 for a fraction of the time and memory.
            drafted = None if long_side is None else image.draft("RGB", (long_side, long_side))
            image.load()
            whole = image if drafted is None else _without_rest(image, drafted[1])
            # Not by `ImageOps.exif_transpose`: it writes all of the EXIF anew, which fails where a tag is odd.
            turn = _TURNS.get(_orientation(whole)) if upright else None
            return _to_float(whole if turn is None else whole.transpose(turn), background)
    except _READ_ERRORS as error:
        raise _unreadable(path, error) from error


def _orientation(image: Image.Image) -> int:
    """As EXIF counts them, 1 to 8; 1 of what is none."""
    orientation = image.getexif().get(_ORIENTATION)
    return int(orientation) if orientation in _TURNS else 1


def _without_rest(image: Image.Image, box: tuple[float, float, float, float]) -> Image.Image:
    """The part of a JPEG decoded at a fraction of its size that shows the photo: sides that do not divide evenly end
    within its last row or column, where the rest is made up."""
    width, height = int(box[2]), int(box[3])
    if (box[2], box[3]) == image.size:
        return image
    return image.resize((width, height), Image.Resampling.BICUBIC, box=box)


def fitted_size(width: int, height: int, long_side: int | None) -> tuple[int, int]:
    """Width and height scaled down so that neither is above `long_side`; never up."""
    if long_side is None or max(width, height) <= long_side:
        return width, height
    zoom = long_side / max(width, height)
    return max(round(width * zoom), 1), max(round(height * zoom), 1)


def resized(pixels: np.ndarray, width: int, height: int) -> np.ndarray:
    """The image at another size: averaged when it gets smaller, interpolated when larger."""
    import cv2

    if pixels.shape[1::-1] == (width, height):
        return pixels
    smaller = width * height < pixels.shape[0] * pixels.shape[1]
    return cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)


def _without_backdrop(pixels: np.ndarray, photo: Photo, least: tuple[int, int]) -> np.ndarray:
    if photo.backdrop is None:
        return pixels
    from .backdrop import without_backdrop

    return without_backdrop(pixels, photo.backdrop, least)


def undistort(pixels: np.ndarray, lens: Lens, camera: Camera) -> np.ndarray:
    """What the pinhole `camera` sees of an image taken through `lens`; both scaled to the image's size."""
    import cv2

    x, y = pixels.shape[1] / lens.width, pixels.shape[0] / lens.height
    source = _matrix(lens.fx * x, lens.fy * y, lens.cx * x, lens.cy * y)
    target = _matrix(camera.fx, camera.fy, camera.cx, camera.cy)
    size = (camera.width, camera.height)
    coefficients = np.asarray(lens.coefficients, np.float64)
    maps = cv2.fisheye.initUndistortRectifyMap if lens.fisheye else cv2.initUndistortRectifyMap
    columns, rows = maps(source, coefficients, np.eye(3), target, size, cv2.CV_32FC1)
    straight = cv2.remap(pixels, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.clip(straight, 0.0, 1.0)


def pinhole_for(lens: Lens, world_to_camera: np.ndarray) -> Camera:
    """The pinhole camera that sees the largest part of the lens's image with no empty pixel at the border."""
    import cv2

    source = _matrix(lens.fx, lens.fy, lens.cx, lens.cy)
    coefficients = np.asarray(lens.coefficients, np.float64)
    size = (lens.width, lens.height)
    if lens.fisheye:
        target = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(
            source, coefficients, size, np.eye(3), balance=0.0
        )
    else:
        target, _ = cv2.getOptimalNewCameraMatrix(source, coefficients, size, alpha=0.0)
    return Camera(
        width=lens.width,
        height=lens.height,
        fx=float(target[0, 0]),
        fy=float(target[1, 1]),
        cx=float(target[0, 2]) + 0.5,
        cy=float(target[1, 2]) + 0.5,
        world_to_camera=world_to_camera,
    )


def posed_photo(
    path: Path,
    lens: Lens,
    world_to_camera: np.ndarray,
    held_out: bool = False,
    upright: bool | None = None,
) -> Photo:
    """A photo with known pose: its pinhole camera, the lens if it distorts, and whether to turn it upright.

    Intrinsics belong to the pixels as stored, as every structure-from-motion program reads them, unless only the
    upright image has their shape. Intrinsics of a larger or smaller copy are scaled.

    Args:
        upright: whether the intrinsics belong to the upright image, where that is known.

    Raises:
        CaptureError: the image has another shape than the intrinsics say.
    """
    facts = image_facts(path)
    given = (lens.width, lens.height)
    if upright is None:
        upright = not _same_shape(given, facts.stored)
    width, height = facts.upright if upright else facts.stored
    if not _same_shape(given, (width, height)):
        raise CaptureProblem(
            path,
            "is {columns} x {rows} but its camera is for {width} x {height}",
            "use the images that the poses were made with",
            columns=facts.stored[0],
            rows=facts.stored[1],
            width=lens.width,
            height=lens.height,
        )
    x, y = width / lens.width, height / lens.height
    lens = replace(lens, width=width, height=height, fx=lens.fx * x, fy=lens.fy * y, cx=lens.cx * x, cy=lens.cy * y)
    distorts = lens.fisheye or any(abs(k) > 1e-12 for k in lens.coefficients)
    if distorts:
        camera = pinhole_for(lens, world_to_camera)
    else:
        camera = Camera(width, height, lens.fx, lens.fy, lens.cx, lens.cy, world_to_camera)
    return Photo(path, camera, held_out, lens if distorts else None, upright)


def _matrix(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    # OpenCV counts from the middle of the first pixel, cameras here from its corner.
    return np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]], np.float64)


def _same_shape(expected: tuple[int, int], size: tuple[int, int]) -> bool:
    """Whether `size` is `expected` scaled, allowing for sizes rounded to whole pixels."""
    return abs(expected[0] * size[1] - expected[1] * size[0]) <= max(*expected, *size)


def _check_shape(photo: Photo, pixels: np.ndarray) -> None:
    camera = photo.camera
    if camera is not None and not _same_shape((camera.width, camera.height), (pixels.shape[1], pixels.shape[0])):
        raise CaptureProblem(
            photo.path,
            "is shaped {columns} x {rows}, its camera {width} x {height}",
            "put back the image that the run was started with",
            columns=pixels.shape[1],
            rows=pixels.shape[0],
            width=camera.width,
            height=camera.height,
        )


def _to_float(image: Image.Image, background: tuple[float, float, float]) -> np.ndarray:
    if image.mode in ("I;16", "I;16B", "I;16L", "I"):
        gray = np.asarray(image).astype(np.float32) / 65535.0
        return np.repeat(np.clip(gray, 0, 1)[..., None], 3, axis=-1)
    if image.mode == "F":
        return np.repeat(np.clip(np.asarray(image, np.float32), 0, 1)[..., None], 3, axis=-1)
    if image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info:
        rgba = np.asarray(image.convert("RGBA"), np.float32) / 255.0
        alpha = rgba[..., 3:]
        return np.ascontiguousarray(rgba[..., :3] * alpha + np.asarray(background, np.float32) * (1.0 - alpha))
    return np.asarray(image.convert("RGB"), np.float32) / 255.0


def _verify(path: Path) -> CaptureProblem | None:
    try:
        with open_image(path) as image:
            image.draft("RGB", (1, 1))
            image.load()
            if min(image.size) < 1:
                raise ValueError("no pixels")
    except CaptureProblem as problem:
        return problem
    except _READ_ERRORS as error:
        return _unreadable(path, error)
    return None


def _unreadable(path: Path, error: Exception) -> CaptureProblem:
    unknown = isinstance(error, UnidentifiedImageError)
    return CaptureProblem(
        path,
        "cannot be read as an image ({error})" if unknown else "is damaged or truncated ({error})",
        "copy it again from the camera, or remove it from the folder",
        error=error,
    )


def _positive(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if np.isfinite(number) and number > 0 else None


def _is_hidden(relative: Path) -> bool:
    return any(part.startswith(".") or part.lower() in ("masks", "mask", "depth") for part in relative.parts)
