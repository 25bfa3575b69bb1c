"""What the operators ask of the engine, and what its answers do to the scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import bpy

from ...core.errors import InsideOutError
from ..scene.importing import available_sets, find_set, import_splats
from .environment import locate_engine, setup_command
from .job import start_job
from .process import Message

_NO_ENGINE = "No engine found; press Make Environment in the Engine section, or set Engine Python in the preferences."


def worker_command(*arguments: str) -> list[str]:
    """The command line of the engine's worker.

    Raises:
        FileNotFoundError: no engine is there.
    """
    engine = locate_engine()
    if engine is None:
        raise FileNotFoundError(_NO_ENGINE)
    return [str(engine.python), "-m", "insideout.core.worker", *arguments]


def start_version(operator: bpy.types.Operator) -> set[str]:
    """Asks the engine for its version."""

    def on_end(last: Message) -> None:
        version = f"InsideOut {last.get('insideout')}, torch {last.get('torch')}"
        bpy.context.window_manager.insideout.engine_version = version if last.get("type") == "version" else ""

    return _start(operator, lambda: worker_command("version"), "Trying the engine", on_end)


def start_setup(operator: bpy.types.Operator, python: Path, folder: Path) -> set[str]:
    """Makes the engine's environment."""
    return _start(operator, lambda: setup_command(python, folder), "Making the environment", lambda last: None)


def start_check(operator: bpy.types.Operator, scene: bpy.types.Scene) -> set[str]:
    """Checks the scene's capture; the findings go to the scene."""
    scene_name, capture = scene.name, bpy.path.abspath(scene.insideout.capture)
    scene.insideout.findings.clear()

    def on_message(message: Message) -> None:
        found = bpy.data.scenes.get(scene_name)
        if message["type"] != "finding" or found is None:
            return
        row = found.insideout.findings.add()
        for field in ("level", "subject", "message", "advice"):
            setattr(row, field, str(message.get(field) or ""))

    def on_end(last: Message) -> None:
        found = bpy.data.scenes.get(scene_name)
        if found is not None:
            found.insideout.checked = capture if last.get("type") == "done" else ""

    return _start(operator, lambda: worker_command("check", capture), "Checking the capture", on_end, on_message)


def start_run(operator: bpy.types.Operator, scene: bpy.types.Scene) -> set[str]:
    """Runs the chosen stages on the scene's capture; imports the result if the user wants that."""
    settings = scene.insideout
    if not settings.run:
        settings.run = str(default_run(bpy.path.abspath(settings.capture)))
    arguments = ["run", bpy.path.abspath(settings.capture), "--out", bpy.path.abspath(settings.run)]
    arguments += ["--preset", settings.preset, "--resume"]
    if settings.stage != "ALL":
        arguments += ["--stage", settings.stage]
    scene_name = scene.name

    def on_end(last: Message) -> None:
        found = bpy.data.scenes.get(scene_name)
        if last.get("type") == "done" and found is not None and found.insideout.import_when_done:
            import_result(found)

    return _start(operator, lambda: worker_command(*arguments), "Reconstructing", on_end)


def default_run(capture: str) -> Path:
    """The run folder beside a capture folder."""
    path = Path(capture)
    return path.with_name(f"{path.name} run")


def import_result(scene: bpy.types.Scene) -> bpy.types.Object | None:
    """Imports the best set that the scene's run holds; an error is shown where the engine's errors are."""
    settings, state = scene.insideout, bpy.context.window_manager.insideout
    run = Path(bpy.path.abspath(settings.run))
    sets = available_sets(run)
    which = settings.which if settings.which in sets else (sets or [settings.which])[0]
    try:
        path = find_set(run, which)
        with bpy.context.temp_override(scene=scene, **_window()):
            return import_splats(path, f"{run.name} {which}", bpy.context, settings.display, settings.view_dependent)
    except InsideOutError as error:
        state.error = str(error)
        return None


def _window() -> dict[str, bpy.types.Window]:
    """A window to act in: a timer has none of its own."""
    windows = bpy.context.window_manager.windows
    return {"window": windows[0]} if len(windows) else {}


def _start(
    operator: bpy.types.Operator,
    command: Callable[[], Sequence[str]],
    title: str,
    on_end: Callable[[Message], None],
    on_message: Callable[[Message], None] = lambda message: None,
) -> set[str]:
    """Starts a job; in background mode it is over then and its failure is the operator's."""
    try:
        last = start_job(command(), title, on_message, on_end)
    except (OSError, RuntimeError) as error:
        operator.report({"ERROR"}, str(error))
        return {"CANCELLED"}
    if last.get("type") == "error":
        operator.report({"ERROR"}, last["message"])
        return {"CANCELLED"}
    return {"FINISHED"}
