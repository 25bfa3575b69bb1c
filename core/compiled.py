"""Numba's `njit`, with machine code on disk that goes by all that kernels are made of.

Numba keeps what it compiled until the file of the function changes. It does not look at helpers and constants from
other files, so after an upgrade kernels would go on with what these were before, and give other numbers without a word.
Here code is kept under a name with a digest of all those files: what is of other sources is never found, and deleted.
"""

from __future__ import annotations

import hashlib
import time
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba import prange
from numba.core import event

__all__ = ["njit", "prange", "work_clock"]

CORE = Path(__file__).parent
SOURCES = (
    "compare/nearest.py",
    "effects/blur.py",
    "mesh/tsdf.py",
    "naf/hash_grid.py",
    "phantoms/distance_grid.py",
    "phantoms/part_tables.py",
    "phantoms/solid_table.py",
    "spherical_harmonics.py",
    "stages/align/silhouettes.py",
    "stages/surface/photos.py",
    "threads.py",
    "train/activation.py",
    "train/adam.py",
    "train/losses.py",
    "train/ssim.py",
    "train/strategy.py",
)
"""Files with kernels, or with numbers that they are compiled with; beside these all in `FOLDERS`."""

FOLDERS = ("render/kernels/cpu", "render/kernels/reference")

_compiling = event.TimingListener()
event.register("numba:compiler_lock", _compiling)


def work_clock() -> float:
    """A clock in seconds that leaves out what Numba takes to compile kernels or to load them from disk.

    What a machine does once is no part of what a training takes: the first 40 steps on a small capture took 49 s, and
    rows that get a first row's seconds got that many more. To be read before and after in the thread that compiles: it
    goes back when a kernel is ready. What Warp compiles for a card counts.
    """
    return time.perf_counter() - (_compiling.duration if _compiling.done else 0.0)


def njit(*function: Any, **options: Any) -> Any:
    """`numba.njit`, as a decorator or with options; see there.

    Raises:
        ValueError: code is to be kept of something other than a function below the decorator.
    """
    if not options.get("cache"):
        return numba.njit(*function, **options)
    if function:
        raise ValueError("njit: what is kept on disk is decorated with options alone, as in @njit(cache=True)")

    def compiled(one: Any) -> Any:
        one.__qualname__ = f"{one.__qualname__}_{_digest()}"
        kernel = numba.njit(**options)(one)
        # Under NUMBA_DISABLE_JIT it is the function itself.
        if hasattr(kernel, "stats"):
            _tidy(Path(kernel.stats.cache_path))
        return kernel

    return compiled


@cache
def _tidy(folder: Path) -> None:
    """Deletes machine code of other sources in a folder of Numba's. A process that still runs with these compiles what
    it misses."""
    for path in [*folder.glob("*.nbi"), *folder.glob("*.nbc")]:
        if _digest() not in path.name:
            # Windows does not delete what another process reads.
            with suppress(OSError):
                path.unlink()


@cache
def _digest() -> str:
    found = hashlib.sha256()
    inside = (path for name in FOLDERS for path in sorted((CORE / name).glob("*.py")))
    for path in [*(CORE / name for name in SOURCES), *inside]:
        found.update(str(path.relative_to(CORE)).encode() + b"\0" + path.read_bytes() + b"\0")
    return found.hexdigest()[:12]
