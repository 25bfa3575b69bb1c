"""Atomic writes: a file is either the old one or the whole new one, never half of it."""

from __future__ import annotations

import dataclasses
import errno
import json
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from .errors import DiskFullError, RunFolderError


@contextmanager
def atomic_write(path: Path, mode: str = "wb") -> Iterator[IO[Any]]:
    """Opens a temporary file beside `path` and renames it over `path` when the block ends without an error.

    Args:
        path: the file to write; its folder is made when it is missing.
        mode: "wb" or "w" (UTF-8).

    Raises:
        DiskFullError: no space is left on the device. `path` keeps its old content.
        RunFolderError: the folder cannot be written to.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(temporary, mode, encoding=None if "b" in mode else "utf-8") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise DiskFullError(
                f"{path}: the disk is full; free some space or choose another folder with --out, "
                "then run the same command again to go on from the last checkpoint."
            ) from error
        if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR, errno.EEXIST):
            raise RunFolderError(
                f"{path}: cannot be written ({error.strerror}); choose another folder with --out."
            ) from error
        raise
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_json(path: Path, content: Any) -> None:
    """Writes `plain(content)` as indented JSON, atomically. Raises as `atomic_write`."""
    with atomic_write(path, "w") as stream:
        json.dump(plain(content), stream, indent=1, allow_nan=False)
        stream.write("\n")


def plain(value: Any) -> Any:
    """`value` with numpy and torch numbers, arrays, paths and dataclasses as plain JSON types.

    A number that is not finite becomes None, because JSON has no word for it.
    """
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item) for item in value]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return plain(dataclasses.asdict(value))
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
