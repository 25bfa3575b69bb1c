"""Makes the engine's environment. Run as a script by a Python 3.11; prints JSON lines as the engine does.

Standard library alone, because it runs before anything is installed. READY is written last: an environment
without it is the rest of an attempt that was cancelled, and is made again.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

READY = "insideout-engine.json"
# What pip needs of the extension to build the package.
_PARTS = ("core", "insideout_addon", "operators", "panels")
_FILES = ("__init__.py", "pyproject.toml", "README.md", "constraints.txt")


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--source", type=Path, required=True, help="the extension's folder")
    parser.add_argument("--into", type=Path, required=True, help="the environment to make")
    options = parser.parse_args(arguments)
    threading.Thread(target=_stop_with_standard_input, daemon=True).start()
    try:
        python = make_environment(options.source, options.into)
    except (OSError, subprocess.CalledProcessError) as error:
        _send("error", kind=type(error).__name__, message=_explain(error, options.into))
        return 2
    _send("done", python=str(python))
    return 0


def make_environment(source: Path, into: Path) -> Path:
    """Makes `into` an environment with the package of `source` in it and returns its Python.

    Raises:
        subprocess.CalledProcessError: venv or pip failed; `output` holds the end of what it said.
        OSError: a folder cannot be written.
    """
    if into.exists():
        shutil.rmtree(into)
    into.parent.mkdir(parents=True, exist_ok=True)
    try:
        _send("progress", stage="environment", fraction=0.02, message="Making an empty environment")
        _run([sys.executable, "-m", "venv", str(into)])
        python = into / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
        with tempfile.TemporaryDirectory(prefix="insideout-build-") as folder:
            package = copy_package(source, Path(folder) / "insideout")
            pip = [str(python), "-m", "pip", "install", "--no-input", "--disable-pip-version-check"]
            constraints = package / "constraints.txt"
            if constraints.is_file():
                pip += ["--constraint", str(constraints)]
            _run([*pip, str(package)])
        _send("progress", stage="environment", fraction=0.95, message="Trying the engine")
        _run([str(python), "-m", "insideout.core.worker", "version"], cwd=into)
        (into / READY).write_text(json.dumps({"python": str(python)}) + "\n", "utf-8")
    except BaseException:
        shutil.rmtree(into, ignore_errors=True)
        raise
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


def _run(command: list[str], cwd: Path | None = None) -> None:
    """Runs a command, passes its lines on as progress, and raises with its last lines when it fails."""
    lines: list[str] = []
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=cwd
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            lines.append(line.rstrip())
            _send("progress", stage="environment", fraction=_pip_fraction(line), message=line.strip()[:120])
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command, output="\n".join(lines[-8:]))


def _pip_fraction(line: str) -> float:
    for fraction, word in ((0.8, "Installing"), (0.2, "Downloading"), (0.1, "Collecting"), (0.05, "Processing")):
        if line.lstrip().startswith(word):
            return fraction
    return 0.9 if line.startswith("Successfully") else 0.15


def _explain(error: Exception, into: Path) -> str:
    if isinstance(error, subprocess.CalledProcessError):
        return f"The engine's environment could not be made in {into}: {error.output or error}"
    return f"The engine's environment could not be made in {into}: {error}; check the folder's permissions."


def _send(message_type: str, /, **content: object) -> None:
    print(json.dumps({"type": message_type, **content}), flush=True)


def _stop_with_standard_input() -> None:
    """A line, or the end of standard input, means cancel: pip and what it started end with this process."""
    sys.stdin.readline()
    _send("cancelled")
    if os.name != "nt" and os.getpgrp() == os.getpid():
        os.killpg(0, signal.SIGKILL)
    os._exit(130)


if __name__ == "__main__":
    sys.exit(main())
