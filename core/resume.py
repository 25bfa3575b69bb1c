"""Going on with a run folder: whose it is, what of it still counts, and how long it has taken."""

from __future__ import annotations

import io
import json
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import __version__
from .errors import DiskFullError, RunFolderError, SettingError
from .files import atomic_write, plain, write_json
from .run_folder import STAGES, RunFolder
from .settings import Settings
from .stages.effects import forget_choice
from .volume import ARCHIVE_ERRORS

if TYPE_CHECKING:
    from .capture.model import Landmarks

CHECKPOINTS = "*.checkpoint.*"
"""What a broken-off stage leaves in its folder to go on from; gone when it is done."""

# Settings of a whole run, not of a stage.
_WHOLE = ("preset", "seed", "time_budget_s", "until_db", "effects")
# What runs were made with before they said so.
_UNSAID = {"effects": "none"}
# A draft run of a small capture leaves about 60 MB; starting with less would only fail later.
_LEAST_FREE_BYTES = 100 * 2**20
_CLOCK_SAVE_SECONDS = 10.0


def refuse_nesting(capture: Path, out: Path) -> None:
    """A run folder inside the capture would be read as part of it the next time.

    Raises:
        RunFolderError: `out` is the capture or lies inside it.
    """
    if out.resolve().is_relative_to(capture.resolve()):
        raise RunFolderError(
            "{out}: lies inside the capture {capture}; choose a run folder outside of it.", out=out, capture=capture
        )


def check_space(folder: Path) -> None:
    """Looks for room on the disk that will hold `folder`.

    Raises:
        RunFolderError: a file is in the way, or the drive is not there.
        DiskFullError: less than a small run needs is free.
    """
    existing = folder.resolve()
    while not existing.exists():
        if existing.parent == existing:
            raise RunFolderError(
                "{folder}: there is no drive {drive}; choose another run folder.", folder=folder, drive=existing
            )
        existing = existing.parent
    if not existing.is_dir():
        raise RunFolderError("{path}: is a file, not a folder; choose another run folder.", path=existing)
    free = shutil.disk_usage(existing).free
    if free < _LEAST_FREE_BYTES:
        raise DiskFullError(
            "{folder}: only {free:.0f} MB are free on its disk and a run needs "
            "{least:.0f} MB or more; free some space or choose another run folder.",
            folder=folder,
            free=free / 2**20,
            least=_LEAST_FREE_BYTES / 2**20,
        )


def check_order(run: RunFolder, wanted: Sequence[str], fresh: bool) -> None:
    """Refuses a stage whose earlier ones are missing before anything of the run is given up.

    Raises:
        SettingError: names the stage that has to come first.
    """
    for stage in wanted:
        for earlier in STAGES[: STAGES.index(stage)]:
            if earlier not in wanted and (fresh or not run.is_done(earlier)):
                raise SettingError(
                    "--stage {stage}: needs the stage '{earlier}' first; run it, or run all stages.",
                    stage=stage,
                    earlier=earlier,
                )


def claim_settings(run: RunFolder, settings: Settings, wanted: Sequence[str], fresh: bool) -> None:
    """Ties the folder to settings, or checks that what is done was made with these.

    A stage in `wanted` may change its settings, because it is made again. A run whose time was gone before its first
    training may be given more, and before any stage is done another preset with it.

    Raises:
        RunFolderError: another preset, seed, or setting of a stage that is done and stays.
    """
    marker = run.path / "settings.json"
    current = plain(settings)
    if fresh:
        for stage in STAGES:
            forget(run, stage)
    elif marker.exists():
        before = run.read_json(marker)
        for name in _WHOLE:
            made = _made_with(before, name)
            if made != current[name] and not _gives_more_time(run, name, before, current):
                raise _made_otherwise(run, name, made, current[name])
        for stage in STAGES:
            kept = run.is_done(stage) and "settings" in run.report(stage)
            if kept and not set(wanted) & set(STAGES[: STAGES.index(stage) + 1]):
                _same_settings(run, stage, current["stages"][stage])
    write_json(marker, current)


def _made_with(before: Mapping[str, Any], name: str) -> Any:
    """A setting of the whole run as `settings.json` has it; names of effects in the order that they have today."""
    made = before.get(name, _UNSAID.get(name))
    if name != "effects" or made == _UNSAID["effects"]:
        return made
    from .effects.request import parse_effects

    try:
        return str(parse_effects(made))
    except (SettingError, AttributeError):
        return made


def _gives_more_time(run: RunFolder, name: str, before: Mapping[str, Any], current: Mapping[str, Any]) -> bool:
    """Whether a setting of the whole run is its time, and none of that was shared out yet; or the preset that more time
    allows, and no stage was done with the one before."""
    times = before.get("time_budget_s"), current["time_budget_s"]
    if None in times or times[0] >= times[1]:
        return False
    if name == "preset":
        return not any(run.is_done(stage) for stage in STAGES)
    untouched = not run.is_done("surface") and not any((run.path / "surface").glob(f"*-pace{CHECKPOINTS[1:]}"))
    return name == "time_budget_s" and untouched


