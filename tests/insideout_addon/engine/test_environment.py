"""Where the engine's Python is looked for, and how its environment is made."""

from __future__ import annotations

import platform
import subprocess
import sys
import time
from pathlib import Path

import pytest

import insideout
from insideout.core.errors import SettingError
from insideout.insideout_addon.engine import environment, setup_environment
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


def test_cancelling_takes_half_a_second_and_leaves_what_was_there(tiny_extension, folder):
    python = _python(folder / "bin" / "python")
    (folder / setup_environment.READY).write_text("{}", "utf-8")
    stuck = _BACKEND + "\nimport time\ntime.sleep(60)"
    (tiny_extension / "core" / "backend.py").write_text(stuck, "utf-8")
    process = _make(tiny_extension, folder)
    deadline = time.monotonic() + 60
    while not (folder / "bin" / "pip").exists():
        assert time.monotonic() < deadline
        process.poll()
        time.sleep(0.05)
    time.sleep(1.0)
    began = time.monotonic()
    process.cancel()
    assert process.wait()["type"] == "cancelled"
    assert time.monotonic() - began < 1.0
    assert environment.locate_engine().python == python
    _wait_until_gone(folder.parent, "engine.*")


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
