"""One capture on which methods are compared, and the runs that they leave in its folder."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ... import __version__
from ..bench.machine import machine
from ..capture.digest import content_digest
from ..capture.model import Capture
from ..capture.registered import load_photos
from ..compiled import work_clock
from ..errors import Cancelled, RunFolderError
from ..files import plain, write_json
from ..pipeline import reconstruct
from ..progress import Progress, Reporter
from ..resume import CHECKPOINTS, Clock, follow_landmarks, forget, forget_changed
from ..run_folder import STAGES, RunFolder
from ..settings import Settings
from ..similarity import Similarity
from ..train.budget import TooLong, iterations_in_time, last_number
from ..volume import Volume
from .code import first_by_other_code, other_code
from .methods import METHODS, MeshJob, Method, VolumeJob
from .sharing import CODE_FILE, Wanted, read_dict, share
from .truth import Truth

if TYPE_CHECKING:
    import trimesh

_REFERENCE = "insideout"
# What is in a capture's folder from the first use on, and in a row's from its beginning or its end on.
_MARK = "comparison.json"
_ROW_FILES = ("capture.json", "started.json", "report.json", "figures.json")
FOUND_FRAME = "the similarity that the run found"
"""By which photo rows are brought to mm where the true one is not known."""
FIGURES = 7
"""To be raised where a row's figures are measured in another way: what was kept is measured anew. Where a method makes
something else than before, see `code.CODE`."""


@dataclass(frozen=True, eq=False)
class Made:
    """What a method left of a capture.

    Attributes:
        method, folder: whose and where.
        report: of the run, or what was noted of a volume or mesh: at least `seconds`.
        budget: how its iterations were chosen, if they were.
    """

    method: Method
    folder: Path
    report: dict[str, Any]
    budget: dict[str, Any] | None = None

    @property
    def run(self) -> RunFolder:
        return RunFolder(self.folder)

    @property
    def seconds(self) -> float:
        return float(self.report["seconds"])

    @property
    def xray_seconds(self) -> float | None:
        """What was spent on fitting X-rays; None where nothing was, and for FDK and SART, which are not timed apart.

        Of a run: `surface`'s X-ray half, and of `internal` the radiative splats' own refinement or the joint one's
        steps on projections and sections, but not learning display opacities. Of a method that leaves voxels and goes
        by time: its last try. By `work_clock`: compiling kernels, which `seconds` may hold, is left out.
        """
        stages = self.report.get("stages") or {}
        places = (
            ("surface", "xray", "seconds"),
            ("internal", "xray", "seconds"),
            ("internal", "joint", "xray_seconds"),
        )
        parts = [((stages.get(stage) or {}).get(part) or {}).get(name) for stage, part, name in places]
        found = [float(seconds) for seconds in parts if seconds is not None]
        if not found and self.budget and self.budget["tries"]:
            found = [float(self.budget["tries"][-1][1])]
        return sum(found) if found else None

    def volume(self) -> Volume:
        """Of a method that reconstructs voxels. Raises CaptureError."""
        return Volume.load(self.folder / "volume.npz")

    def mesh(self) -> trimesh.Trimesh:
        """Of a method that makes a mesh, in the photo frame."""
        import trimesh

        loaded = trimesh.load(self.folder / "mesh.ply", process=False)
        # A file without faces is read as a scene or as points.
        return loaded if isinstance(loaded, trimesh.Trimesh) else trimesh.Trimesh()


@dataclass(frozen=True, eq=False)
class Study:
    """A capture under comparison.

    Attributes:
        capture: all of it.
        folder: holds one folder for each method.
        settings: the preset that methods change.
        truth: what models are measured against; None for photos alone.
        reporter: progress out, cancel in.
        same_time: give methods that go by time the X-ray seconds of the InsideOut row.
        fuller: the study of more projections, whose iterations a method that goes by time begins with.
    """

    capture: Capture
    folder: Path
    settings: Settings
    truth: Truth | None
    reporter: Reporter
    same_time: bool = True
    fuller: Study | None = None

    @property
    def name(self) -> str:
        return self.folder.name

    def make(self, method: Method) -> Made:
        """Runs a method, or what is missing of it; a finished one whose settings and code are the same is left as it
        is.

        Raises:
            CaptureError, SettingError, RunFolderError, DiskFullError: the user's to mend.
            Cancelled: the user asked to stop; the next call goes on.
        """
        if method.volume is not None or method.mesh is not None:
            return self._make_kept(method)
        settings, budget = method.change(self.settings), None
        folder, half = self.folder / method.name, self._half(method)
        if method.for_count is not None:
            settings = method.for_count(settings, max(self.make(METHODS["3dgs"]).report["splats"]["final"], 1))
        if method.for_iterations is not None:
            budget = self._budget(method, method.for_iterations, folder)
            settings = method.for_iterations(settings, budget["iterations"])
        seen = self.seen_by(method)
        report = self.run(folder, seen, settings, method.leave_out, method.label, half=half, code=method.code)
        return Made(method, folder, report, budget)

    def run(
        self,
        folder: Path,
        capture: Capture,
        settings: Settings,
        leave_out: Sequence[str] = (),
        title: str = "",
        stages: Sequence[str] = STAGES,
        half: str = "",
        code: Mapping[str, int] | None = None,
    ) -> dict[str, Any]:
        """A resumable pipeline run in `folder`; stages that a sibling made with the same settings are copied.

        Args:
            title: what progress calls it.
            stages: stops after the last of these.
            half: "photos" or "xray" where `capture` is that half of the study's.
            code: numbers of the code that makes it, see `code.CODE`: what other code made is made anew.

        Returns:
            report.json; only the stages' reports when some are missing.
        """
        run = RunFolder(folder)
        claimed = (read_dict(folder / "capture.json") or {}).get("digest", "")
        if claimed != capture.digest and claimed.startswith(self._with_cameras("")):
            # A row of a comparison, with cameras that were found anew since. What is another's, `claim` refuses.
            shutil.rmtree(folder)
        run.claim(capture.digest, capture.path)
        forget_changed(run, settings)
        _forget_other_code(run, code or {})
        # What comes after a stage that is left out differs from all that had it.
        kept = list(itertools.takewhile(lambda stage: stage not in leave_out, stages))
        follow_landmarks(run, capture.landmarks, ())
        whole = self.capture.digest
        share(Wanted(run, capture.digest, settings, kept, half, whole, capture.landmarks, code or {}), self.folder)
        finished = folder / "report.json"
        if finished.exists() and _left_out(run) == sorted(set(leave_out)):
            return run.read_json(finished)
        reporter = titled(self.reporter, f"{self.name}, {title}")
        if tuple(stages) == STAGES:
            return reconstruct(capture, folder, settings=settings, leave_out=leave_out, reporter=reporter)
        missing = [stage for stage in stages if not run.is_done(stage)]
        if missing:
            reconstruct(capture, folder, settings=settings, stages=missing, leave_out=leave_out, reporter=reporter)
        return {"stages": {stage: run.report(stage) for stage in stages}}

    def seen_by(self, method: Method) -> Capture:
        """The part of the capture that a method sees; photos with the cameras that the InsideOut row found, so that
        all rows share a photo frame."""
        capture, kept = self.capture, self.folder / _REFERENCE / "initialize" / "photos.json"
        others = method.name != _REFERENCE and method.modality != "xray"
        if self.truth is None:
            # There is no frame to share: a row keeps the cameras that it found before the InsideOut row did.
            begun = read_dict(self.folder / method.name / "capture.json") or {}
            others = others and begun.get("digest") not in (capture.digest, capture.photos_only().digest)
        elif capture.photos is not None and not capture.photos.posed and others:
            # Which measures them in its frame in any case.
            self.reference()
        if capture.photos is not None and not capture.photos.posed and others and kept.exists():
            found = load_photos(kept)
            known = [photo for photo in found.photos if photo.camera is not None]
            digest = self._with_cameras(content_digest(kept)[:12])
            capture = replace(capture, photos=replace(found, photos=known), digest=digest)
        return {"photos": capture.photos_only, "xray": capture.xrays_only, "both": lambda: capture}[method.modality]()

    def _with_cameras(self, found: str) -> str:
        """The digest of the capture with cameras that the InsideOut row found: no run outside a comparison has one."""
        return f"{self.capture.digest}, cameras {found}"

    def reference(self) -> Made:
        """The InsideOut row, made if it is missing."""
        return self.make(METHODS[_REFERENCE])

    def photo_frame(self) -> tuple[Similarity, str] | None:
        """Photo frame to mm and where it is from: the truth where the cameras are given, else `align`'s."""
        photos = self.capture.photos
        if photos is None or self.truth is None:
            return None
        if self.truth.similarity is not None and photos.posed:
            return self.truth.similarity, "the true similarity"
        found = self.reference().report.get("similarity")
        return None if found is None else (Similarity.from_json(found), FOUND_FRAME)

    def _make_kept(self, method: Method) -> Made:
        """A method that leaves a volume or a mesh in place of a run."""
        folder = self.folder / method.name
        capture = self.seen_by(method)
        seconds = self.reference().xray_seconds if method.by_time and self.same_time else None
        source = self.make(METHODS[method.after]) if method.after else None
        made_with = plain(
            {
                "digest": capture.digest,
                "preset": self.settings.preset,
                "seed": self.settings.seed,
                "kernel": self.settings.kernel,
                "version": __version__,
                "own": None if method.own is None else method.own(),
                "code": method.code,
                "seconds_allowed": seconds,
                "at_centers": self.truth is not None and self.truth.at_centers,
                "after": None if source is None else source.report["stages"],
            }
        )
        path = folder / "report.json"
        kept = read_dict(path)
        if kept is not None and _made_alike(kept.get("made_with"), made_with):
            return Made(method, folder, kept, kept.get("budget"))
        started = read_dict(folder / "started.json")
        if started is None and folder.is_dir() and any(not file.name.startswith(".") for file in folder.iterdir()):
            raise RunFolderError(f"{folder}: holds files of something else; choose another --out, nothing was changed.")
        if not _made_alike(started, made_with):
            shutil.rmtree(folder, ignore_errors=True)
            write_json(folder / "started.json", made_with)
        if not any(folder.glob(CHECKPOINTS)):
            # It begins anew, and what was lost is no part of it.
            (folder / "seconds.json").unlink(missing_ok=True)
        clock = Clock(folder / "seconds.json")
        try:
            budget = self._make_file(method, folder, capture, seconds, source, clock)
        finally:
            clock.save()
        # Tries before the last are no part of the method.
        own = float(budget["tries"][-1][1]) if budget else clock.total
        report = {"seconds": own + (source.seconds if source else 0.0), "budget": budget, "made_with": made_with}
        write_json(path, report)
        for checkpoint in folder.glob(CHECKPOINTS):
            checkpoint.unlink()
        return Made(method, folder, plain(report), budget)

    def _make_file(
        self, method: Method, folder: Path, capture: Capture, seconds: float | None, source: Made | None, clock: Clock
    ) -> dict[str, Any] | None:
        """Writes the volume or mesh; returns the budget of a method that goes by time."""
        shown = titled(self.reporter, f"{self.name}, {method.label}")

        def pass_on(progress: Progress) -> None:
            clock.save_now_and_then()
            shown.update(progress)

        reporter = Reporter(pass_on, shown.is_cancelled)
        if method.volume is not None:
            first = self.folder / _REFERENCE / "initialize" / "volume.npz"
            old = other_code(read_dict(self.folder / _REFERENCE / CODE_FILE) or {}, METHODS["fdk"].code)
            start = Volume.load(first) if first.exists() and not old else None
            at_centers = self.truth is not None and self.truth.at_centers
            job = VolumeJob(capture, folder, self.settings, seconds, start, reporter, at_centers)
            made = method.volume(job)
            made.volume.save(folder / "volume.npz")
            return made.budget
        elif method.mesh is not None and source is not None:
            _save_mesh(method.mesh(MeshJob(source.run, folder, self.settings, reporter)), folder / "mesh.ply")
        return None

    def _half(self, method: Method) -> str:
        """The half that a method sees, where cameras are the same in all runs."""
        photos = self.capture.photos
        found_anew = method.modality == "photos" and photos is not None and not photos.posed
        return "" if method.modality == "both" or found_anew else method.modality

    def _budget(
        self, method: Method, for_iterations: Callable[[Settings, int], Settings], folder: Path
    ) -> dict[str, Any]:
        """How many iterations take the InsideOut row's X-ray seconds; its own number without `same_time`."""
        usual = self.settings.stages["surface"].xray.iterations
        seconds = self.reference().xray_seconds if self.same_time else None
        if not seconds:
            return {"iterations": method.published or usual, "seconds": None, "tries": []}

        if first_by_other_code(read_dict(folder / CODE_FILE) or {}, method.code) == 0:
            # Its tries took the seconds of that code.
            self._tries(method).unlink(missing_ok=True)

        def taken(count: int, longest: float) -> float:
            settings, title = for_iterations(self.settings, count), f"{method.label}, {count} iterations"
            stages, half = ("initialize", "surface"), self._half(method)
            watch = _Watch(self.reporter, count, longest)
            study = replace(self, reporter=Reporter(watch.see, watch.is_cancelled, self.reporter.seconds))
            try:
                report = study.run(folder, self.seen_by(method), settings, (), title, stages, half, method.code)
            except Cancelled as error:
                if watch.would_take is None:
                    raise
                raise TooLong(watch.would_take) from error
            return float(report["stages"]["surface"]["xray"]["seconds"])

        def first() -> int:
            # A card's kernels that this method alone takes are compiled here, and not in a try.
            taken(2, math.inf)
            found = last_number(self.fuller._tries(method)) if self.fuller else None
            return found or usual

        return iterations_in_time(seconds, first, taken, self._tries(method), for_iterations(self.settings, usual))

    def _tries(self, method: Method) -> Path:
        return self.folder / "tries" / f"{method.name}.json"


