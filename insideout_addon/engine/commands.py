"""What the operators ask of the engine, and what its answers do to the scene."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path

import bpy
from bpy.app.translations import pgettext_iface as iface_
from bpy.app.translations import pgettext_n as n_

from ...core.errors import InsideOutError, SettingError
from ...core.worker import RUN_VARIABLE
from ..effects import effects_request
from ..error_text import error_text
from ..in_work import note_import, works_in_steps
from ..scene.importing import LoadedSplats, available_sets, find_set, load_splats, place_in_steps
from ..told_text import displayable
from .environment import ENGINE_VARIABLE, is_made, locate_engine, setup_command
from .job import error_of, redraw_sidebars, start_job
from .process import Message

_LOAD_POLL_S, _PLACE_POLL_S = 0.05, 0.01
RECONSTRUCTING = n_("Reconstructing")
_NO_ENGINE = n_(
    "No engine found; press Make Environment in the Engine section, or set Engine Python in the preferences."
)
_NO_ENGINE_FOR_A_SCRIPT = (
    "No engine found; name the Python in which insideout is installed: with --engine PYTHON, in the variable "
    f"{ENGINE_VARIABLE}, or as Engine Python in the add-on's preferences."
)


def worker_command(*arguments: str) -> list[str]:
    """The command line of the engine's worker.

    Raises:
        FileNotFoundError: no engine is there.
        SettingError: the one that the user has chosen is not there.
    """
    engine = locate_engine()
    if engine is None:
        raise FileNotFoundError(_NO_ENGINE_FOR_A_SCRIPT if bpy.app.background else _NO_ENGINE)
    return [str(engine.python), "-m", "insideout.core.worker", *arguments]


def start_version(operator: bpy.types.Operator) -> set[str]:
    """Asks the engine for its version."""

    def on_end(last: Message) -> None:
        if last.get("type") == "version":
            version = f"InsideOut {last.get('insideout')}, torch {last.get('torch')}"
            bpy.context.window_manager.insideout.engine_version = displayable(version)

    command = partial(worker_command, "version")
    return _start(operator, command, n_("Trying the engine"), "engine", on_end, on_start=forget_version)


def forget_version() -> None:
    """The version shown is of an engine that is, or may be, no longer the one that is found."""
    bpy.context.window_manager.insideout.engine_version = ""


def start_setup(operator: bpy.types.Operator, python: Path, folder: Path) -> set[str]:
    """Makes the engine's environment."""

    def on_message(message: Message) -> None:
        if message["type"] == "done" and not is_made(folder):
            unseen = SettingError(
                "{folder}: the engine was made there, but Blender does not see it, as where its Python is from the "
                "Microsoft Store; install Python 3.11 from python.org, then make the environment again.",
                folder=folder,
            )
            message.update(type="error", crash=unseen)

    command, title = partial(setup_command, python, folder), n_("Making the environment")
    return _start(operator, command, title, "engine", on_message=on_message, on_start=forget_version)


def start_check(operator: bpy.types.Operator, scene: bpy.types.Scene) -> set[str]:
    """Checks the scene's capture; the findings go to the scene."""
    asked, capture = scene.session_uid, absolute(scene.insideout.capture)

    def on_start() -> None:
        scene.insideout.checked = ""
        scene.insideout.findings.clear()

    def on_message(message: Message) -> None:
        found = _scene(asked)
        if message["type"] != "finding" or found is None:
            return
        row = found.insideout.findings.add()
        for field in ("level", "subject", "message", "advice"):
            setattr(row, field, displayable(message.get(field) or ""))
        row.told = json.dumps(message.get("told") or {})

    def on_end(last: Message) -> None:
        found = _scene(asked)
        if found is not None:
            found.insideout.checked = displayable(capture) if last.get("type") == "done" else ""

    command = partial(worker_command, "check", str(capture))
    return _start(operator, command, n_("Checking the capture"), "capture", on_end, on_message, on_start)


def forecast_subject(settings: bpy.types.PropertyGroup) -> str:
    """What an estimate for these settings is about: another route takes another time, and so does looking.

    What is reached is told from the run in the folder that the next one goes to.
    """
    capture = absolute(settings.capture)
    effects = effects_request(settings, str(capture) if settings.capture else "")
    return displayable(f"{settings.refine} {effects} {capture} {_run_of(settings, capture)}")


