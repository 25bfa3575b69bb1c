"""Where the engine's Python is, and what making one takes."""

from __future__ import annotations

import contextlib
import importlib.metadata
import importlib.util
import json
import os
import platform
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import bpy
from bpy.app.translations import pgettext_n as n_
from bpy.app.translations import pgettext_rpt as rpt_

from ... import __version__
from ...core.errors import SettingError
from ...core.processes import NO_CONSOLE
from .setup_environment import OLD, PACKAGE_FOLDERS, READY

ENGINE_VARIABLE = "INSIDEOUT_ENGINE"
_MADE = n_("made by InsideOut")
PACKAGE = __package__.rsplit(".", 2)[0]
# Where Homebrew, python.org and programs for one user put theirs.
_USUAL_PLACES = (
    "/opt/homebrew/bin",
    "/usr/local/bin",
    "/Library/Frameworks/Python.framework/Versions/3.11/bin",
    "~/.local/bin",
)
_USUAL_PLACES_OF_WINDOWS = (r"%LOCALAPPDATA%\Programs\Python\Python311", r"%ProgramFiles%\Python311")
# Where Windows keeps programs from the Microsoft Store.
_STORE = "windowsapps"


@dataclass(frozen=True)
class EngineLocation:
    """Where the engine runs.

    Attributes:
        python: the interpreter.
        source: where it was found, for the user to read.
        outdated: whether the button made it with another version of InsideOut than this one.
    """

    python: Path
    source: str
    outdated: bool = False


def locate_engine() -> EngineLocation | None:
    """The engine's Python, an absolute path, or None where there is none.

    The first of: that of the preferences, of INSIDEOUT_ENGINE, the one made by the button, the running Python
    where Blender is a module in it and the engine is installed too, `.venv` of the checkout that the add-on is in.
    Only looks whether the file is there; `core.worker version` tells whether it works.

    Raises:
        SettingError: the user has chosen one that is no file; another in its place would be a surprise.
    """
    for path, source, chosen in (
        (preferred_python(), n_("preferences"), n_("Engine Python in the preferences")),
        (os.environ.get(ENGINE_VARIABLE, ""), ENGINE_VARIABLE, ENGINE_VARIABLE),
        (made_python(), _MADE, ""),
        (running_python(), n_("the running Python"), ""),
        (checkout_python(), n_("the checkout's .venv"), ""),
    ):
        if path and os.path.isfile(path):
            # Not resolved: a virtual environment's Python is a link out of it.
            outdated = source == _MADE and _made_version() != __version__
            return EngineLocation(Path(path).absolute(), source, outdated)
        if path and chosen:
            raise SettingError(
                "{path}: {setting} is a folder; choose the program python of an environment with insideout, or clear "
                "it."
                if os.path.isdir(path)
                else "{path}: {setting} is not there; choose the program python of an environment with insideout, or "
                "clear it.",
                path=path,
                setting=rpt_(chosen),
            )
    return None


def preferred_python() -> str:
    """The path set in the add-on's preferences, or ""."""
    addon = bpy.context.preferences.addons.get(PACKAGE)
    return bpy.path.abspath(addon.preferences.engine_python) if addon and addon.preferences else ""


def engine_folder() -> Path | None:
    """Where the button makes the environment; None when not installed as an extension."""
    installed, local = _extension_folder(), os.environ.get("LOCALAPPDATA", "")
    if installed is None or platform.system() != "Windows" or not local:
        return installed
    # Windows takes no longer paths than 260 characters unless it is told to, and some of torch's have 167.
    return Path(local) / "InsideOut" / "engine"


def _extension_folder() -> Path | None:
    try:
        return Path(bpy.utils.extension_path_user(PACKAGE, path="engine", create=False))
    except ValueError:
        return None


def is_made(folder: Path) -> bool:
    """Whether a folder holds an environment that was made to the end."""
    return (folder / READY).is_file()


