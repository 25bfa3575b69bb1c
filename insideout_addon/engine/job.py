"""The one job that the engine works on: polled by a timer in a window, waited for in background mode."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence

import bpy
from bpy.app.translations import pgettext_n as n_

from ..error_text import error_text, told_error_text
from ..remembered import forget
from ..told_text import told_text
from .process import EngineProcess, Message
from .progress_text import Curve, duration, headline, rows, stage_lines, time_left

_INTERVAL_S = 0.1
# However little of the sidebar has changed, Blender composes the whole window again: 30 ms and more without a GPU.
_REDRAW_S = 0.5
_TELL_S = 5.0
_TAB = "InsideOut"
_CANCELLING = n_("Canceling")


class Job:
    """An engine process and what its messages do to the user interface.

    Args:
        title: what is done, for the user.
        on_message: called with each message but progress.
        on_end: called with the last message, on the main thread.
        panel: where it is shown: "engine", "capture" or "reconstruct".

    Attributes:
        stages: the newest message about each stage.
        curve: what was kept back and measured, by stage, part and iteration.
        cancelling: the user asked to stop.
    """

    def __init__(
        self,
        process: EngineProcess,
        title: str,
        on_message: Callable[[Message], None],
        on_end: Callable[[Message], None],
        panel: str = "reconstruct",
    ) -> None:
        self.process = process
        self.title = title
        self.panel = panel
        self.stages: dict[str, Message] = {}
        self.cancelling = False
        self.on_message = on_message
        self.on_end = on_end
        self.last: Message = {}
        self.stage_started = time.monotonic()
        self.stage_began_at = 0.0
        self.loss = Curve(logarithmic=True)
        self.curve: dict[tuple[object, ...], dict[str, object]] = {}
        self.shown: tuple[object, ...] = ()
        self.redrawn = 0.0


# The timer finds the job here; nothing is kept on Blender's own modules.
_current: list[Job] = []


def start_job(
    command: Sequence[str],
    title: str,
    on_message: Callable[[Message], None],
    on_end: Callable[[Message], None],
    panel: str = "reconstruct",
    on_start: Callable[[], None] = lambda: None,
    variables: Mapping[str, str] | None = None,
) -> Message:
    """Starts the engine; returns at once with {} in a window, and with the last message in background mode.

    Args:
        title, on_message, on_end: as of Job.
        panel: where the user asked for it: "engine", "capture" or "reconstruct".
        on_start: called when the program runs, before its first message.
        variables: of the program's environment, beside ours.

    Raises:
        RuntimeError: a job is running already.
        OSError: the program cannot be started.
    """
    if job_running():
        raise RuntimeError(n_("InsideOut is working already; cancel that first."))
    job = Job(EngineProcess(command, variables=variables), title, on_message, on_end, panel)
    _current[:] = [job]
    _reset_state(title, panel)
    on_start()
    if bpy.app.background:
        try:
            job.process.wait(lambda message: _tell(job, message))
        finally:
            _finish(job)
        return job.last
    bpy.app.timers.register(tick, first_interval=_INTERVAL_S, persistent=True)
    return {}


def job_running() -> bool:
    """Whether the engine works for us now."""
    return bool(_current)


def cancel_job() -> None:
    """Asks the running job to stop; it ends within a second."""
    if _current:
        _current[0].process.cancel()
        _current[0].cancelling = True
        _state().message = _CANCELLING
        redraw_sidebars()


def abandon_job() -> None:
    """Ends the running job and forgets it, for unregistering; the engine gets half a second for its checkpoint."""
    while _current:
        _current.pop().process.stop()
    if bpy.app.timers.is_registered(tick):
        bpy.app.timers.unregister(tick)


def tick() -> float | None:
    """One look at the running job: a few milliseconds whatever the engine prints."""
    try:
        return _look()
    except Exception as error:
        # Blender drops a timer that raises; the job must not stay "running" for ever then, nor end without a word.
        while _current:
            _current.pop().process.kill()
        _state().running, _state().error = False, error_text(error) or type(error).__name__
        redraw_sidebars()
        raise


def _look() -> float | None:
    if not _current:
        return None
    job = _current[0]
    for message in job.process.poll():
        _handle(job, message)
    if job.process.finished:
        _finish(job)
        redraw_sidebars()
    elif time.monotonic() - job.redrawn > _REDRAW_S:
        state = _state()
        shown = (headline(state), state.message, *rows(state), *stage_lines(state, running=True), state.curve)
        if shown != job.shown:
            job.shown, job.redrawn = shown, time.monotonic()
            redraw_sidebars()
    return _INTERVAL_S if _current else None


def redraw_sidebars() -> None:
    """Draws our sidebars again, and not the views: those may take long, and nothing in them has changed."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type != "VIEW_3D" or not area.spaces.active.show_region_ui:
                continue
            for region in area.regions:
                if region.type == "UI" and getattr(region, "active_panel_category", _TAB) in (_TAB, "UNSUPPORTED"):
                    region.tag_redraw()


