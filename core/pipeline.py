"""The five stages in order, resumable: a capture folder in, a run folder out."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from .errors import DiskFullError, RunFolderError, SettingError
from .files import plain, write_json
from .progress import Progress, Reporter
from .run_folder import STAGES, RunFolder
from .settings import Settings, stage_module

# A draft run of a small capture leaves about 60 MB; starting with less would only fail later.
_LEAST_FREE_BYTES = 100 * 2**20

StageListener = Callable[[str, str, dict[str, Any]], None]


def reconstruct(
    capture: Path,
    out: Path,
    *,
    preset: str = "standard",
    stages: Sequence[str] = (),
    fresh: bool = False,
    seed: int = 0,
    kernel: str = "cpu",
    settings: Settings | None = None,
    reporter: Reporter | None = None,
    on_stage: StageListener | None = None,
) -> dict[str, Any]:
    """Runs the stages that are not done yet and writes the run's files and report.

    A stage that was killed goes on from its last checkpoint.

    Args:
        capture: the capture folder (see the README for its layout).
        out: the run folder; one that a killed run left is gone on with from its last checkpoint.
        preset: "draft", "standard" or "paper".
        stages: run only these, even if they are done already; what later stages left is then stale and redone
            by the next run of all stages. Empty: all that are missing.
        fresh: start over in a run folder that is there already.
        seed: of every random choice.
        kernel: which renderer kernels to use.
        settings: every knob of every stage, in place of `preset`, `seed` and `kernel`.
        reporter: progress out, cancel in.
        on_stage: called with the stage, "started", "done" or "skipped", and its report.

    Returns:
        The content of `report.json`; only the stages' reports when `stages` leaves some out.

    Raises:
        CaptureError, SettingError, RunFolderError, DiskFullError: the user's to mend; nothing of theirs changed.
        Cancelled: the user asked to stop; checkpoints are kept.
    """
    from .capture.read import read_capture
    from .stages.context import StageContext

    settings = settings or Settings.of(preset, seed, kernel)
    wanted = _ordered(stages)
    run = RunFolder(out)
    _refuse_nesting(Path(capture), run.path)
    reporter = reporter or Reporter()
    reporter.update(Progress("capture", message="reading the capture"))
    read = read_capture(Path(capture))
    reporter.update(Progress("capture", fraction=1.0))
    _check_space(run.path)
    run.claim(read.digest, Path(capture))
    _claim_settings(run, settings, fresh)
    context = StageContext(read, run, settings.seed, settings.kernel, _logging(reporter, run))
    tell = on_stage or (lambda *_: None)
    for stage in wanted or STAGES:
        if wanted or not run.is_done(stage):
            _run_stage(stage, context, settings.stages[stage], tell)
    if not all(run.is_done(stage) for stage in STAGES):
        return {"stages": {stage: run.report(stage) for stage in STAGES if run.is_done(stage)}}
    return _finish(context, settings, tell)


def _ordered(stages: Sequence[str]) -> list[str]:
    for stage in stages:
        if stage not in STAGES:
            raise SettingError(f"--stage {stage}: there is no such stage; choose {', '.join(STAGES)}.")
    return [stage for stage in STAGES if stage in stages]


def _refuse_nesting(capture: Path, out: Path) -> None:
    inner, outer = out.resolve(), capture.resolve()
    if inner == outer or inner.is_relative_to(outer / "photos") or inner.is_relative_to(outer / "xray"):
        raise RunFolderError(f"{out}: lies inside the capture; choose another --out, nothing was changed.")


def _check_space(folder: Path) -> None:
    existing = folder.resolve()
    while not existing.exists():
        existing = existing.parent
    if not existing.is_dir():
        raise RunFolderError(f"{existing}: is a file, not a folder; choose another --out.")
    free = shutil.disk_usage(existing).free
    if free < _LEAST_FREE_BYTES:
        raise DiskFullError(
            f"{folder}: only {free / 2**20:.0f} MB are free on its disk and a run needs "
            f"{_LEAST_FREE_BYTES / 2**20:.0f} MB or more; free some space or choose another --out."
        )


def _claim_settings(run: RunFolder, settings: Settings, fresh: bool) -> None:
    marker = run.path / "settings.json"
    current = plain(settings)
    if fresh:
        for stage in STAGES:
            _forget(run, stage)
    elif marker.exists():
        before = run.read_json(marker)
        for name in ("preset", "seed"):
            if before.get(name) != current[name]:
                raise RunFolderError(
                    f"{run.path}: was made with {name} {before.get(name)}, not {current[name]}; use another "
                    "--out, or --fresh to start over in this one."
                )
    write_json(marker, current)


def _forget(run: RunFolder, stage: str) -> None:
    """Marks a stage as not done and drops its checkpoints; its results stay until they are replaced."""
    folder = run.path / stage
    for name in [folder / "report.json", *folder.glob("*.checkpoint.pt")]:
        name.unlink(missing_ok=True)


def _run_stage(stage: str, context: Any, settings: Any, on_stage: StageListener) -> None:
    run: RunFolder = context.run
    module = stage_module(stage)
    for earlier in STAGES[: STAGES.index(stage)]:
        if not run.is_done(earlier):
            raise SettingError(f"--stage {stage}: needs the stage '{earlier}' first; run it, or run all stages.")
    if run.is_done(stage):
        _forget(run, stage)
    for later in STAGES[STAGES.index(stage) + 1 :]:
        _forget(run, later)
    reason = module.reason_to_skip(context)
    if reason:
        report = {"skipped": reason, "seconds": 0.0}
        write_json(run.stage(stage) / "report.json", report)
        on_stage(stage, "skipped", report)
        return
    on_stage(stage, "started", {})
    clock = _Clock(run.stage(stage) / "seconds.json")
    try:
        report = module.run(context, settings)
    finally:
        clock.stop()
    report = {**report, "seconds": clock.total, "settings": plain(settings)}
    write_json(run.stage(stage) / "report.json", report)
    for checkpoint in run.stage(stage).glob("*.checkpoint.pt"):
        checkpoint.unlink()
    clock.path.unlink(missing_ok=True)
    context.progress(stage, fraction=1.0)
    on_stage(stage, "done", report)


class _Clock:
    """Seconds spent on a stage, those before it was killed and resumed included."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._before = 0.0
        if path.exists():
            try:
                self._before = float(json.loads(path.read_text("utf-8")))
            except (OSError, ValueError, TypeError):
                self._before = 0.0
        self._start = time.monotonic()
        self.total = self._before

    def stop(self) -> None:
        self.total = self._before + time.monotonic() - self._start
        # A full disk must be told by the stage that met it, not hidden by the clock.
        if shutil.disk_usage(self.path.parent).free > 4096:
            write_json(self.path, self.total)


def _logging(reporter: Reporter, run: RunFolder) -> Reporter:
    """A reporter that also appends each progress to `log.jsonl`."""

    def listen(progress: Progress) -> None:
        try:
            with open(run.path / "log.jsonl", "a", encoding="utf-8") as stream:
                stream.write(json.dumps(plain({"time": round(time.time(), 2), **progress.to_json()})) + "\n")
        except OSError as error:
            raise RunFolderError(f"{run.path / 'log.jsonl'}: cannot be written ({error.strerror}).") from error
        reporter.update(progress)

    return Reporter(listen, reporter.is_cancelled)


def _finish(context: Any, settings: Settings, on_stage: StageListener) -> dict[str, Any]:
    from .report import write_report

    on_stage("report", "started", {})
    report = write_report(context, settings)
    on_stage("report", "done", report)
    return report
