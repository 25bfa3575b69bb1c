"""Makes the engine's environment. Run as a script by a Python 3.11; prints JSON lines as the engine does.

Standard library alone, because it runs before anything is installed. READY is written last: an environment
without it is the rest of an attempt that was cut off, and is made again. An environment that worked is put aside
meanwhile and comes back when the new one fails.
"""

from __future__ import annotations

import argparse
import contextlib
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
from collections.abc import Callable
from pathlib import Path

READY = "insideout-engine.json"
# Where an environment keeps its packages: of Linux and macOS, of Windows.
PACKAGE_FOLDERS = ("lib/*/site-packages", "Lib/site-packages")
# What pip needs of the extension to build the package.
_PARTS = ("core", "insideout_addon", "operators", "panels")
_FILES = ("__init__.py", "pyproject.toml", "README.md", "constraints.txt")
_NEEDED_BYTES = 5e9
# PyPI's torch for Linux brings several GB of CUDA, which the engine has no use for.
_CPU_INDEX = "https://download.pytorch.org/whl/cpu"
_COUNT_INTERVAL_S = 0.5


class _Cancelled(BaseException):
    """Blender asked to stop, or is gone."""


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
    except (OSError, subprocess.CalledProcessError) as error:
        _send("error", kind=type(error).__name__, message=_explain(error, options.into))
        return 2
    _send("done", python=str(python))
    return 0


def make_environment(source: Path, into: Path, steps: _Steps) -> Path:
    """Makes `into` an environment with the package of `source` in it and returns its Python.

    Raises:
        subprocess.CalledProcessError: venv or pip failed; `output` holds the end of what it said.
        OSError: a folder cannot be written, or the disk is too full.
    """
    into.parent.mkdir(parents=True, exist_ok=True)
    aside = _put_aside(into)
    free = shutil.disk_usage(into.parent).free
    try:
        if free < _NEEDED_BYTES:
            raise OSError(f"it takes {_NEEDED_BYTES / 1e9:.0f} GB and the disk has {free / 1e9:.1f} GB left")
        python = _fill(source, into, steps)
    except BaseException:
        _discard(into)
        if aside.exists():
            aside.rename(into)
        raise
    _discard(aside)
    return python


def _fill(source: Path, into: Path, steps: _Steps) -> Path:
    steps.tell(0.01, "Making an empty environment")
    steps.run([sys.executable, "-m", "venv", str(into)])
    python = into / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    pip = [str(python), "-m", "pip", "install", "--no-input", "--disable-pip-version-check"]
    with tempfile.TemporaryDirectory(prefix="insideout-build-") as folder:
        package = copy_package(source, Path(folder) / "insideout")
        constraints = package / "constraints.txt"
        if constraints.is_file():
            pip += ["--constraint", str(constraints)]
            if _wants_cpu_torch():
                # Where that index cannot be reached the next step takes PyPI's.
                with contextlib.suppress(subprocess.CalledProcessError):
                    steps.pip([*pip, "--retries", "0", "--index-url", _CPU_INDEX, "torch"], into)
        steps.pip([*pip, str(package)], into)
    steps.tell(0.96, "Trying the engine")
    steps.run([str(python), "-m", "insideout.core.worker", "version"], cwd=into)
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
        self._child: subprocess.Popen[str] | None = None
        self._fraction = 0.0
        self._collected = 0

    def tell(self, fraction: float, message: str) -> None:
        """Reports progress; the fraction never goes back."""
        self._fraction = max(self._fraction, fraction)
        _send("progress", stage="environment", fraction=self._fraction, message=message[:120])

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
            self.tell(0.6 + 0.35 * done / count, f"Installing packages: {done} of {count}")


def _installed(environment: Path) -> int:
    return sum(1 for folder in PACKAGE_FOLDERS for _ in environment.glob(f"{folder}/*.dist-info"))


def _wants_cpu_torch() -> bool:
    return platform.system() == "Linux"


def _put_aside(into: Path) -> Path:
    """Moves a working environment out of the way, and takes away what is left of attempts that were cut off."""
    aside = into.with_name(f"{into.name}.old")
    for rest in into.parent.glob(f"{into.name}.*.deleted"):
        _delete_detached(rest)
    if (into / READY).is_file():
        _discard(aside)
        into.rename(aside)
    elif into.exists():
        _discard(into)
    return aside


def _discard(folder: Path) -> None:
    """Takes a folder away at once; its gigabytes are deleted by a process of their own, which may take a while."""
    if not folder.exists():
        return
    doomed = folder.with_name(f"{folder.name}.{os.getpid()}-{time.monotonic_ns()}.deleted")
    try:
        folder.rename(doomed)
    except OSError:
        shutil.rmtree(folder, ignore_errors=True)
        return
    _delete_detached(doomed)


def _delete_detached(folder: Path) -> None:
    detached = (
        {"creationflags": subprocess.DETACHED_PROCESS | subprocess.CREATE_NEW_PROCESS_GROUP}
        if os.name == "nt"
        else {"start_new_session": True}
    )
    subprocess.Popen(
        [sys.executable, "-c", "import shutil, sys; shutil.rmtree(sys.argv[1], ignore_errors=True)", str(folder)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        **detached,
    )


def _explain(error: Exception, into: Path) -> str:
    if isinstance(error, subprocess.CalledProcessError):
        return f"The engine's environment could not be made in {into}: {error.output or error}"
    return f"The engine's environment could not be made in {into}: {error}; make room or choose another disk."


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
