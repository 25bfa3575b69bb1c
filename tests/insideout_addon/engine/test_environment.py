"""Where the engine's Python is looked for, and how its environment is made."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from insideout.insideout_addon.engine import environment, setup_environment
from insideout.insideout_addon.engine.process import EngineProcess


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The extension's user folder in a temporary place, and no engine elsewhere."""
    monkeypatch.setattr(environment, "engine_folder", lambda: tmp_path / "engine")
    monkeypatch.setattr(environment, "preferred_python", lambda: "")
    monkeypatch.delenv("INSIDEOUT_ENGINE", raising=False)
    return tmp_path / "engine"


def _python(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("", "utf-8")
    return path


@pytest.fixture
def tiny_extension(tmp_path):
    """A folder like the extension's that installs without any download."""
    source = tmp_path / "source"
    for name in ("core", "insideout_addon", "operators", "panels", "core/__pycache__"):
        (source / name).mkdir(parents=True)
        (source / name / "__init__.py").write_text("", "utf-8")
    (source / "__init__.py").write_text("", "utf-8")
    (source / "pyproject.toml").write_text("this is no project file", "utf-8")
    return source


def test_nothing_is_found_where_nothing_is(folder):
    assert environment.locate_engine() is None


def test_preferences_come_first_then_the_variable_then_our_own(folder, tmp_path, monkeypatch):
    own = _python(folder / "bin" / "python")
    (folder / setup_environment.READY).write_text("{}", "utf-8")
    assert environment.locate_engine().python == own
    variable = _python(tmp_path / "by-variable")
    monkeypatch.setenv("INSIDEOUT_ENGINE", str(variable))
    assert environment.locate_engine().python == variable
    preferred = _python(tmp_path / "preferred")
    monkeypatch.setattr(environment, "preferred_python", lambda: str(preferred))
    assert environment.locate_engine().source == "preferences"


def test_a_half_made_environment_does_not_count(folder):
    _python(folder / "bin" / "python")
    assert environment.locate_engine() is None


def test_a_path_to_nowhere_does_not_count(folder, monkeypatch):
    monkeypatch.setenv("INSIDEOUT_ENGINE", "/no/such/python")
    assert environment.locate_engine() is None


def test_a_python_311_is_found_to_make_it_with(blender):
    assert environment.find_python() is not None


def test_the_package_is_copied_without_caches_and_the_original_stays(tiny_extension, tmp_path):
    before = sorted(tiny_extension.rglob("*"))
    copy = setup_environment.copy_package(tiny_extension, tmp_path / "copy")
    assert (copy / "core" / "__init__.py").is_file()
    assert not list(copy.rglob("__pycache__"))
    assert sorted(tiny_extension.rglob("*")) == before


def test_a_failing_pip_is_told_and_leaves_nothing(tiny_extension, tmp_path):
    """The project file is broken on purpose: pip fails without a network."""
    into = tmp_path / "made"
    process = EngineProcess(
        [sys.executable, setup_environment.__file__, "--source", str(tiny_extension), "--into", str(into)]
    )
    last = process.wait()
    assert last["type"] == "error"
    assert "TOML" in last["message"]
    assert not into.exists()


def test_making_it_can_be_cancelled(tiny_extension, tmp_path):
    process = EngineProcess(
        [sys.executable, setup_environment.__file__, "--source", str(tiny_extension), "--into", str(tmp_path / "m")]
    )
    process.cancel()
    assert process.wait()["type"] == "cancelled"
    assert not (tmp_path / "m" / setup_environment.READY).exists()


def test_the_extension_is_the_package_that_pip_installs():
    root = environment.extension_root()
    assert (root / "pyproject.toml").is_file()
    assert (root / "core" / "worker.py").is_file()