def start_forecast(operator: bpy.types.Operator, scene: bpy.types.Scene) -> set[str]:
    """Asks how long each preset would take; the answers go to the window manager."""
    subject = forecast_subject(scene.insideout)
    reached: dict[str, dict[str, Sequence[float]]] = {}

    def on_start() -> None:
        state = bpy.context.window_manager.insideout
        state.forecast_of = ""
        state.forecasts.clear()

    def on_message(message: Message) -> None:
        if message["type"] != "forecast":
            return
        row = bpy.context.window_manager.insideout.forecasts.add()
        row.name, row.seconds = message["preset"], float(message["seconds"])
        row.cameras = bool(message.get("cameras"))
        reached[row.name] = message.get("psnr") or {}

    def on_end(last: Message) -> None:
        state = bpy.context.window_manager.insideout
        quality = _quality_of_most(reached.values())
        for row in state.forecasts:
            if quality in reached.get(row.name, {}):
                row.quality, (row.least_db, row.most_db) = quality, reached[row.name][quality]
        state.forecast_of = subject if last.get("type") == "done" else ""
        state.forecast_known = bool(last.get("known"))

    capture = absolute(scene.insideout.capture)
    run = _run_of(scene.insideout, capture)
    arguments = ["forecast", str(capture), "--refine", scene.insideout.refine, *_effects(scene.insideout, capture)]
    # Not an argument: an engine that does not know it would end at once.
    variables = {RUN_VARIABLE: str(run)}
    command = partial(worker_command, *arguments)
    return _start(operator, command, n_("Estimating times"), "reconstruct", on_end, on_message, on_start, variables)


def _quality_of_most(reached: Iterable[dict[str, Sequence[float]]]) -> str:
    """What is told of all presets, for figures of two kinds do not compare: what most have, the engine's first of
    several; "" where none has any."""
    had = Counter(quality for one in reached for quality in one)
    return max(had, key=had.get, default="")


def start_run(operator: bpy.types.Operator, scene: bpy.types.Scene) -> set[str]:
    """Runs the chosen stages on the scene's capture; imports the result if the user wants that."""
    settings, state = scene.insideout, bpy.context.window_manager.insideout
    capture = absolute(settings.capture)
    run = _run_of(settings, capture)
    arguments = ["run", str(capture), "--out", str(run)]
    if settings.limit_time:
        arguments += ["--time-budget", f"{60 * settings.minutes:.0f}s"]
    else:
        arguments += ["--preset", settings.preset]
    arguments.append("--fresh" if state.start_over else "--resume")
    arguments += ["--refine", settings.refine, *_effects(settings, capture)]
    if settings.stage != "ALL":
        arguments += ["--stage", settings.stage]
    asked = scene.session_uid

    def on_start() -> None:
        if not settings.run or absolute(settings.run) != run:
            settings.run = settings.filled_run = str(run)
        # Pressed again, the button goes on with this run.
        state.start_over = False

    def on_end(last: Message) -> None:
        # Decibels may have been told from a run that is no longer there, or not as it was.
        bpy.context.window_manager.insideout.forecast_of = ""
        if last.get("type") != "done":
            return
        found = _scene(asked)
        if found is None:
            # Another file is open by now; nothing of it may change.
            told = iface_("Done; the result is in {folder}").format(folder=run)
            bpy.context.window_manager.insideout.message = displayable(told)
        # After `initialize` alone there is nothing to show.
        elif found.insideout.import_when_done and available_sets(run):
            import_result(asked, run)

    command = partial(worker_command, *arguments)
    return _start(operator, command, RECONSTRUCTING, "reconstruct", on_end, on_start=on_start)


def _effects(settings: bpy.types.PropertyGroup, capture: Path) -> list[str]:
    """Nothing where none is asked for: an engine of before effects goes on as it did."""
    asked = effects_request(settings, str(capture))
    return [] if asked == "none" else ["--effects", asked]


def absolute(path: str) -> Path:
    """A path of the settings for another process, whose working folder is not Blender's.

    The same for one place however it is written: saving a .blend makes `//../capture/` of what was chosen.
    """
    return Path(os.path.abspath(bpy.path.abspath(path)))


def _run_of(settings: bpy.types.PropertyGroup, capture: Path) -> Path:
    """Where the next run goes, and the last one may lie: what was filled in for one capture is not another's."""
    # Both as Blender writes paths: with the file they go elsewhere.
    filled = settings.filled_run and absolute(settings.run) == absolute(settings.filled_run)
    return absolute(settings.run) if settings.run and not filled else default_run(capture)


def run_elsewhere(settings: bpy.types.PropertyGroup) -> Path | None:
    """Where the next run goes, if that is not what Run Folder says."""
    run = _run_of(settings, absolute(settings.capture))
    return run if settings.run and run != absolute(settings.run) else None


def default_run(capture: Path) -> Path:
    """The run folder beside a capture folder."""
    # Not `with_name`, which fails for the root of a disk.
    return capture.parent / f"{capture.name} run"


