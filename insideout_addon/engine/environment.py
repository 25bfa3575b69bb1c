"""Where the engine's Python is, and what making one takes."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import bpy

from .setup_environment import READY

ENGINE_VARIABLE = "INSIDEOUT_ENGINE"
PACKAGE = __package__.rsplit(".", 2)[0]


@dataclass(frozen=True)
class EngineLocation:
    """Attributes: python, the interpreter; source, where it was found, for the user to read."""

    python: Path
    source: str


def locate_engine() -> EngineLocation | None:
    """The engine's Python: of the preferences, else of INSIDEOUT_ENGINE, else the one made by the button.

    Only looks whether the file is there; `core.worker version` tells whether it works.
    """
    for path, source in (
        (preferred_python(), "preferences"),
        (os.environ.get(ENGINE_VARIABLE, ""), ENGINE_VARIABLE),
        (made_python(), "made by InsideOut"),
    ):
        if path and Path(path).is_file():
            return EngineLocation(Path(path), source)
    return None


def preferred_python() -> str:
    """The path set in the add-on's preferences, or ""."""
    addon = bpy.context.preferences.addons.get(PACKAGE)
    return bpy.path.abspath(addon.preferences.engine_python) if addon and addon.preferences else ""


def engine_folder() -> Path | None:
    """Where the button makes the environment; None when not installed as an extension."""
    try:
        return Path(bpy.utils.extension_path_user(PACKAGE, path="engine", create=False))
    except ValueError:
        return None


def made_python() -> str:
    """The Python of the environment that the button made to the end, or ""."""
    folder = engine_folder()
    if folder is None or not (folder / READY).is_file():
        return ""
    return str(folder.joinpath(*(("Scripts", "python.exe") if os.name == "nt" else ("bin", "python"))))


def extension_root() -> Path:
    """The folder of this extension, which is a pip package too."""
    return Path(__file__).resolve().parents[2]


def find_python() -> Path | None:
    """A Python 3.11 to make the environment with: Blender's own when it is one, else one on the system."""
    if sys.version_info[:2] == (3, 11) and Path(sys.executable).name.lower().startswith("python"):
        return Path(sys.executable)
    names = ["python3.11", "python3", "python"]
    pyenv = sorted((Path.home() / ".pyenv" / "versions").glob("3.11.*/bin/python3.11"))
    for found in [*map(shutil.which, names), *map(str, pyenv)]:
        if found and _is_python_311(found):
            return Path(found)
    launcher = shutil.which("py")
    if launcher:
        path = _ask(launcher, "-3.11", "-c", "import sys; print(sys.executable)")
        return Path(path) if path else None
    return None


def setup_command(python: Path, folder: Path) -> list[str]:
    """The command that makes the environment in `folder`; it speaks the engine's protocol."""
    script = Path(__file__).with_name("setup_environment.py")
    return [str(python), str(script), "--source", str(extension_root()), "--into", str(folder)]


def _is_python_311(path: str) -> bool:
    return _ask(path, "-c", "import sys, venv, ensurepip; print(*sys.version_info[:2])") == "3 11"


def _ask(*command: str) -> str:
    try:
        answer = subprocess.run(command, capture_output=True, text=True, timeout=5, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return answer.stdout.strip() if answer.returncode == 0 else ""