def follow_landmarks(run: RunFolder, landmarks: Landmarks | None, wanted: Sequence[str]) -> None:
    """Marks `align` and what follows as not done where they were made with other landmarks, or none.

    Cameras that were found, and all else before the alignment, stay: landmarks are points in their frame.

    Args:
        wanted: the stages that are run now; all if empty.

    Raises:
        SettingError: one of them follows the alignment, which has to be made anew first.
    """
    marker, current, changed = _landmarks_of(run, landmarks)
    if not changed:
        return
    concerned = STAGES[STAGES.index("align") :]
    late = [stage for stage in wanted if stage in concerned]
    if late and "align" not in late:
        raise SettingError(
            "--stage {stage}: landmarks.json is not what 'align' was made with; run all stages.", stage=late[0]
        )
    for stage in concerned:
        forget(run, stage)
    if current is None:
        marker.unlink()
    else:
        write_json(marker, current)


def has_other_landmarks(run: RunFolder, landmarks: Landmarks | None) -> bool:
    """Whether what a run holds from `align` on was made with other landmarks, or none."""
    return _landmarks_of(run, landmarks)[2]


def _landmarks_of(run: RunFolder, landmarks: Landmarks | None) -> tuple[Path, dict[str, Any] | None, bool]:
    """Where `align` notes its landmarks, what it has to note now, and whether that is something else."""
    # In the stage's own folder, so that it goes with an alignment that another run takes over.
    marker = run.path / "align" / "landmarks.json"
    current = None if landmarks is None else plain({"photo": landmarks.photo, "xray": landmarks.xray})
    return marker, current, current != (run.read_json(marker) if marker.exists() else None)


def staying(
    run: RunFolder, wanted: Sequence[str], leave_out: Sequence[str], fresh: bool, landmarks: Landmarks | None
) -> list[str]:
    """The stages that are done and that a run which starts now does not make again, in their order.

    Args:
        wanted, leave_out, fresh: as `pipeline.reconstruct` has them, `wanted` in order.
        landmarks: the capture's.
    """
    moved, found = _landmarks_of(run, landmarks)[2], []
    for stage in () if fresh else STAGES:
        if stage in wanted or not run.is_done(stage) or (stage == "align" and moved):
            break
        if not wanted and run.report(stage).get("left_out", False) != (stage in leave_out):
            break
        found.append(stage)
    return found


def forget_changed(run: RunFolder, settings: Settings) -> None:
    """Marks the stages as not done that were made with other settings or another kernel, and all after them, where
    `claim_settings` would refuse: for a folder that is the program's own.

    Raises:
        RunFolderError: the folder's settings cannot be read.
    """
    marker = run.path / "settings.json"
    current, changed = plain(settings), False
    # Stages copied from another run come without it.
    if marker.exists():
        before = run.read_json(marker)
        changed = any(_made_with(before, name) != current[name] for name in _WHOLE)
    for stage in STAGES:
        report = run.report(stage) if run.is_done(stage) else {}
        made = report.get("settings")
        changed = changed or (made is not None and difference(made, current["stages"][stage]) is not None)
        changed = changed or report.get("kernel", settings.kernel) != settings.kernel
        if changed:
            forget(run, stage)
    if changed:
        marker.unlink(missing_ok=True)


def start_over_if_changed(run: RunFolder, stage: str, settings: Any, kernel: str) -> None:
    """Drops the checkpoints of a stage that was broken off with other settings, another kernel or another version of
    the program, and notes these."""
    marker = run.stage(stage) / "settings.json"
    current = {"settings": plain(settings), "kernel": kernel, "version": __version__}
    try:
        same = json.loads(marker.read_text("utf-8")) == current
    except (OSError, ValueError):
        same = False
    if not same:
        forget(run, stage)
        write_json(marker, current)


def forget(run: RunFolder, stage: str) -> None:
    """Marks a stage, and with it the run, as not done and drops its checkpoints and, of `initialize`, the choice of
    effects; other results stay until replaced.
    """
    folder = run.path / stage
    # Nothing in the picture of a curve says which run it is of.
    names = [run.path / "report.json", run.path / "curve.png", folder / "report.json", folder / "seconds.json"]
    for name in [*names, *folder.glob(CHECKPOINTS)]:
        name.unlink(missing_ok=True)
    if stage == "initialize":
        forget_choice(folder)


