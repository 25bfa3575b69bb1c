"""Numba's `njit`, with machine code on disk that is never older than the kernels' sources.

Numba keeps what it compiled until the file of the function changes. It does not look at helpers and constants from
other files, so after an upgrade kernels would go on with what these were before, and give other numbers without a word.
Here all files that kernels are made of count: where any changed, code of before is deleted as soon as a kernel of that
folder is defined, and compiled anew.
"""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba import prange

from .files import atomic_write

__all__ = ["njit", "prange"]

CORE = Path(__file__).parent
SOURCES = (
    "compare/nearest.py",
    "effects/blur.py",
    "mesh/tsdf.py",
    "naf/hash_grid.py",
    "phantoms/distance_grid.py",
    "phantoms/part_tables.py",
    "phantoms/solid_table.py",
    "stages/align/silhouettes.py",
    "stages/surface/photos.py",
    "train/activation.py",
    "train/adam.py",
    "train/losses.py",
    "train/ssim.py",
    "train/strategy.py",
)
"""Files with kernels, or with numbers that they are compiled with; beside these all in `FOLDERS`."""

FOLDERS = ("render/kernels/cpu", "render/kernels/reference")

_MARK = "insideout-kernels.sha256"


def njit(*function: Any, **options: Any) -> Any:
    """`numba.njit`, as a decorator or with options; see there."""
    if function:
        return numba.njit(*function, **options)

    def compiled(one: Any) -> Any:
        kernel = numba.njit(**options)(one)
        if options.get("cache"):
            renew(Path(kernel.stats.cache_path))
        return kernel

    return compiled


@cache
def renew(folder: Path) -> None:
    """Deletes the machine code of this project's kernels in a folder of Numba's, where it is of other sources.

    Two processes may do so at once: Numba compiles what it does not find.

    Raises:
        OSError: it cannot be deleted.
    """
    mark, now = folder / _MARK, _digest()
    try:
        if mark.read_text("ascii") == now:
            return
    except (OSError, ValueError):
        pass
    for path in [*folder.glob("*.nbi"), *folder.glob("*.nbc")]:
        path.unlink(missing_ok=True)
    with atomic_write(mark, "w") as stream:
        stream.write(now)


@cache
def _digest() -> str:
    found = hashlib.sha256()
    inside = (path for name in FOLDERS for path in sorted((CORE / name).glob("*.py")))
    for path in [*(CORE / name for name in SOURCES), *inside]:
        found.update(str(path.relative_to(CORE)).encode() + b"\0" + path.read_bytes() + b"\0")
    return found.hexdigest()
