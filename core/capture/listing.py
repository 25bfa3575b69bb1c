"""What lies in a capture's folders."""

from __future__ import annotations

from pathlib import Path


def shown_files(folder: Path) -> list[Path]:
    """Files of a folder by name, without hidden ones: on disks of other systems a Mac puts `._scan.tif` beside each
    `scan.tif`, which holds no image."""
    return sorted(path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