def once(path: Path, make: Callable[[], dict[str, Any]], leaves: Sequence[Path] = ()) -> dict[str, Any]:
    """What `make` returns, kept in `path` so that a stage that was broken off later does not make it again.

    Args:
        path: a checkpoint; a damaged one is made anew.
        make: returns numpy arrays, which are kept bit for bit, and whatever `files.plain` knows.
        leaves: files that `make` writes; when one is missing all is made anew.

    Returns:
        The same content whether it was made or read: arrays, and plain JSON types.

    Raises:
        DiskFullError, RunFolderError: it cannot be written.
    """
    kept = _kept(path)
    if kept is not None and all(file.exists() for file in leaves):
        return kept
    made = make()
    arrays = {name: value for name, value in made.items() if isinstance(value, np.ndarray)}
    rest = plain({name: value for name, value in made.items() if name not in arrays})
    buffer = io.BytesIO()
    np.savez(buffer, plain=json.dumps(rest), **arrays)
    with atomic_write(path) as stream:
        stream.write(buffer.getvalue())
    return {**rest, **arrays}


def _kept(path: Path) -> dict[str, Any] | None:
    try:
        stored = np.load(path, allow_pickle=False)
        if not isinstance(stored, np.lib.npyio.NpzFile):
            return None
        with stored:
            arrays = {name: stored[name] for name in stored if name != "plain"}
            rest = json.loads(str(stored["plain"]))
    except ARCHIVE_ERRORS:
        return None
    return {**rest, **arrays} if isinstance(rest, dict) else None


class RunClock:
    """Seconds of a run until now, in this process and in those before it.

    Args:
        run: whose stages they were spent on.
        stays: see `staying`; of what comes after these, only what a broken-off stage took counts.
        fresh: nothing that was made before counts.
        begun: when this process began with the run, as `time.monotonic` says it.

    Attributes:
        before: those of earlier processes.
    """

    def __init__(self, run: RunFolder, stays: Sequence[str], fresh: bool, begun: float) -> None:
        # A stage's own seconds do not have what a process did before its first: reading, compiling, measuring speed.
        self._path, self._begun = run.path / "seconds.json", begun
        self._outside = 0.0 if fresh else Clock(self._path).before
        done = sum(run.report(stage).get("seconds", 0.0) for stage in stays)
        broken = () if fresh else STAGES[len(stays) : len(stays) + 1]
        stages = done + sum(Clock(run.path / stage / "seconds.json").before for stage in broken)
        self.before = stages + self._outside

    def __call__(self) -> float:
        return self.before + time.monotonic() - self._begun

    def start_stages(self) -> None:
        """Keeps what came before the first stage, for a process that goes on with the run."""
        write_json(self._path, self._outside + time.monotonic() - self._begun)


class Clock:
    """Seconds spent on a stage, those before it was killed and resumed included.

    Args:
        path: where they are kept while the stage is not done.

    Attributes:
        before: those of earlier processes.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.before = 0.0
        try:
            self.before = float(json.loads(path.read_text("utf-8")))
        except (OSError, ValueError, TypeError):
            self.before = 0.0
        self._start = self._saved = time.monotonic()

    @property
    def total(self) -> float:
        """Seconds until now."""
        return self.before + time.monotonic() - self._start

    def save_now_and_then(self) -> None:
        """Writes the seconds every ten seconds, so that a killed run loses no more than those."""
        if time.monotonic() - self._saved > _CLOCK_SAVE_SECONDS:
            self.save()

    def save(self) -> None:
        """Writes the seconds, unless the disk is full: the stage that met it must tell, not the clock."""
        self._saved = time.monotonic()
        if shutil.disk_usage(self.path.parent).free > 4096:
            write_json(self.path, self.total)


def _same_settings(run: RunFolder, stage: str, current: dict[str, Any]) -> None:
    found = difference(run.report(stage).get("settings"), current)
    if found is not None:
        name, before, now = found
        if (stage, name) == ("internal", ("joint",)):
            kept, asked = ("joint" if value else "apart" for value in (before, now))
            raise RunFolderError(
                "{path}: was made with --refine {kept}, not {asked}; give --refine {kept}, or start over in this one "
                "(--fresh).",
                path=run.path,
                kept=kept,
                asked=asked,
            )
        raise _made_otherwise(run, ".".join((stage, *name)), before, now)


def difference(before: Any, now: Any) -> tuple[tuple[str, ...], Any, Any] | None:
    """The first setting that differs: its name's parts and both values. One that either does not know is passed over:
    what a newer version adds must not shut out the runs of an older one."""
    if not (isinstance(before, dict) and isinstance(now, dict)):
        return None if before == now else ((), before, now)
    for key in now:
        found = difference(before[key], now[key]) if key in before else None
        if found is not None:
            return (key, *found[0]), found[1], found[2]
    return None


def _made_otherwise(run: RunFolder, name: str, before: Any, now: Any) -> RunFolderError:
    return RunFolderError(
        "{path}: was made with {name} {before}, not {now}; choose another run folder, or start over in this one "
        "(--fresh).",
        path=run.path,
        name=name,
        before=before,
        now=now,
    )
