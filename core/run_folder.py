"""The run folder: where every stage leaves its files, and what lets a killed run go on."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from .densities import PER_MM
from .errors import GaussianFileError, RunFolderError
from .files import exclusive, write_json
from .gaussians import GaussianSet
from .ply import read_header
from .similarity import Similarity
from .volume import Volume

STAGES = ("initialize", "surface", "align", "internal", "fuse")


class RunFolder:
    """Paths and atomic reads and writes of one run.

    A stage is done when its `report.json` is there; it is written last.

    Attributes:
        path: the folder, made on first write.
        densities: what those of the run's capture are in, which its files tell.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self.densities = PER_MM

    def claim(self, digest: str, capture: Path) -> None:
        """Ties the folder to a capture, or checks that it is tied to this one already.

        Args:
            digest: the capture's digest.

        Raises:
            RunFolderError: the folder belongs to another capture, or holds files of something else.
        """
        marker = self.path / "capture.json"
        if marker.exists():
            known = self.read_json(marker)
            if known.get("digest") != digest:
                raise RunFolderError(
                    "{path}: holds the run of another capture ({other}), or this one has "
                    "changed since; choose another run folder, or delete this one if it is no longer needed.",
                    path=self.path,
                    other=known.get("path"),
                )
            return
        if self.path.is_dir() and any(p for p in self.path.iterdir() if not p.name.startswith(".")):
            raise RunFolderError(
                "{path}: is not empty and is not a run folder; choose another run folder, nothing was changed.",
                path=self.path,
            )
        write_json(marker, {"digest": digest, "path": str(Path(capture).resolve())})

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keeps the folder to this process for the block.

        Raises:
            RunFolderError: another run is writing to it.
        """
        with exclusive(self.path / ".lock") as ours:
            if not ours:
                raise RunFolderError(
                    "{path}: another run is writing here; wait for it to end, or choose another run folder.",
                    path=self.path,
                )
            self._drop_halves()
            yield

    def _drop_halves(self) -> None:
        """Files that a killed run was writing; see `files.atomic_write`."""
        for half in self.path.rglob(".*.tmp"):
            with suppress(OSError):
                half.unlink()

    def stage(self, name: str) -> Path:
        """The folder of a stage (one of STAGES), made if missing."""
        folder = self.path / name
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def is_done(self, stage: str) -> bool:
        """Whether the stage has finished."""
        return (self.path / stage / "report.json").exists()

    def has_set(self, stage: str, name: str) -> bool:
        """Whether the stage left `name`.ply ("rgb", "xray", "joint" or "fused"); what an earlier run left of a stage
        that was skipped since does not count."""
        skipped = self.is_done(stage) and "skipped" in self.report(stage)
        return (self.path / stage / f"{name}.ply").exists() and not skipped

    def read_set(self, stage: str, name: str) -> GaussianSet:
        """The GaussianSet that a stage left. Raises GaussianFileError."""
        return GaussianSet.load(self.path / stage / f"{name}.ply")

    def splats(self) -> dict[str, int]:
        """How many splats `initialize` and `surface` left of each half, by "stage half", if they are done: other sets
        are of an earlier run. Files that are no sets of splats do not count."""
        found = {}
        for stage in filter(self.is_done, STAGES[:2]):
            for half in ("rgb", "xray"):
                with suppress(GaussianFileError, OSError):
                    if self.has_set(stage, half):
                        found[f"{stage} {half}"] = read_header(self.path / stage / f"{half}.ply")[0]
        return found

    def write_set(self, stage: str, name: str, gaussians: GaussianSet) -> None:
        """Leaves a GaussianSet as `name`.ply of a stage."""
        gaussians.save(self.stage(stage) / f"{name}.ply", self.densities)

    def read_json(self, path: Path) -> Any:
        """Reads a JSON file of the run. Raises RunFolderError when it is missing or damaged."""
        try:
            return json.loads(path.read_text("utf-8"))
        except (OSError, ValueError) as error:
            raise RunFolderError(
                "{path}: cannot be read ({error}); delete it and run its stage again.", path=path, error=error
            ) from error

    def report(self, stage: str) -> dict[str, Any]:
        """The report of a finished stage."""
        return self.read_json(self.path / stage / "report.json")

    def similarity(self) -> Similarity:
        """x_mm = scale · R · x_photo + t, as `align` found it, or as `internal` refined it with everything else."""
        refined = self.report("internal").get("similarity") if self.is_done("internal") else None
        return Similarity.from_json(refined or self.report("align")["similarity"])

    def volume(self) -> Volume:
        """The volume that `initialize` left: the user's, or the FDK of the training projections."""
        return Volume.load(self.path / "initialize" / "volume.npz")
