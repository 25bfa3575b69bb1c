"""Atomic writes: a file is either the old one or the whole new one, never half of it."""

from __future__ import annotations

import dataclasses
import errno
import json
import math
import os
import shutil
from collections.abc import Generator, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from .errors import DiskFullError, RunFolderError, SettingError

# Between two looks whether the disk is done.
_LOOK_S = 0.02
_FULL = (errno.ENOSPC, errno.EDQUOT)
_REFUSED = (
    errno.EACCES,
    errno.EPERM,
    errno.EROFS,
    errno.ENOTDIR,
    errno.EEXIST,
    errno.EISDIR,
    errno.ENAMETOOLONG,
    # A name that the file system does not take, and a disk that fails.
    errno.EINVAL,
    errno.EIO,
)
# Of Windows, to which Python gives the number of a file that is missing: no such folder or drive, no such name, a path
# that is too long.
_REFUSED_BY_WINDOWS = (3, 161, 206)


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
    with explained(path):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with open(temporary, mode, encoding=None if "b" in mode else "utf-8") as stream:
                yield stream
                stream.flush()
                os.fsync(stream.fileno())
            os.replace(temporary, path)
        finally:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)


def synced_in_steps(stream: IO[Any]) -> Generator[float, None, None]:
    """Brings what was written to an open file onto the disk, with breaks in which a thread waits for the disk.

    For the end of a block of `atomic_write`, whose own waiting takes no time then. The system does not tell the share
    that is done, which is 0 until all is. Closed early the file can be closed and deleted.

    Raises:
        OSError: the disk is full, or cannot be written to.
    """
    stream.flush()
    # Its own: the file may be closed while the thread waits.
    number = os.dup(stream.fileno())

    def sync() -> None:
        try:
            os.fsync(number)
        finally:
            os.close(number)

    threads = ThreadPoolExecutor(1, "insideout disk")
    try:
        syncing = threads.submit(sync)
        while not wait([syncing], _LOOK_S).done:
            yield 0.0
        syncing.result()
    finally:
        # Windows deletes no file that is open.
        threads.shutdown(wait=os.name == "nt")


def check_new(folder: Path) -> None:
    """Raises SettingError where a capture would hide or mix with something: `folder` must be missing or empty."""
    if folder.exists() and not folder.is_dir():
        raise SettingError("{folder}: is a file; choose another --out, nothing was changed.", folder=folder)
    if folder.is_dir() and any(folder.iterdir()):
        raise SettingError("{folder}: is not empty; choose another --out, nothing was changed.", folder=folder)


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Makes a temporary folder whose content is that of `path` when the block ends without an error.

    It lies beside `path`; in it where `path` is a disk of its own, or nothing may be written beside it. After an error
    nothing is left of it, and `path` is as it was: missing, or empty.

    Args:
        path: missing, or an empty folder, which stays the same one.

    Raises:
        DiskFullError: no space is left on the device.
        RunFolderError: the place cannot be written to, or something has come into `path` meanwhile.
    """
    path = path.resolve()
    within = path.is_dir() and (os.path.ismount(path) or not os.access(path.parent, os.W_OK))
    temporary = (path if within else path.parent) / f".{path.name}.{os.getpid()}.tmp"
    try:
        with explained(path):
            temporary.mkdir(parents=True)
        yield temporary
        with explained(path):
            if path.is_dir():
                if any(child != temporary for child in path.iterdir()):
                    raise FileExistsError(errno.EEXIST, "meanwhile there is something in it")
                # Someone may stand in it, or it may be another file system's.
                for child in sorted(temporary.iterdir()):
                    shutil.move(child, path / child.name)
            else:
                os.replace(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


@contextmanager
def explained(path: Path) -> Iterator[None]:
    """Turns what the system says about writing `path` into a sentence with advice.

    Raises:
        DiskFullError: no space is left on the device.
        RunFolderError: the place cannot be written to.
    """
    try:
        yield
    except OSError as error:
        if error.errno in _FULL:
            raise DiskFullError(
                "{path}: the disk is full; free some space and start again (a run goes on from its last "
                "checkpoint), or choose another folder.",
                path=path,
            ) from error
        if error.errno in _REFUSED or getattr(error, "winerror", None) in _REFUSED_BY_WINDOWS:
            raise RunFolderError(
                "{path}: cannot be written ({reason}); choose another place.", path=path, reason=error.strerror
            ) from error
        raise


@contextmanager
def exclusive(path: Path) -> Iterator[bool]:
    """Holds a lock on `path` for the block; False when another process holds it. A killed process lets go of it.

    Where the file system knows no locks, everyone gets it.
    """
    with ExitStack() as stack:
        with explained(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            stream = stack.enter_context(open(path, "ab"))
        yield _lock(stream)


def _lock(stream: IO[bytes]) -> bool:
    try:
        if os.name == "nt":
            import msvcrt

            stream.seek(0)
            msvcrt.locking(stream.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
        else:
            import fcntl

            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno not in (errno.EACCES, errno.EAGAIN, errno.EDEADLK)
    return True


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
