"""Makes the engine's environment. Run as a script by a Python 3.11; prints JSON lines as the engine does.

Standard library alone, because it runs before anything is installed. READY is written last: an environment
without it is the rest of an attempt that was cut off, and is made again. An environment that worked is put aside
meanwhile, where Blender still finds it, and comes back when the new one fails.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import json
import math
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

READY = "insideout-engine.json"
# Where an environment that worked is meanwhile.
OLD = "{name}.old"
# Where an environment keeps its packages: of Linux and macOS, of Windows.
PACKAGE_FOLDERS = ("lib/*/site-packages", "Lib/site-packages")
# What pip needs of the extension to build the package.
_PARTS = ("core", "insideout_addon", "operators", "panels")
_FILES = ("__init__.py", "pyproject.toml", "README.md", "constraints.txt")
_NEEDED_BYTES = 5e9
# PyPI's torch for Linux brings several GB of CUDA, which the engine has no use for.
_CPU_INDEX = "https://download.pytorch.org/whl/cpu"
_COUNT_INTERVAL_S = 0.5
_LONGEST_LINE = 120
_BUILD = "insideout-build-"
_LOCKED = (errno.EACCES, errno.EAGAIN, errno.EDEADLK)
# What is told beside the words of pip and of the system; Blender translates it.
_EMPTY = "Making an empty environment"
_COUNTED = "Installing packages: {done} of {count}"
_TRYING = "Trying the engine"
_FAILED = "The engine's environment could not be made in {folder}: {reason}"
_REFUSED = "The engine's environment could not be made in {folder}: {reason}; make room or choose another disk."
_NO_ROOM = "it takes {needed:.0f} GB and the disk has {free:.1f} GB left"
_MADE_NOW = "Another Blender is making the engine's environment in {folder}; wait until it is done."
_IN_USE = "The engine in {folder} is in use; close other Blenders and programs that run it, then press again."


class _Cancelled(BaseException):
    """Blender asked to stop, or is gone."""


class Told(dict[str, object]):
    """A text as `core.told.Told.to_json` has it, which Blender can translate; inside of another text it is English."""

    def __init__(self, template: str, /, **values: object) -> None:
        super().__init__(template=template, values=values)

    def __str__(self) -> str:
        template, values = str(self["template"]), self["values"]
        return template.format(**values) if values else template


class _MakingError(Exception):
    """Why it could not be made, in words of our own."""

    def __init__(self, template: str, /, **values: object) -> None:
        self.told = Told(template, **values)
        super().__init__(str(self.told))


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--source", type=Path, required=True, help="the extension's folder")
    parser.add_argument("--into", type=Path, required=True, help="the environment to make")
    options = parser.parse_args(arguments)
    steps = _Steps()
    signal.signal(signal.SIGTERM, _on_terminate)
    threading.Thread(target=_stop_with_standard_input, args=(steps,), daemon=True).start()
    try:
        python = make_environment(options.source, options.into, steps)
    except _Cancelled:
        _send("cancelled")
        return 130
    except (OSError, subprocess.CalledProcessError, _MakingError) as error:
        told = error.told if isinstance(error, _MakingError) else _explained(error, options.into)
        _send("error", kind=type(error).__name__, message=str(told), told=told)
        return 2
    _send("done", python=str(python))
    return 0


def make_environment(source: Path, into: Path, steps: _Steps) -> Path:
    """Makes `into` an environment with the package of `source` in it and returns its Python.

    Raises:
        subprocess.CalledProcessError: venv or pip failed; `output` holds the end of what it said.
        OSError: a folder cannot be written.
        _MakingError: the disk is too full, the environment that was there is in use, or another process makes it now.
    """
    into.parent.mkdir(parents=True, exist_ok=True)
    with _alone(into):
        aside = _put_aside(into)
        try:
            _check_room(into)
            python = _fill(source, into, steps)
        except BaseException:
            _restore(into, aside)
            raise
        # What is still in use stays until the next time.
        with contextlib.suppress(OSError):
            _take_away(aside)
    return python


@contextlib.contextmanager
def _alone(into: Path) -> Iterator[None]:
    """Two Blenders would take away what the other one makes, and even what worked before."""
    with open(into.with_name(f"{into.name}-lock"), "ab") as stream:
        if not _lock(stream):
            raise _MakingError(_MADE_NOW, folder=str(into))
        yield


def _lock(stream: IO[bytes]) -> bool:
    """Locks a file; False where another process has it locked. File systems without locks give it to everyone."""
    try:
        if os.name == "nt":
            import msvcrt

            stream.seek(0)
            msvcrt.locking(stream.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno not in _LOCKED
    return True


def _check_room(into: Path) -> None:
    free = shutil.disk_usage(into.parent).free
    if free < _NEEDED_BYTES:
        reason = Told(_NO_ROOM, needed=_NEEDED_BYTES / 1e9, free=free / 1e9)
        raise _MakingError(_REFUSED, folder=str(into), reason=reason)


def _fill(source: Path, into: Path, steps: _Steps) -> Path:
    # On the disk that was looked at; and what a pip that was ended leaves of its downloads goes with the folder.
    temporary = Path(tempfile.mkdtemp(prefix=_BUILD, dir=into.parent))
    steps.variables = dict.fromkeys(("TMPDIR", "TEMP", "TMP"), str(temporary))
    try:
        steps.tell(0.01, Told(_EMPTY))
        steps.run([sys.executable, "-m", "venv", str(into)])
        python = into / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
        pip = [str(python), "-m", "pip", "install", "--no-input", "--disable-pip-version-check"]
        package = copy_package(source, temporary / "insideout")
        constraints = package / "constraints.txt"
        if constraints.is_file():
            pip += ["--constraint", str(constraints)]
            if _wants_cpu_torch():
                # What torch needs comes with the next step, for that index has not all versions of it. Where it cannot
                # be reached the next step takes PyPI's torch.
                with contextlib.suppress(subprocess.CalledProcessError):
                    steps.pip([*pip, "--no-deps", "--retries", "0", "--index-url", _CPU_INDEX, "torch"], into)
        steps.pip([*pip, str(package)], into)
        steps.tell(0.96, Told(_TRYING))
        steps.run([str(python), "-m", "insideout.core.worker", "version"], cwd=into)
    finally:
        _delete_detached(temporary)
    about = {"python": str(python), "version": package_version(source)}
    (into / READY).write_text(json.dumps(about) + "\n", "utf-8")
    return python


def copy_package(source: Path, target: Path) -> Path:
    """Copies what pip builds from; pip writes beside it, and the extension's folder must stay as installed."""
    target.mkdir(parents=True)
    for name in _FILES:
        if (source / name).is_file():
            shutil.copy2(source / name, target / name)
    for name in _PARTS:
        shutil.copytree(source / name, target / name, ignore=shutil.ignore_patterns("__pycache__"))
    return target


