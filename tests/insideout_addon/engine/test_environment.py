"""Where the engine's Python is looked for, and how its environment is made."""

from __future__ import annotations

import json
import os
import platform
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import bpy
import pytest

import insideout
from insideout.core.errors import SettingError
from insideout.insideout_addon.engine import commands, environment, setup_environment
from insideout.insideout_addon.engine.process import EngineProcess


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The extension's user folder in a temporary place, and no engine elsewhere."""
    monkeypatch.setattr(environment, "engine_folder", lambda: tmp_path / "engine")
    for name in ("preferred_python", "running_python", "checkout_python"):
        monkeypatch.setattr(environment, name, lambda: "")
    monkeypatch.delenv("INSIDEOUT_ENGINE", raising=False)
    return tmp_path / "engine"


def _python(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("", "utf-8")
    return path


# A build backend of its own, so that pip needs no network: a wheel is a zip with three files about it.
_BACKEND = """
import os, pathlib, zipfile

def build_wheel(wheel_directory, config_settings=None, metadata_directory=None):
    name = "insideout-0.1.0-py3-none-any.whl"
    about = "insideout-0.1.0.dist-info/"
    with zipfile.ZipFile(os.path.join(wheel_directory, name), "w") as wheel:
        for path in pathlib.Path(".").rglob("*.py"):
            wheel.write(path, f"insideout/{path}")
        wheel.writestr(about + "METADATA", "Metadata-Version: 2.1\\nName: insideout\\nVersion: 0.1.0\\n")
        wheel.writestr(about + "WHEEL", "Wheel-Version: 1.0\\nRoot-Is-Purelib: true\\nTag: py3-none-any\\n")
        wheel.writestr(about + "RECORD", "")
    return name
"""
_PROJECT = f"""
[project]
name = "insideout"
version = "{insideout.__version__}"
[build-system]
requires = []
build-backend = "backend"
backend-path = ["core"]
"""
_WORKER = 'print(\'{"type": "version", "insideout": "tiny"}\')'


@pytest.fixture
def tiny_extension(tmp_path, monkeypatch):
    """A folder like the extension's that installs without any download."""
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    source = tmp_path / "source"
    for name in ("core", "insideout_addon", "operators", "panels", "core/__pycache__"):
        (source / name).mkdir(parents=True)
        (source / name / "__init__.py").write_text("", "utf-8")
    (source / "__init__.py").write_text("", "utf-8")
    (source / "pyproject.toml").write_text(_PROJECT, "utf-8")
    (source / "core" / "backend.py").write_text(_BACKEND, "utf-8")
    (source / "core" / "worker.py").write_text(_WORKER, "utf-8")
    return source


def _make(source, into):
    return EngineProcess([sys.executable, setup_environment.__file__, "--source", str(source), "--into", str(into)])


def _made(folder):
    """An environment that works, or looks so."""
    (folder / "bin").mkdir(parents=True)
    about = {"python": "", "version": insideout.__version__}
    (folder / setup_environment.READY).write_text(json.dumps(about), "utf-8")
    return _python(folder / "bin" / "python")


def _make_until_pip_is_stuck(tiny_extension, folder):
    stuck = _BACKEND + "\nimport tempfile, time\ntempfile.mkdtemp('left')\ntime.sleep(60)"
    (tiny_extension / "core" / "backend.py").write_text(stuck, "utf-8")
    process = _make(tiny_extension, folder)
    deadline = time.monotonic() + 60
    while not list(folder.parent.glob("insideout-build-*/**/*left")):
        assert time.monotonic() < deadline
        process.poll()
        time.sleep(0.05)
    return process


def _wait_until_gone(folder, pattern):
    deadline = time.monotonic() + 20
    while list(folder.glob(pattern)):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_nothing_is_found_where_nothing_is(folder):
    assert environment.locate_engine() is None


def test_preferences_come_first_then_the_variable_then_our_own(folder, tmp_path, monkeypatch):
    own = _python(folder / "bin" / "python")
    (folder / setup_environment.READY).write_text("{}", "utf-8")
    assert environment.locate_engine().python == own
    assert environment.locate_engine().outdated, "nothing says of which version it is"
    variable = _python(tmp_path / "by-variable")
    monkeypatch.setenv("INSIDEOUT_ENGINE", str(variable))
    assert environment.locate_engine().python == variable
    preferred = _python(tmp_path / "preferred")
    monkeypatch.setattr(environment, "preferred_python", lambda: str(preferred))
    assert environment.locate_engine().source == "preferences"


def test_a_half_made_environment_does_not_count(folder):
    _python(folder / "bin" / "python")
    assert environment.locate_engine() is None


def test_a_chosen_path_to_nowhere_is_told_and_no_other_is_taken(folder, monkeypatch, tmp_path):
    _python(folder / "bin" / "python")
    (folder / setup_environment.READY).write_text("{}", "utf-8")
    monkeypatch.setenv("INSIDEOUT_ENGINE", "/no/such/python")
    with pytest.raises(SettingError, match="/no/such/python: INSIDEOUT_ENGINE is not there; choose"):
        environment.locate_engine()
    monkeypatch.setattr(environment, "preferred_python", lambda: str(tmp_path))
    with pytest.raises(SettingError, match="Engine Python in the preferences is a folder; choose the program python"):
        environment.locate_engine()


def test_a_relative_path_is_made_absolute_for_the_engine_starts_elsewhere(folder, monkeypatch, tmp_path):
    _python(tmp_path / "eng")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("INSIDEOUT_ENGINE", "./eng")
    assert environment.locate_engine().python == tmp_path / "eng"


class TestWithoutAChoice:
    """What a check-out or a Python with Blender in it has already."""

    def test_the_running_python_where_blender_is_a_module(self, monkeypatch, tmp_path):
        for name, content in (("torch/__init__.py", ""), ("insideout-0.1.0.dist-info/METADATA", "Name: insideout")):
            (tmp_path / name).parent.mkdir()
            (tmp_path / name).write_text(content, "utf-8")
        monkeypatch.syspath_prepend(tmp_path)
        assert environment.running_python() == sys.executable
        monkeypatch.setattr(environment.importlib.metadata, "distributions", lambda name: iter(()))
        assert environment.running_python() == "", "insideout was loaded by its path and is not installed"

    def test_the_environment_beside_the_code(self, tmp_path, monkeypatch):
        python = _python(tmp_path / ".venv" / "bin" / "python")
        packages = tmp_path / ".venv" / "lib" / "python3.11" / "site-packages"
        monkeypatch.setattr(environment, "extension_root", lambda: tmp_path)
        assert environment.checkout_python() == "", "anybody's .venv is not the engine's"
        (packages / "insideout-0.1.0.dist-info").mkdir(parents=True)
        assert environment.checkout_python() == str(python)
        monkeypatch.setattr(environment, "extension_root", lambda: tmp_path / "elsewhere")
        assert environment.checkout_python() == ""

    def test_both_come_last(self, no_engine, monkeypatch, tmp_path):
        for name in ("checkout", "running"):
            path = _python(tmp_path / name)
            monkeypatch.setattr(environment, f"{name}_python", lambda path=path: str(path))
            assert environment.locate_engine().python == path


def test_a_python_311_is_found_to_make_it_with(blender):
    assert environment.find_python() is not None


def test_a_python_that_is_not_in_the_path_is_found_in_the_usual_places(monkeypatch, tmp_path):
    (tmp_path / "python3.11").write_text("#!/bin/sh\necho 3 11\n", "utf-8")
    (tmp_path / "python3.11").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path / "nothing"))
    monkeypatch.setattr(environment.sys, "version_info", (3, 13, 0))
    monkeypatch.setattr(environment, "_USUAL_PLACES", (str(tmp_path),))
    assert environment.find_python() == tmp_path / "python3.11"


