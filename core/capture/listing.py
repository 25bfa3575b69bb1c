"""What lies in a capture's folders."""

from __future__ import annotations

from pathlib import Path


def shown_files(folder: Path) -> list[Path]:
    """Files of a folder by name, without hidden ones: on disks of other systems a Mac puts `._scan.tif` beside each
    `scan.tif`, which holds no image."""
    return sorted(path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))


def suffix_of(path: Path) -> str:
    """The file's extension in lower case, .nii.gz as one."""
    return ".nii.gz" if path.name.lower().endswith(".nii.gz") else path.suffix.lower()


def notes_path(source: Path) -> Path:
    """The .json beside a volume in which the user says what its file does not; that of a disc lies on it."""
    if source.is_file():
        return source.with_name(f"{source.name[: len(source.name) - len(suffix_of(source))]}.json")
    # A name for "." and "..", and no other: beside a link to a folder is where the link is.
    place = source.resolve() if source.name in ("", "..") else source
    return place.with_name(f"{place.name}.json") if place.name else place / "volume.json"