class _Watch:
    """Ends a run whose X-ray half takes too long, told from what it reports.

    Args:
        reporter: hears of the run, and may cancel it, too.
        iterations: of the X-ray half.
        longest: seconds of those.

    Attributes:
        would_take: seconds of all iterations at the pace at which the run was ended; None if it was not.
    """

    def __init__(self, reporter: Reporter, iterations: int, longest: float) -> None:
        self._reporter, self._iterations, self._longest = reporter, iterations, longest
        self._first: tuple[int, float] | None = None
        self.would_take: float | None = None

    def see(self, progress: Progress) -> None:
        self._reporter.update(progress)
        if progress.part != "surface xray" or not 0 < progress.iteration < self._iterations:
            return
        now = work_clock()
        if self._first is None:
            self._first = (progress.iteration, now)
        made, spent = progress.iteration - self._first[0], now - self._first[1]
        if spent > self._longest and made > 0:
            self.would_take = spent * self._iterations / made

    def is_cancelled(self) -> bool:
        return self.would_take is not None or self._reporter.is_cancelled()


def titled(reporter: Reporter, title: str) -> Reporter:
    """A reporter that shows a whole run as one piece of work called `title`."""
    steps = (*STAGES, "report")

    def pass_on(progress: Progress) -> None:
        first = steps.index(progress.stage) if progress.stage in steps else 0
        share = (first + min(max(progress.fraction, 0.0), 1.0)) / len(steps) if progress.stage in steps else 0.0
        part = " ".join(filter(None, (progress.stage, progress.part)))
        reporter.update(replace(progress, stage=title, part=part, fraction=share, heldout_psnr=None, heldout=None))

    return Reporter(pass_on, reporter.is_cancelled)