def test_a_graphics_card_brings_no_gigabytes_that_nothing_uses(monkeypatch, tmp_path):
    (tmp_path / "nvidia-smi").write_text("#!/bin/sh\n", "utf-8")
    (tmp_path / "nvidia-smi").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert setup_environment._wants_cpu_torch() == (platform.system() == "Linux")


def test_the_package_is_copied_without_caches_and_the_original_stays(tiny_extension, tmp_path):
    before = sorted(tiny_extension.rglob("*"))
    copy = setup_environment.copy_package(tiny_extension, tmp_path / "copy")
    assert (copy / "core" / "__init__.py").is_file()
    assert not list(copy.rglob("__pycache__"))
    assert sorted(tiny_extension.rglob("*")) == before


def test_it_is_made_found_and_made_again(tiny_extension, folder, monkeypatch, tmp_path):
    """Without a network: the try at PyTorch's own index fails and does not matter."""
    (tiny_extension / "constraints.txt").write_text("torch==0.0.1", "utf-8")
    monkeypatch.setenv("PATH", str(tmp_path))
    heard = []
    assert _make(tiny_extension, folder).wait(heard.append)["type"] == "done"
    made = environment.locate_engine()
    assert made.source == "made by InsideOut"
    assert not made.outdated
    answer = subprocess.run([made.python, "-m", "insideout.core.worker"], capture_output=True, text=True, check=True)
    assert "tiny" in answer.stdout
    fractions = [message["fraction"] for message in heard if message["type"] == "progress"]
    assert fractions == sorted(fractions)
    assert fractions[-1] > 0.9
    (tiny_extension / "core" / "worker.py").write_text(_WORKER.replace("tiny", "newer"), "utf-8")
    assert _make(tiny_extension, folder).wait()["type"] == "done"
    answer = subprocess.run([made.python, "-m", "insideout.core.worker"], capture_output=True, text=True, check=True)
    assert "newer" in answer.stdout
    _wait_until_gone(folder.parent, "engine.*")


