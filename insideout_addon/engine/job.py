"""The one job that the engine works on: polled by a timer in a window, waited for in background mode."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import bpy

from .process import EngineProcess, Message

_INTERVAL_S = 0.1
_REDRAW_S = 0.3


class Job:
    """An engine process and what its messages do to the user interface.

    Args:
        on_message: called with each message but progress.
        on_end: called with the last message, on the main thread.
    """

    def __init__(
        self, process: EngineProcess, on_message: Callable[[Message], None], on_end: Callable[[Message], None]
    ) -> None:
        self.process = process
        self.on_message = on_message
        self.on_end = on_end
        self.last: Message = {}
        self.stage_started = time.monotonic()
        self.redrawn = 0.0


# The timer finds the job here; nothing is kept on Blender's own modules.
_current: list[Job] = []


def start_job(
    command: Sequence[str],
    title: str,
    on_message: Callable[[Message], None],
    on_end: Callable[[Message], None],
) -> Message:
    """Starts the engine; returns at once with {} in a window, and with the last message in background mode.

    Raises:
        RuntimeError: a job is running already.
        OSError: the program cannot be started.
    """
    if job_running():
        raise RuntimeError("InsideOut is working already; cancel that first.")
    job = Job(EngineProcess(command), on_message, on_end)
    _current[:] = [job]
    _reset_state(title)
    if bpy.app.background:
        try:
            job.process.wait(lambda message: _handle(job, message))
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
        _state().message = "Cancelling"
        _redraw()


def abandon_job() -> None:
    """Ends the running job at once and forgets it; for unregistering."""
    while _current:
        _current.pop().process.kill()
    if bpy.app.timers.is_registered(tick):
        bpy.app.timers.unregister(tick)


def tick() -> float | None:
    """One look at the running job: a few milliseconds whatever the engine prints."""
    if not _current:
        return None
    job = _current[0]
    messages = job.process.poll()
    for message in messages:
        _handle(job, message)
    if job.process.finished:
        _finish(job)
    if not _current or (messages and time.monotonic() - job.redrawn > _REDRAW_S):
        job.redrawn = time.monotonic()
        _redraw()
    return _INTERVAL_S if _current else None


def _handle(job: Job, message: Message) -> None:
    job.last = message
    if message["type"] == "progress":
        _show_progress(job, message)
        return
    if message["type"] == "stage":
        _show_stage(job, message)
    job.on_message(message)


def _finish(job: Job) -> None:
    _current.clear()
    state = _state()
    state.running = False
    state.fraction = 0.0
    state.error = job.last.get("message", "") if job.last.get("type") == "error" else ""
    state.message = {"done": "Done", "cancelled": "Cancelled"}.get(job.last.get("type", ""), "")
    job.on_end(job.last)


def _show_progress(job: Job, message: Message) -> None:
    state = _state()
    stage = message.get("stage", "")
    if stage != state.stage:
        state.stage, job.stage_started = stage, time.monotonic()
        state.heldout_psnr = 0.0
    fraction = float(message.get("fraction", 0.0))
    elapsed = time.monotonic() - job.stage_started
    state.seconds_left = elapsed * (1 - fraction) / fraction if fraction > 0.02 and elapsed > 1 else -1.0
    state.fraction = fraction
    state.part = message.get("part", "")
    state.iteration = int(message.get("iteration", 0))
    state.iterations = int(message.get("iterations", 0))
    state.splats = int(message.get("splats") or 0)
    state.heldout_psnr = float(message.get("heldout_psnr") or state.heldout_psnr)
    state.message = message.get("message", "")


def _show_stage(job: Job, message: Message) -> None:
    stages = _state().stages
    row = stages.get(message["stage"]) or stages.add()
    row.name = message["stage"]
    row.state = message.get("state", "")
    row.seconds = float(message.get("seconds") or 0.0)
    row.reason = str(message.get("reason") or "")
    if row.state == "started":
        job.stage_started = time.monotonic()


def _reset_state(title: str) -> None:
    state = _state()
    for name in ("stage", "part", "message", "error"):
        setattr(state, name, "")
    state.fraction, state.seconds_left, state.heldout_psnr = 0.0, -1.0, 0.0
    state.iteration = state.iterations = state.splats = 0
    state.stages.clear()
    state.title, state.running = title, True


def _state() -> bpy.types.PropertyGroup:
    return bpy.context.window_manager.insideout


def _redraw() -> None:
    """Draws the sidebars again, and not the views: those may take long, and nothing in them has changed."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                for region in area.regions:
                    if region.type == "UI":
                        region.tag_redraw()
