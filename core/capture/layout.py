"""Where the parts of a capture folder lie. Blender asks this too, so nothing here opens an image."""

from __future__ import annotations

from pathlib import Path

from .findings import CaptureProblem, name_some, warning
from .listing import shown_files
from .model import Finding
from .projections import find_projections
from .volumes import find_volume

IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp"}
_PHOTO_FOLDERS = ("photos", "images")
_XRAY_FOLDERS = ("xray",)
# Of photos alone: scanners write .tif. One image beside a scan is most likely a picture of its settings.
_PHOTO_SUFFIXES = IMAGE_SUFFIXES - {".tif", ".tiff"}
_SOME_PHOTOS = 2
# Folders in a capture that hold neither half of it; the file is that of a run.
_OTHER_FOLDERS = ("sparse", "colmap", "mask", "masks", "depth")
_RUN = "capture.json"


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


def overlooked(folder: Path, photo_folder: Path | None, xray_folder: Path | None) -> list[Finding]:
    """Warnings about what looks like the other half of a capture and is not read because of where it lies.

    Args:
        photo_folder, xray_folder: what `find_parts` found.

    Raises:
        OSError: the folder cannot be listed.
    """
    if (photo_folder is None) == (xray_folder is None):
        return []
    inner = [place for place in sorted(folder.iterdir()) if place not in (photo_folder, xray_folder)]
    inner = [place for place in inner if place.is_dir() and not _is_other(place)]
    if xray_folder is None:
        return [
            warning(
                place,
                "holds X-rays that are not read, because there is no folder xray/",
                "rename it to xray/ if they are of the object",
            )
            for place in inner
            if _has_xrays(place)
        ]
    counts = {place: len(_photos_in(place)) for place in inner}
    elsewhere = [
        warning(
            place,
            "holds {count} images that are not read, because there is no folder photos/",
            "rename it to photos/ if they are photos of the object",
            count=count,
        )
        for place, count in counts.items()
        if count >= _SOME_PHOTOS
    ]
    beside = _photos_in(folder)
    if len(beside) < _SOME_PHOTOS:
        return elsewhere
    here = warning(
        folder,
        "{count} images ({names}) are not read, because they lie beside the X-rays",
        "put them into photos/ if they are photos of the object",
        count=len(beside),
        names=name_some([path.name for path in beside], 2),
    )
    return [here, *elsewhere]


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


def _is_other(folder: Path) -> bool:
    name = folder.name.lower()
    try:
        return name.startswith((".", "proj")) or name in _OTHER_FOLDERS or (folder / _RUN).is_file()
    except OSError:
        # Nobody may look into it: `lost+found` of a disk.
        return True


def _has_xrays(folder: Path) -> bool:
    try:
        return find_projections(folder) is not None or find_volume(folder) is not None
    except CaptureProblem:
        # Of several it is not clear which is meant.
        return True
    except OSError:
        return False


def _photos_in(folder: Path) -> list[Path]:
    try:
        return [path for path in shown_files(folder) if path.suffix.lower() in _PHOTO_SUFFIXES]
    except OSError:
        return []