def package_version(source: Path) -> str:
    """The version in a folder's pyproject.toml, or ""."""
    found = re.search(r'^version = "(.*)"', (source / "pyproject.toml").read_text("utf-8"), re.M)
    return found.group(1) if found else ""


class _Steps:
    """Runs one command after the other and tells how far all of them are."""

    def __init__(self) -> None:
        self.cancelled = threading.Event()
        self.variables: dict[str, str] = {}
        self._child: subprocess.Popen[str] | None = None
        self._fraction = 0.0
        self._collected = 0

    def tell(self, fraction: float, what: Told | str) -> None:
        """Reports progress; the fraction never goes back. Words that are not ours are no `Told`."""
        self._fraction = max(self._fraction, fraction)
        told = {"told": what} if isinstance(what, Told) else {}
        _send("progress", stage="environment", fraction=self._fraction, message=str(what)[:_LONGEST_LINE], **told)

    def run(self, command: list[str], cwd: Path | None = None, heard: Callable[[str], None] | None = None) -> None:
        """Runs a command; `heard` gets its lines. Raises CalledProcessError with the last of them when it fails."""
        if self.cancelled.is_set():
            raise _Cancelled
        lines: list[str] = []
        process = self._child = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            encoding="utf-8",
            errors="replace",
            cwd=cwd,
            env={**os.environ, **self.variables},
        )
        try:
            assert process.stdout is not None
            for line in process.stdout:
                lines.append(line.rstrip())
                if heard is not None:
                    heard(line.strip())
            code = process.wait()
        except BaseException:
            process.kill()
            raise
        finally:
            process.stdout.close()
        if self.cancelled.is_set():
            raise _Cancelled
        if code:
            raise subprocess.CalledProcessError(code, command, output="\n".join(lines[-8:]))

    def pip(self, command: list[str], environment: Path) -> None:
        """Runs pip, saying what it collects and downloads and how many packages it has installed."""
        over = threading.Event()

        def heard(line: str) -> None:
            if line.startswith("Collecting "):
                self._collected += 1
                self.tell(0.05 + 0.5 * (1 - math.exp(-self._collected / 25)), line.split(" (from")[0])
            elif line.startswith(("Downloading ", "Building ")):
                self.tell(self._fraction, re.sub(r"-(cp|py)\d\S*", "", line))
            elif line.startswith("Installing collected packages:"):
                count = line.count(",") + 1
                threading.Thread(target=self._count, args=(environment, count, over), daemon=True).start()

        try:
            self.run(command, heard=heard)
        finally:
            over.set()

    def stop(self) -> None:
        """Ends what runs, from another thread; the main thread then cleans up."""
        self.cancelled.set()
        if os.name != "nt" and os.getpgrp() == os.getpid():
            # All that pip started, and ourselves: the handler makes an exception of it.
            os.killpg(0, signal.SIGTERM)
        elif self._child is not None:
            self._child.terminate()

    def _count(self, environment: Path, count: int, over: threading.Event) -> None:
        before = _installed(environment)
        while not over.wait(_COUNT_INTERVAL_S):
            done = min(_installed(environment) - before, count)
            self.tell(0.6 + 0.35 * done / count, Told(_COUNTED, done=done, count=count))