def _handle(job: Job, message: Message) -> None:
    job.last = message
    if not _state().running:
        # A file that was opened meanwhile brings a window manager that knows nothing of the job.
        _reset_state(job.title, job.panel)
        for told in job.stages.values():
            _show_stage(told)
        _show_curve(list(job.curve.values()))
    _follow_curve(job, message)
    if message["type"] == "progress":
        _show_progress(job, message)
        return
    if message["type"] == "stage":
        job.stages[message["stage"]] = message
        _show_stage(message)
    job.on_message(message)


def _tell(job: Job, message: Message) -> None:
    """`_handle` where there is no sidebar: prints a line for each stage and, every 5 s, for its progress."""
    _handle(job, message)
    state = _state()
    if message["type"] == "stage":
        row = state.stages[message["stage"]]
        took = f" in {duration(row.seconds)}" if row.seconds else ""
        print(f"{row.name.capitalize()} {row.state}{took}" + (f": {row.reason}" if row.reason else ""), flush=True)
    elif message["type"] == "progress":
        place, now = (state.stage, state.part), time.monotonic()
        if job.shown != place or now - job.redrawn > _TELL_S:
            job.shown, job.redrawn = place, now
            left = f", {time_left(state.seconds_left)}" if state.seconds_left >= 0 else ""
            print(f"{headline(state)}{left}", flush=True)


def _finish(job: Job) -> None:
    _current.clear()
    forget()
    state = _state()
    state.title, state.running = job.title, False
    state.fraction = 0.0
    state.error = error_of(job.last) if job.last.get("type") == "error" else ""
    report = job.last.get("report")
    if isinstance(report, dict) and report.get("curve"):
        # With the figures of the finished model.
        _show_curve(report["curve"])
    state.message = {"done": n_("Done"), "cancelled": n_("Canceled")}.get(job.last.get("type", ""), "")
    job.on_end(job.last)


def error_of(message: Message) -> str:
    """What an error says to the user: what the engine told, or that it ended without a word."""
    return error_text(message["crash"]) if "crash" in message else told_error_text(message)


def _show_progress(job: Job, message: Message) -> None:
    state = _state()
    fraction = float(message.get("fraction", 0.0))
    _follow_stage(job, message, fraction)
    elapsed, gone = time.monotonic() - job.stage_started, fraction - job.stage_began_at
    state.seconds_left = elapsed * (1 - fraction) / gone if gone > 0.02 and elapsed > 1 else -1.0
    state.fraction = fraction
    state.iteration = int(message.get("iteration", 0))
    state.iterations = int(message.get("iterations", 0))
    state.splats = int(message.get("splats") or 0)
    told = told_text(message.get("told"), message.get("message"))
    state.message = _CANCELLING if job.cancelling else told or state.message
    job.loss.add(message.get("loss"))
    state.loss, state.loss_curve = job.loss.newest, job.loss.line()
    state.heldout_psnr = float(message.get("heldout_psnr") or state.heldout_psnr)


def _follow_stage(job: Job, message: Message, fraction: float) -> None:
    """A new stage starts the clock again, and a new part of one its figures: they are of other images."""
    state = _state()
    stage, part = message.get("stage", ""), message.get("part", "")
    if stage != state.stage or fraction < state.fraction:
        # A resumed stage begins where it was left, not at 0.
        job.stage_started, job.stage_began_at = time.monotonic(), fraction
    if (stage, part) != (state.stage, state.part):
        job.loss = Curve(logarithmic=True)
        state.message, state.heldout_psnr = "", 0.0
    state.stage, state.part = stage, part


def _follow_curve(job: Job, message: Message) -> None:
    """Takes up what a message tells of views that were kept back: one curve over all parts of a run."""
    points = message.get("heldout") or []
    for point in points:
        # Those of a stage that is kept have their part with them.
        known = {"stage": message.get("stage", ""), "part": message.get("part", ""), **point}
        job.curve[known["stage"], known["part"], known.get("iteration")] = known
    if points:
        _show_curve(list(job.curve.values()))


def _show_curve(points: list[dict[str, object]]) -> None:
    _state().curve = json.dumps(points) if points else ""


def _show_stage(message: Message) -> None:
    stages = _state().stages
    row = stages.get(message["stage"]) or stages.add()
    row.name = message["stage"]
    row.state = message.get("state", "")
    row.seconds = float(message.get("seconds") or 0.0)
    row.reason = told_text(message.get("told"), message.get("reason"))


def _reset_state(title: str, panel: str) -> None:
    state = _state()
    state.panel = panel
    for name in ("stage", "part", "message", "error", "loss_curve", "curve"):
        setattr(state, name, "")
    state.fraction, state.seconds_left, state.heldout_psnr, state.loss = 0.0, -1.0, 0.0, 0.0
    state.iteration = state.iterations = state.splats = 0
    state.stages.clear()
    state.title, state.running = title, True


def _state() -> bpy.types.PropertyGroup:
    return bpy.context.window_manager.insideout