def test_an_engine_that_does_not_start_is_told_and_leaves_nothing(tiny_extension, folder):
    (tiny_extension / "core" / "worker.py").write_text("raise SystemExit('no torch for this processor')", "utf-8")
    last = _make(tiny_extension, folder).wait()
    assert last["type"] == "error"
    assert "no torch for this processor" in last["message"]
    assert not folder.exists()
    _wait_until_gone(folder.parent, "engine.*")


def test_a_failing_pip_is_told_and_the_environment_that_worked_comes_back(tiny_extension, folder):
    """Even where an earlier attempt was cut off half way and had put it aside."""
    old = folder.with_name("engine.old")
    _python(old / "bin" / "python")
    (old / setup_environment.READY).write_text("{}", "utf-8")
    _python(folder / "bin" / "half")
    (tiny_extension / "pyproject.toml").write_text("this is no project file", "utf-8")
    last = _make(tiny_extension, folder).wait()
    assert last["type"] == "error"
    assert "TOML" in last["message"]
    assert environment.locate_engine().python == folder / "bin" / "python"
    _wait_until_gone(folder.parent, "engine.*")


def test_cancelling_takes_half_a_second_and_leaves_what_was_there(tiny_extension, folder, tmp_path, monkeypatch):
    """And none of pip's downloads: they lie on the disk that has room for them."""
    monkeypatch.setenv("TMPDIR", str(tmp_path / "system"))
    (tmp_path / "system").mkdir()
    python = _made(folder)
    process = _make_until_pip_is_stuck(tiny_extension, folder)
    began = time.monotonic()
    process.cancel()
    assert process.wait()["type"] == "cancelled"
    assert time.monotonic() - began < 1.0
    assert environment.locate_engine().python == python
    _wait_until_gone(folder.parent, "engine.*")
    _wait_until_gone(folder.parent, "insideout-build-*")
    assert not list((tmp_path / "system").iterdir())


def test_what_worked_is_found_after_an_attempt_that_was_cut_off(tiny_extension, folder):
    """Of which the next one leaves nothing."""
    _made(folder)
    process = _make_until_pip_is_stuck(tiny_extension, folder)
    os.killpg(process._process.pid, signal.SIGKILL)
    process.wait()
    found = environment.locate_engine()
    assert found.python == folder.with_name("engine.old") / "bin" / "python"
    assert not found.outdated
    (tiny_extension / "core" / "backend.py").write_text(_BACKEND, "utf-8")
    assert _make(tiny_extension, folder).wait()["type"] == "done"
    assert environment.locate_engine().python == folder / "bin" / "python"
    _wait_until_gone(folder.parent, "engine.*")
    _wait_until_gone(folder.parent, "insideout-build-*")


