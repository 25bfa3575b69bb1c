"""What a capture's files are, in one number: the same digest, the same capture, wherever the folder lies."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path


def content_digest(path: Path) -> str:
    """SHA-256 of a file's content, hexadecimal."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def capture_digest(folder: Path, files: Iterable[Path]) -> str:
    """SHA-256 over the relative names, sizes and contents of the files used, in order of their names."""
    # Files from outside the folder may share a name: each counts.
    lines = [
        f"{_relative(path, folder)}\0{path.stat().st_size}\0{content_digest(path)}\n"
        for path in {path.resolve() for path in files}
    ]
    # Names from other systems may be bytes that are no UTF-8.
    return hashlib.sha256("".join(sorted(lines)).encode("utf-8", "surrogatepass")).hexdigest()


def _relative(path: Path, folder: Path) -> str:
    try:
        return path.resolve().relative_to(folder.resolve()).as_posix()
    except ValueError:
        return path.name
