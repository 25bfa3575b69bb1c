"""The five stages in order, resumable: a capture folder in, a run folder out."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .capture.kept_back import photos_kept_back, projections_kept_back
from .endings import cannot_tell
from .errors import SettingError
from .files import explained, plain, write_json
from .progress import Progress, Reporter
from .render.card import require_card
from .resume import (
    CHECKPOINTS,
    Clock,
    RunClock,
    check_order,
    check_space,
    claim_settings,
    follow_landmarks,
    forget,
    refuse_nesting,
    start_over_if_changed,
    staying,
)
from .run_folder import STAGES, RunFolder
from .settings import Settings, stage_module
from .told import Told

if TYPE_CHECKING:
    from .capture.model import Capture
    from .effects.request import Request
    from .stages.context import StageContext
    from .train.schedule import Until

StageListener = Callable[[str, str, dict[str, Any]], None]


def reconstruct(
    capture: Path | Capture,
    out: Path,
    *,
    preset: str | None = None,
    stages: Sequence[str] = (),
    leave_out: Sequence[str] = (),
    fresh: bool = False,
    seed: int = 0,
    kernel: str = "cpu",
    refine: str = "joint",
    settings: Settings | None = None,
    time_budget_s: float | None = None,
    until_db: float | None = None,
    effects: str = "none",
    reporter: Reporter | None = None,
    on_stage: StageListener | None = None,
) -> dict[str, Any]:
    """Runs the stages that are not done yet and writes the run's files and report.

    A stage that was killed goes on from its last checkpoint.

    Args:
        capture: the capture folder (see docs/captures.md for its layout), or what was read of one, in part perhaps.
        out: the run folder; one that a killed run left is gone on with from its last checkpoint.
        preset: "draft", "standard" or "paper"; None for "standard", with `time_budget_s` for what fits it best.
        stages: run only these, even if they are done already; what later stages left is then stale and redone
            by the next run of all stages. Empty: all that are missing.
        leave_out: stages that the run does without; a run that had them, or lacked them, before is redone from there.
        fresh: start over in a run folder that is there already.
        seed: of every random choice.
        kernel: what draws: "cpu", "cuda" (an NVIDIA card; what is not drawing stays on the processor) or "reference".
        refine: "joint" or "apart", see `Settings.of`.
        settings: every knob of every stage, in place of `preset`, `seed`, `kernel`, `refine` and the next three.
        time_budget_s: what the whole run is to take: steps are fewer, or more, than the preset's. On a machine whose
            kernels are not compiled yet that counts, too.
        until_db: each optimisation ends when held-out photos, of X-rays alone projections, reach this PSNR, or when
            its curve says that they will not.
        effects: what a capture shows besides the object and is to be looked for or used: "auto", "none", names with
            commas between, or "auto,-name"; see `core.effects.request.parse_effects`.
        reporter: progress out, cancel in.
        on_stage: called with the stage, "started", "done", "skipped" or (done before) "kept", and its report.

    Returns:
        The content of `report.json`; only the stages' reports when `stages` leaves some out.

    Raises:
        CaptureError, SettingError, RunFolderError, DiskFullError: the user's to mend; nothing of theirs changed. A
            run folder that another run is writing is refused, too.
        Cancelled: the user asked to stop; checkpoints are kept.
    """
    from .stages.context import StageContext

    begun, choose = time.monotonic(), settings is None and preset is None
    if settings is None:
        settings = Settings.of(preset or "standard", seed, kernel, refine)
        settings = replace(settings, time_budget_s=time_budget_s, until_db=until_db, effects=effects)
    if settings.kernel == "cuda":
        require_card()
    wanted = _ordered(stages)
    _ordered(leave_out)
    run = RunFolder(out)
    reporter = reporter or Reporter()
    read = _read(capture, run, reporter)
    run.densities = read.densities
    request = _request(settings.effects, read)
    if request is not None:
        # Names in another order are no other wish for a run that goes on.
        settings = replace(settings, effects=str(request))
    check_space(run.path)
    check_order(run, wanted, fresh)
    run.claim(read.digest, read.path)
    with run.locked():
        log, pace = _Log(run, reporter), None
        stays = staying(run, wanted, leave_out, fresh, read.landmarks)
        clock = RunClock(run, stays, fresh, begun)
        if settings.time_budget_s is not None:
            from .forecast.budget import fit_into_time

            before = clock.before
            settings, pace = fit_into_time(read, run, settings, choose, clock, reporter, stays, fresh, before)
        claim_settings(run, settings, wanted, fresh)
        follow_landmarks(run, read.landmarks, wanted)
        if len(stays) < len(STAGES):
            clock.start_stages()
        heard = Reporter(log.listen, reporter.is_cancelled, clock)
        until = _until(read, settings.until_db, reporter)
        rgb = settings.stages["surface"].rgb
        context = StageContext(
            read,
            run,
            settings.seed,
            settings.kernel,
            heard,
            pace,
            until,
            rgb.effects,
            request,
            rgb.long_side,
            rgb.options,
        )
        tell = on_stage or (lambda *_: None)
        for stage in wanted or STAGES:
            left_out = stage in leave_out
            if wanted or not run.is_done(stage) or run.report(stage).get("left_out", False) != left_out:
                _run_stage(stage, context, settings.stages[stage], tell, log, left_out)
            else:
                tell(stage, "kept", run.report(stage))
        if not all(run.is_done(stage) for stage in STAGES):
            return {"stages": {stage: run.report(stage) for stage in STAGES if run.is_done(stage)}}
        return _finish(context, settings, tell)


def _read(capture: Path | Capture, run: RunFolder, reporter: Reporter) -> Capture:
    from .capture.model import Capture
    from .capture.read import read_capture

    if isinstance(capture, Capture):
        refuse_nesting(capture.path, run.path)
        return capture
    refuse_nesting(Path(capture), run.path)
    reporter.update(Progress("capture", message="reading the capture"))
    read = read_capture(Path(capture), reporter.check)
    reporter.update(Progress("capture", fraction=1.0))
    return read


def _request(effects: str, capture: Capture) -> Request | None:
    """Who asks for no effects loads none."""
    if effects == "none":
        return None
    from .effects.request import parse_effects

    request = parse_effects(effects)
    request.check(capture)
    return request


def _until(capture: Capture, psnr: float | None, reporter: Reporter) -> Until | None:
    from .train.schedule import Until

    if psnr is None:
        return None
    kind = "photos" if capture.photos is not None else "projections"
    of_photos, of_projections = photos_kept_back(capture.photos), projections_kept_back(capture.projections)
    kept = of_photos if kind == "photos" else of_projections
    if not kept:
        told = Told("--until {psnr:g}dB: {why}", psnr=psnr, why=cannot_tell(kind))
        reporter.update(Progress("capture", fraction=1.0, message=told))
    return Until(kind, psnr)


def _ordered(stages: Sequence[str]) -> list[str]:
    for stage in stages:
        if stage not in STAGES:
            raise SettingError(
                "--stage {stage}: there is no such stage; choose {known}.", stage=stage, known=", ".join(STAGES)
            )
    return [stage for stage in STAGES if stage in stages]


def _run_stage(
    stage: str, context: StageContext, settings: Any, on_stage: StageListener, log: _Log, left_out: bool
) -> None:
    run = context.run
    module = stage_module(stage)
    if run.is_done(stage):
        forget(run, stage)
    for later in STAGES[STAGES.index(stage) + 1 :]:
        forget(run, later)
    reason = Told("left out") if left_out else module.reason_to_skip(context)
    if reason:
        report = {"skipped": reason, "seconds": 0.0, **({"left_out": True} if left_out else {})}
        write_json(run.stage(stage) / "report.json", report)
        on_stage(stage, "skipped", report)
        return
    on_stage(stage, "started", {})
    start_over_if_changed(run, stage, settings, context.kernel)
    log.clock = clock = Clock(run.stage(stage) / "seconds.json")
    try:
        report = module.run(context, settings)
    finally:
        log.clock = None
        clock.save()
    report = {**report, "seconds": clock.total, "kernel": context.kernel, "settings": plain(settings)}
    report |= {"units": {"density": run.densities.unit}, "water_per_mm": run.densities.water_per_mm}
    write_json(run.stage(stage) / "report.json", report)
    for checkpoint in run.stage(stage).glob(CHECKPOINTS):
        checkpoint.unlink()
    clock.path.unlink(missing_ok=True)
    context.progress(stage, fraction=1.0)
    on_stage(stage, "done", report)


class _Log:
    """Passes progress on, appends it to `log.jsonl` and keeps the stage's clock."""

    def __init__(self, run: RunFolder, reporter: Reporter) -> None:
        self._run, self._path, self._reporter = run, run.path / "log.jsonl", reporter
        self.clock: Clock | None = None

    def listen(self, progress: Progress) -> None:
        with explained(self._path), open(self._path, "a", encoding="utf-8") as stream:
            stream.write(json.dumps(plain({"time": round(time.time(), 2), **progress.to_json()})) + "\n")
        if self.clock is not None:
            self.clock.save_now_and_then()
        self._reporter.update(progress)


def _finish(context: StageContext, settings: Settings, on_stage: StageListener) -> dict[str, Any]:
    from .report import write_report

    on_stage("report", "started", {})
    start = time.monotonic()
    report = write_report(context, settings)
    on_stage("report", "done", {"seconds": time.monotonic() - start, "files": report["files"]})
    return report