def made_python() -> str:
    """The Python of the environment that the button made to the end, or ""."""
    folder = _made_folder()
    return "" if folder is None else str(_python_in(folder))


def _made_folder() -> Path | None:
    """Also one that was put aside by an attempt that was cut off, or goes on; and one where it was made before."""
    for folder in (engine_folder(), _extension_folder()):
        if folder is None:
            continue
        for place in (folder, folder.with_name(OLD.format(name=folder.name))):
            if is_made(place):
                return place
    return None


def running_python() -> str:
    """The Python that imported Blender as a module, if the engine is installed in it, or ""."""
    if not bpy.app.module or importlib.util.find_spec("torch") is None:
        return ""
    # A checkout that a script has loaded by its path is no installed one.
    return sys.executable if any(importlib.metadata.distributions(name="insideout")) else ""


def checkout_python() -> str:
    """The Python of `.venv` beside the code, for those who run the add-on from a checkout, or ""."""
    folder = extension_root() / ".venv"
    installed = any(any(folder.glob(f"{where}/insideout-*.dist-info")) for where in PACKAGE_FOLDERS)
    return str(_python_in(folder)) if installed else ""


def _python_in(environment: Path) -> Path:
    return environment.joinpath(*(("Scripts", "python.exe") if os.name == "nt" else ("bin", "python")))


def _made_version() -> str:
    folder = _made_folder()
    with contextlib.suppress(OSError, ValueError, AttributeError):
        return str(json.loads((folder / READY).read_text("utf-8")).get("version", ""))
    return ""


def extension_root() -> Path:
    """The folder of this extension, which is a pip package too."""
    return Path(__file__).resolve().parents[2]


def find_python() -> Path | None:
    """A Python 3.11 to make the environment with: Blender's own when it is one, else one on the system.

    None of the Microsoft Store's: what those write below AppData, Blender does not see.
    """
    if sys.version_info[:2] == (3, 11) and Path(sys.executable).name.lower().startswith("python"):
        return Path(sys.executable)
    names = ["python3.11", "python3", "python"]
    pyenv = sorted((Path.home() / ".pyenv" / "versions").glob("3.11.*/bin/python3.11"))
    # A Blender that was started by a click does not know the shell's PATH.
    usual = [str(Path(place).expanduser() / "python3.11") for place in _USUAL_PLACES]
    usual += [os.path.join(os.path.expandvars(place), "python.exe") for place in _USUAL_PLACES_OF_WINDOWS]
    for found in [*map(shutil.which, names), *usual, *map(str, pyenv)]:
        if found and _is_python_311(found):
            return Path(found)
    launcher = shutil.which("py")
    found = _ask(launcher, "-3.11", "-c", "import sys; print(sys.executable)") if launcher else ""
    return Path(found) if found and _is_python_311(found) else None


def setup_command(python: Path, folder: Path) -> list[str]:
    """The command that makes the environment in `folder`; it speaks the engine's protocol."""
    script = Path(__file__).with_name("setup_environment.py")
    return [str(python), str(script), "--source", str(extension_root()), "--into", str(folder)]


def _is_python_311(path: str) -> bool:
    """Whether it is one that can make environments which Blender sees."""
    code = "import sys, venv, ensurepip; print(*sys.version_info[:2]); print(sys.base_prefix)"
    version, _, home = _ask(path, "-c", code).partition("\n")
    return version == "3 11" and not any(_STORE in place.lower() for place in (path, home))


def _ask(*command: str) -> str:
    # On Windows other Pythons write paths in a code page.
    spoken = {"encoding": "utf-8", "errors": "replace", "env": {**os.environ, "PYTHONUTF8": "1"}}
    try:
        answer = subprocess.run(command, capture_output=True, timeout=5, check=False, **spoken, **NO_CONSOLE)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return answer.stdout.strip() if answer.returncode == 0 else ""
