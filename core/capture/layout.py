"""Where the parts of a capture folder lie. Blender asks this too, so nothing here opens an image."""

from __future__ import annotations

from pathlib import Path

from .projections import find_projections
from .volumes import find_volume

IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp"}
_PHOTO_FOLDERS = ("photos", "images")
_XRAY_FOLDERS = ("xray",)


def find_parts(folder: Path) -> tuple[Path | None, Path | None]:
    """The folders of photos and of X-rays; None where there are none. X-rays alone, or photos alone, may lie in the
    capture folder itself.

    Raises:
        OSError: the folder cannot be listed.
        CaptureError: several files or folders in it could be the scan, or the volume.
    """
    xray_folder = _first_folder(folder, _XRAY_FOLDERS)
    photo_folder = _first_folder(folder, _PHOTO_FOLDERS)
    if xray_folder is None and (find_projections(folder) or find_volume(folder)):
        xray_folder = folder
    if photo_folder is None and xray_folder != folder and _has_photos(folder):
        photo_folder = folder
    return photo_folder, xray_folder


def find_transforms(folder: Path) -> list[Path]:
    """transforms.json, or the transforms_train.json and transforms_test.json of NeRF's synthetic scenes."""
    single = folder / "transforms.json"
    if single.is_file():
        return [single]
    train, test = folder / "transforms_train.json", folder / "transforms_test.json"
    return [path for path in (train, test) if path.is_file()] if train.is_file() else []


def find_colmap(folder: Path) -> Path | None:
    """The folder of a COLMAP model: sparse/0, sparse, or colmap/sparse/0."""
    for place in ("sparse/0", "sparse", "colmap/sparse/0"):
        candidate = folder / place
        if any((candidate / f"cameras.{kind}").is_file() for kind in ("bin", "txt")):
            return candidate
    return None


def _first_folder(folder: Path, names: tuple[str, ...]) -> Path | None:
    """The first of `names` that is a folder there, in capitals or not."""
    known = {path.name.lower(): path for path in sorted(folder.iterdir(), reverse=True) if path.is_dir()}
    return next((known[name] for name in names if name in known), None)


def _has_photos(folder: Path) -> bool:
    if find_transforms(folder) or find_colmap(folder):
        return True
    return any(path.suffix.lower() in IMAGE_SUFFIXES for path in folder.iterdir() if path.is_file())