def import_result(scene_uid: int, run: Path) -> None:
    """Imports the best set that a run holds into a scene; an error is shown where the engine's errors are.

    In a window the file is read in another thread, for millions of splats take seconds, and placed step by step.
    """
    scene = _scene(scene_uid)
    sets = available_sets(run)
    which = scene.insideout.which if scene.insideout.which in sets else (sets or [scene.insideout.which])[0]
    name = displayable(f"{run.name} {which}")
    executor, view_dependent = ThreadPoolExecutor(1, "insideout import"), scene.insideout.view_dependent
    future = executor.submit(lambda: load_splats(find_set(run, which), view_dependent))
    executor.shutdown(wait=False)
    steps = _placing(future, scene_uid, name, view_dependent)
    if bpy.app.background:
        while _step(steps, scene_uid):
            pass
        return

    def poll() -> float | None:
        # What an operator works on is not to change under it. And before Blender 5.2 making a point cloud leaves Edit
        # Mode, in which the user may be by now.
        goes_on = future.done() and not works_in_steps() and not _editing(_scene(scene_uid))
        note_import(poll, goes_on)
        if not goes_on:
            return _LOAD_POLL_S
        if _step(steps, scene_uid):
            return _PLACE_POLL_S
        note_import(poll, False)
        redraw_sidebars()
        return None

    bpy.app.timers.register(poll, first_interval=_LOAD_POLL_S)


def _placing(future: Future[LoadedSplats], scene_uid: int, name: str, view_dependent: bool) -> Iterator[float]:
    loaded, display = future.result(), _scene(scene_uid).insideout.display
    yield from place_in_steps(loaded, name, bpy.context, display, view_dependent)
    if not bpy.app.background:
        yield 1.0


def _step(steps: Iterator[float], scene_uid: int) -> bool:
    """Goes on with placing; whether more is left to do."""
    scene = _scene(scene_uid)
    if scene is None or not hasattr(scene, "insideout"):
        return False
    try:
        with bpy.context.temp_override(scene=scene, **_window(scene)):
            next(steps)
    except StopIteration:
        if not bpy.app.background:
            # The import is done, whether it can be undone by itself or not.
            with suppress(RuntimeError, IndexError):
                _push_undo(scene)
        return False
    except ReferenceError:
        _tell_error(n_("The import was undone before it ended; press Import under Model."))
    except (InsideOutError, OSError, MemoryError, RuntimeError) as error:
        _tell_error(error_text(error))
    else:
        return True
    return False


def _push_undo(scene: bpy.types.Scene) -> None:
    """A step of its own in the undo history, which a timer does not have; it takes a window, any where none shows the
    scene."""
    windows = bpy.context.window_manager.windows
    showing = next((window for window in windows if window.scene == scene), windows[0])
    with bpy.context.temp_override(window=showing):
        bpy.ops.ed.undo_push(message="Import the Model")


def _tell_error(message: str) -> None:
    state = bpy.context.window_manager.insideout
    state.error, state.panel = message, "reconstruct"


def _scene(uid: int) -> bpy.types.Scene | None:
    """The scene with this identity, whatever it is called now; None once it is deleted or another file is open."""
    return next((scene for scene in bpy.data.scenes if scene.session_uid == uid), None)


def _editing(scene: bpy.types.Scene | None) -> bool:
    """Whether the user is in another mode than Object Mode in a window that shows the scene."""
    if scene is None:
        return False
    active = [w.view_layer.objects.active for w in bpy.context.window_manager.windows if w.scene == scene]
    return any(thing is not None and thing.mode != "OBJECT" for thing in active)


def _window(scene: bpy.types.Scene) -> dict[str, object]:
    """A window to act in, for a timer has none of its own: one that shows the scene.

    Where none does, none: Blender crashes on a view layer of another scene than the window's.
    """
    showing = next((window for window in bpy.context.window_manager.windows if window.scene == scene), None)
    if showing is not None:
        return {"window": showing, "view_layer": showing.view_layer}
    return {"view_layer": scene.view_layers[0]}


def _start(
    operator: bpy.types.Operator,
    command: Callable[[], Sequence[str]],
    title: str,
    panel: str,
    on_end: Callable[[Message], None] = lambda last: None,
    on_message: Callable[[Message], None] = lambda message: None,
    on_start: Callable[[], None] = lambda: None,
    variables: Mapping[str, str] | None = None,
) -> set[str]:
    """Starts a job; in background mode it is over then and its failure is the operator's."""
    try:
        last = start_job(command(), title, on_message, on_end, panel, on_start, variables)
    except (InsideOutError, OSError, RuntimeError) as error:
        operator.report({"ERROR"}, error_text(error))
        return {"CANCELLED"}
    if last.get("type") == "error":
        operator.report({"ERROR"}, error_of(last))
        return {"CANCELLED"}
    return {"FINISHED"}