def _installed(environment: Path) -> int:
    return sum(1 for folder in PACKAGE_FOLDERS for _ in environment.glob(f"{folder}/*.dist-info"))


def _wants_cpu_torch() -> bool:
    return platform.system() == "Linux"


def _put_aside(into: Path) -> Path:
    """Moves a working environment out of the way, and takes away what is left of attempts that were cut off."""
    aside = into.with_name(OLD.format(name=into.name))
    for left in (f"{into.name}.*.deleted", f"{_BUILD}*"):
        for rest in into.parent.glob(left):
            _delete_detached(rest)
    try:
        if (into / READY).is_file():
            _take_away(aside)
            into.rename(aside)
        else:
            _take_away(into)
    except PermissionError:
        # Windows renames nothing of which a file is open.
        raise _MakingError(_IN_USE, folder=str(into)) from None
    return aside


def _restore(into: Path, aside: Path) -> None:
    """Brings back what worked before anything is deleted, for whoever waits may end this process meanwhile."""
    # Where Windows still holds a file of it, it stays, and the next attempt takes it away; Blender finds what is aside.
    with contextlib.suppress(OSError):
        failed = _renamed(into) if into.exists() else None
        if aside.exists():
            aside.rename(into)
        if failed is not None:
            _delete_detached(failed)


def _take_away(folder: Path) -> None:
    """Takes a folder away at once; its gigabytes are deleted by a process of their own, which may take a while.

    Raises:
        PermissionError: it is in use, and the system is Windows.
    """
    if folder.exists():
        _delete_detached(_renamed(folder))


def _renamed(folder: Path) -> Path:
    return folder.rename(folder.with_name(f"{folder.name}.{os.getpid()}-{time.monotonic_ns()}.deleted"))


def _delete_detached(folder: Path) -> None:
    path = _any_length(str(folder.absolute())) if os.name == "nt" else str(folder)
    detached = (
        {"creationflags": subprocess.DETACHED_PROCESS | subprocess.CREATE_NEW_PROCESS_GROUP}
        if os.name == "nt"
        else {"start_new_session": True}
    )
    subprocess.Popen(
        [sys.executable, "-c", "import shutil, sys; shutil.rmtree(sys.argv[1], ignore_errors=True)", path],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        **detached,
    )


def _any_length(path: str) -> str:
    """An absolute path of Windows, which takes no longer ones than 260 characters otherwise."""
    if path.startswith("\\\\?\\"):
        return path
    return f"\\\\?\\UNC\\{path[2:]}" if path.startswith("\\\\") else f"\\\\?\\{path}"


def _explained(error: Exception, into: Path) -> Told:
    if isinstance(error, subprocess.CalledProcessError):
        return Told(_FAILED, folder=str(into), reason=str(error.output or error))
    return Told(_REFUSED, folder=str(into), reason=str(error))


def _send(message_type: str, /, **content: object) -> None:
    # Whoever listened may be gone.
    with contextlib.suppress(OSError):
        print(json.dumps({"type": message_type, **content}), flush=True)


def _on_terminate(number: int, frame: object) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    raise _Cancelled


def _stop_with_standard_input(steps: _Steps) -> None:
    """A line, or the end of standard input, means cancel."""
    sys.stdin.readline()
    steps.stop()


if __name__ == "__main__":
    sys.exit(main())
