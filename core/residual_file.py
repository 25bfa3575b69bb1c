"""Each splat's residual beside the .ply that it belongs to. Numpy alone."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from .files import atomic_write
from .fingerprint import fingerprint
from .volume import ARCHIVE_ERRORS

RESIDUAL_FILE = "residual.npz"
# Changes with what a residual is; files of before are then as good as none.
_DEFINITION = 1


def save_residuals(run: Path, percent: np.ndarray, ply: Path) -> None:
    """Writes `residual.npz` of a run folder, atomically.

    Args:
        percent: (N,) as `core.evaluate.residual.splat_residuals` has them, in the order of the .ply.
        ply: whose splats they are; the file holds its fingerprint, so that they are never taken for those of another.

    Raises:
        DiskFullError, RunFolderError: as `core.files.atomic_write`.
    """
    buffer = io.BytesIO()
    percent = np.asarray(percent, np.float32)
    np.savez_compressed(buffer, residual_percent=percent, fingerprint=fingerprint(ply), definition=_DEFINITION)
    with atomic_write(run / RESIDUAL_FILE) as stream:
        stream.write(buffer.getvalue())


def load_residuals(run: Path, ply: Path, count: int) -> np.ndarray | None:
    """(N,) float32 % of the splats of a .ply, NaN where no ray passed; None where the run folder has none of them.

    Args:
        ply: with the same content as the one they were saved with, wherever it lies.
        count: N, how many splats it holds.
    """
    try:
        with np.load(run / RESIDUAL_FILE, allow_pickle=False) as archive:
            percent = np.asarray(archive["residual_percent"], np.float32)
            same = str(archive["fingerprint"]) == fingerprint(ply) and int(archive["definition"]) == _DEFINITION
    except ARCHIVE_ERRORS:
        return None
    return percent if same and percent.shape == (count,) else None