def test_what_worked_is_back_before_anything_is_deleted(folder, monkeypatch):
    """Blender ends whoever deletes for longer than half a second."""
    python, back = _made(folder), []

    def fill(source, into, steps):
        _python(into / "bin" / "half")
        raise OSError("no network")

    monkeypatch.setattr(setup_environment, "_fill", fill)
    monkeypatch.setattr(setup_environment, "_delete_detached", lambda doomed: back.append(environment.made_python()))
    with pytest.raises(OSError, match="no network"):
        setup_environment.make_environment(folder, folder, None)
    assert back == [str(python)]


def test_while_one_blender_makes_it_another_changes_nothing(tiny_extension, folder):
    _made(folder)
    with setup_environment._alone(folder):
        before = sorted(folder.parent.rglob("*"))
        last = _make(tiny_extension, folder).wait()
        assert sorted(folder.parent.rglob("*")) == before
    assert last["type"] == "error"
    assert last["message"] == f"Another Blender is making the engine's environment in {folder}; wait until it is done."
    assert _make(tiny_extension, folder).wait()["type"] == "done"


@pytest.mark.parametrize("worked", [True, False])
def test_an_engine_in_use_that_windows_does_not_rename_is_told_to_be(folder, monkeypatch, worked):
    python = _made(folder)
    if not worked:
        (folder / setup_environment.READY).unlink()

    def rename(path, target):
        raise PermissionError(13, "Access is denied", str(path))

    monkeypatch.setattr(Path, "rename", rename)
    with pytest.raises(setup_environment._MakingError, match="is in use; close other Blenders"):
        setup_environment.make_environment(folder, folder, None)
    assert python.is_file()


def test_a_full_disk_is_told_so_that_it_can_be_translated(tiny_extension, folder, monkeypatch, capsys):
    monkeypatch.setattr(setup_environment, "_NEEDED_BYTES", 1e18)
    monkeypatch.setattr(setup_environment.signal, "signal", lambda *_: None)
    monkeypatch.setattr(setup_environment, "_stop_with_standard_input", lambda steps: None)
    assert setup_environment.main(["--source", str(tiny_extension), "--into", str(folder)]) == 2
    last = json.loads(capsys.readouterr().out)
    assert "it takes 1000000000 GB and the disk has" in last["message"]
    assert last["told"]["template"] == setup_environment._REFUSED
    assert last["told"]["values"]["reason"]["template"] == setup_environment._NO_ROOM


def test_the_index_of_pytorch_is_asked_for_torch_alone(tiny_extension, folder, monkeypatch):
    """It has not all versions of what torch needs."""
    (tiny_extension / "constraints.txt").write_text("torch==0.0.1", "utf-8")
    monkeypatch.setattr(setup_environment, "_wants_cpu_torch", lambda: True)
    commands_of_pip = []
    steps = SimpleNamespace(
        tell=lambda *_: None,
        run=lambda command, cwd=None: folder.mkdir(exist_ok=True),
        pip=lambda command, into: commands_of_pip.append(command),
    )
    setup_environment.make_environment(tiny_extension, folder, steps)
    torch, package = commands_of_pip
    assert (torch[-1], "--no-deps" in torch, "--no-deps" in package) == ("torch", True, False)


class TestOnWindows:
    """What differs there, as far as it can be tried elsewhere."""

    @pytest.fixture
    def local(self, tmp_path, monkeypatch):
        monkeypatch.setattr(environment.platform, "system", lambda: "Windows")
        monkeypatch.setattr(environment, "_extension_folder", lambda: tmp_path / "extension" / "engine")
        monkeypatch.setenv("LOCALAPPDATA", str(tmp_path / "Local"))
        return tmp_path / "Local"

    def test_the_engine_lies_where_paths_stay_short(self, local):
        # Of a name of 20 letters; torch's longest path inside of site-packages has 167.
        inside = "\\".join(environment.engine_folder().relative_to(local).parts)
        assert len(rf"C:\Users\{20 * 'a'}\AppData\Local\{inside}\Lib\site-packages" + "\\") + 167 < 260

    def test_one_that_was_made_in_the_extension_s_folder_is_found_still(self, local, tmp_path):
        python = _made(tmp_path / "extension" / "engine")
        assert environment.made_python() == str(python)
        newer = _made(local / "InsideOut" / "engine")
        assert environment.made_python() == str(newer)

    def test_not_installed_as_an_extension_it_is_made_nowhere(self, local, monkeypatch):
        monkeypatch.setattr(environment, "_extension_folder", lambda: None)
        assert environment.engine_folder() is None

    @pytest.mark.parametrize(
        ("path", "long"),
        [
            ("C:\\Users\\a\\engine", "\\\\?\\C:\\Users\\a\\engine"),
            ("\\\\server\\share\\engine", "\\\\?\\UNC\\server\\share\\engine"),
            ("\\\\?\\C:\\engine", "\\\\?\\C:\\engine"),
        ],
    )
    def test_what_is_deleted_may_have_paths_of_any_length(self, path, long):
        assert setup_environment._any_length(path) == long