def machine_of(made: Made) -> dict[str, Any]:
    """What `bench.machine.machine` told when a row was made, kept beside it: its figures may be measured elsewhere."""
    path, of = made.folder / "machine.json", plain([made.seconds, made.budget])
    kept = read_dict(path)
    if kept is None or kept.get("of") != of:
        kept = {"of": of, "machine": machine()}
        write_json(path, kept)
    found: dict[str, Any] = kept["machine"]
    return found


def kept_figures(path: Path, made_with: Any, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What `make` returns, as plain JSON, kept in `path` until `made_with` or `FIGURES` changes."""
    content = json.dumps(plain({"of": made_with, "version": __version__, "figures": FIGURES}), sort_keys=True)
    stamp = hashlib.sha256(content.encode()).hexdigest()
    kept = read_dict(path)
    if kept is not None and kept.get("made_with") == stamp:
        return kept["figures"]
    figures = plain(make())
    write_json(path, {"made_with": stamp, "figures": figures})
    return figures


def _forget_other_code(run: RunFolder, code: Mapping[str, int]) -> None:
    """Marks what other code made of a run as not done, and notes by which code it is made now."""
    marker = run.path / CODE_FILE
    first = first_by_other_code(read_dict(marker) or {}, code)
    if first is not None:
        (run.path / "report.json").unlink(missing_ok=True)
        for stage in STAGES[first:]:
            forget(run, stage)
    write_json(marker, {"code": code})


def _made_alike(before: Any, made_with: dict[str, Any]) -> bool:
    """Whether a volume or mesh was made so; those from before there was `code.CODE` do not tell its numbers."""
    if not isinstance(before, dict) or other_code(before, made_with["code"]):
        return False
    return {**before, "code": made_with["code"]} == made_with


def _left_out(run: RunFolder) -> list[str]:
    return sorted(stage for stage in STAGES if run.is_done(stage) and run.report(stage).get("left_out"))


def _save_mesh(mesh: trimesh.Trimesh, path: Path) -> None:
    from ..files import atomic_write

    with atomic_write(path) as stream:
        stream.write(mesh.export(file_type="ply"))


def study_folder(out: Path, capture: Capture) -> Path:
    """Where the runs of a capture go. Raises RunFolderError if its name cannot be a folder's."""
    name = capture.path.resolve().name
    if not name:
        raise RunFolderError(f"{capture.path}: has no name; give the capture's own folder.")
    return out / name


def refuse_foreign(folder: Path) -> None:
    """Refuses a folder for a capture's runs that is neither missing nor empty nor a comparison's.

    A comparison's is marked, or has a row or a reference in it: those begun before there was the mark go on.

    Raises:
        RunFolderError: it holds files of something else.
    """
    if not folder.is_dir() or all(file.name.startswith(".") for file in folder.iterdir()):
        return
    if (folder / _MARK).exists() or any(folder.glob("reference *.npz")):
        return
    if not any((folder / name / file).exists() for name in METHODS for file in _ROW_FILES):
        raise RunFolderError(f"{folder}: holds files of something else; choose another --out, nothing was changed.")


def mark(folder: Path) -> None:
    """Says that a folder is a comparison's. Raises RunFolderError, DiskFullError."""
    if not (folder / _MARK).exists():
        write_json(folder / _MARK, {"holds": "the rows of insideout compare"})
