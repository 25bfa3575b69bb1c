"""The scan that a model was made from: the user's volume, or the usual CT reconstruction of the projections."""

from __future__ import annotations

import os
from collections.abc import Generator
from functools import lru_cache
from pathlib import Path

import bpy

from ...core.densities import Densities
from ...core.errors import CaptureError
from ...core.steps import run_through
from ...core.volume import Volume, densities_of
from .provenance import was_imported_from_a_run
from .sources import run_of, source_path

# Where a run keeps it.
_FILE = Path("initialize") / "volume.npz"


class _KeptVolume:
    """The volume that was read last; read again when another one is asked for or the file has changed."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forgets it."""
        self._stamp: tuple[Path, int] | None = None
        self._volume: Volume | None = None

    def holds(self, model: bpy.types.Object) -> bool:
        """Whether `of` has nothing to read: the volume is here already."""
        try:
            path = volume_path(model)
            return self._volume is not None and self._stamp == (path, path.stat().st_mtime_ns)
        except (CaptureError, OSError):
            return False

    def of(self, model: bpy.types.Object) -> Volume:
        """The volume of the run that a model was imported from, in the model's frame (mm).

        Raises:
            CaptureError: the run is not there any more, or has no volume.
        """
        return run_through(self.of_in_steps(model))

    def of_in_steps(self, model: bpy.types.Object) -> Generator[float, None, Volume]:
        """As `of`, with breaks that tell the share that is done; closed before its end what was kept is still that."""
        path = volume_path(model)
        stamp = (path, path.stat().st_mtime_ns)
        if self._volume is None or stamp != self._stamp:
            self._volume, self._stamp = (yield from Volume.load_in_steps(path)), stamp
        return self._volume


def volume_path(model: bpy.types.Object) -> Path:
    """Where the volume of a model's run is.

    Raises:
        CaptureError: there is none.
    """
    source = source_path(model)
    if source is not None and was_imported_from_a_run(model, source) and os.path.isfile(run_of(source) / _FILE):
        return run_of(source) / _FILE
    raise CaptureError(
        "{model}: its run has no CT volume here ({file}); bring the run folder back.",
        model=model.name,
        file=_FILE.as_posix(),
    )


def has_volume(model: bpy.types.Object | None) -> bool:
    """Whether there is a CT volume to show beside a model."""
    try:
        return model is not None and volume_path(model) is not None
    except CaptureError:
        return False


def scan_densities(model: bpy.types.Object) -> Densities:
    """What the densities of the volume of a model's run are in, which may be other than the model's.

    Raises:
        CaptureError: as `volume_path`, or the file is damaged.
    """
    path = volume_path(model)
    return _densities(path, path.stat().st_mtime_ns)


@lru_cache(maxsize=1)
def _densities(path: Path, _changed_ns: int) -> Densities:
    """Kept, for a picture that follows a plane is drawn many times a second."""
    return densities_of(path)


kept_volume = _KeptVolume()