class TestOfTheMicrosoftStore:
    """What its Python writes below AppData is not where Blender looks."""

    @pytest.fixture
    def only(self, monkeypatch, tmp_path):
        """`only(path, says)`: a program in the only folder of PATH."""
        monkeypatch.setenv("PATH", str(tmp_path / "bin"))
        monkeypatch.setattr(environment.sys, "version_info", (3, 13, 0))
        monkeypatch.setattr(environment, "_USUAL_PLACES", ())
        monkeypatch.setattr(environment.Path, "home", lambda: tmp_path)

        def put(path, says):
            _python(path).write_text(f"#!/bin/sh\nprintf '{says}'\n", "utf-8")
            path.chmod(0o755)
            return path

        return put

    def test_one_from_elsewhere_is_taken(self, only, tmp_path):
        python = only(tmp_path / "bin" / "python3", "3 11\\n/Python311\\n")
        assert environment.find_python() == python

    def test_it_is_not_taken_nor_an_environment_of_it(self, only, tmp_path, monkeypatch):
        only(tmp_path / "bin" / "python3", "3 11\\n/Program Files/WindowsApps/PythonSoftwareFoundation\\n")
        assert environment.find_python() is None
        monkeypatch.setenv("PATH", str(tmp_path / "WindowsApps"))
        only(tmp_path / "WindowsApps" / "python3", "3 11\\n/elsewhere\\n")
        assert environment.find_python() is None

    def test_nor_where_the_launcher_names_it(self, only, tmp_path):
        python = only(tmp_path / "WindowsApps" / "python.exe", "3 11\\n/elsewhere\\n")
        only(tmp_path / "bin" / "py", str(python))
        assert environment.find_python() is None
        python = only(tmp_path / "Python311" / "python.exe", "3 11\\n/elsewhere\\n")
        only(tmp_path / "bin" / "py", str(python))
        assert environment.find_python() == python

    @pytest.mark.parametrize("seen", [True, False])
    def test_an_engine_that_blender_does_not_see_is_told(self, blender, folder, tmp_path, monkeypatch, seen):
        """Whatever made it said that it was done."""
        if seen:
            _made(folder)
        command = [sys.executable, "-c", 'print(\'{"type": "done"}\')']
        monkeypatch.setattr(commands, "setup_command", lambda python, into: command)
        told = []
        operator = SimpleNamespace(report=lambda kind, text: told.append(text))
        ended = commands.start_setup(operator, Path(sys.executable), folder)
        assert ended == {"FINISHED" if seen else "CANCELLED"}
        assert told == ([] if seen else [bpy.context.window_manager.insideout.error])
        assert seen or "Blender does not see it" in told[0]


def test_the_extension_is_the_package_that_pip_installs():
    root = environment.extension_root()
    assert (root / "pyproject.toml").is_file()
    assert (root / "core" / "worker.py").is_file()


def test_what_a_python_says_in_a_code_page_ends_in_no_traceback():
    code = "import sys; sys.stdout.buffer.write('C:/J\\u00f6rg/python.exe'.encode('cp1252'))"
    assert environment._ask(sys.executable, "-c", code).endswith("rg/python.exe")


def test_a_path_beyond_ascii_is_understood(monkeypatch):
    """Whatever the other Python writes by itself: here nothing beyond ASCII."""
    for name, value in (("LC_ALL", "C"), ("PYTHONCOERCECLOCALE", "0"), ("PYTHONUTF8", "0")):
        monkeypatch.setenv(name, value)
    assert environment._ask(sys.executable, "-c", "print('C:/J\\u00f6rg/python.exe')") == "C:/J\u00f6rg/python.exe"
