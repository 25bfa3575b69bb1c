"""What `make` does before there is anything to test: the environment, and where pip gets torch from."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

_ROOT = Path(__file__).resolve().parents[1]

pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="needs make")


def _make(folder, *arguments, **variables):
    answer = subprocess.run(
        ["make", "-C", str(folder), *arguments],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, **variables},
    )
    return answer.stdout + answer.stderr


def test_an_environment_that_was_left_without_pip_is_completed(tmp_path):
    """As it is where a Linux distribution's package for venv was missing the first time."""
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(_ROOT / name, tmp_path)
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(tmp_path / ".venv")], check=True)
    # Only pip's first step runs: nothing is to be downloaded here.
    said = _make(tmp_path, ".venv/.installed", f"PYTHON={sys.executable}", PIP_NO_INDEX="1")
    assert "No module named pip" not in said
    assert (tmp_path / ".venv" / "bin" / "pip").exists()


def test_pip_fetches_nothing_for_graphics_cards_and_follows_its_own_settings(tmp_path):
    """Torch comes first, from an index that has it without; all else from where pip is told to look."""
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(_ROOT / name, tmp_path)
    lines = [line for line in _make(tmp_path, "-n", ".venv/.installed").splitlines() if " install " in line]
    first = [number for number, line in enumerate(lines) if line.endswith("/whl/cpu torch")]
    assert bool(first) == (platform.system() == "Linux")
    assert [number for number, line in enumerate(lines) if "index-url" in line] == first
    assert "--editable" in lines[-1]


class TestBlender52:
    """It needs a Python 3.13 beside the 3.11, which not every machine has."""

    def test_without_its_python_it_is_left_out_and_says_so(self):
        said = _make(_ROOT, "test-bpy52", "PYTHON313=")
        assert "There is no python3.13 here, so Blender 5.2 is left out" in said
        assert "Error" not in said

    def test_another_python_is_refused_in_a_sentence(self, tmp_path):
        for name in ("Makefile", "constraints-bpy52.txt"):
            shutil.copy(_ROOT / name, tmp_path)
        said = _make(tmp_path, "test-bpy52", f"PYTHON313={sys.executable}")
        assert "Blender 5.2 needs Python 3.13; make test-bpy52 PYTHON313=/path/to/python3.13" in said
        assert not (tmp_path / ".venv-bpy52").exists()

    def test_the_checkout_is_linked_for_pip_would_refuse_it(self, tmp_path):
        for name in ("Makefile", "constraints-bpy52.txt"):
            shutil.copy(_ROOT / name, tmp_path)
        lines = _make(tmp_path, "-n", "test-bpy52", "PYTHON313=python3.13").splitlines()
        assert not [line for line in lines if "--editable" in line]
        assert f"ln -sfn {tmp_path} .venv-bpy52/lib/python3.13/site-packages/insideout" in lines
        tested = ".venv-bpy52/bin/pytest -q -n 2 --dist loadfile tests/insideout_addon "
        assert any(line.startswith(tested) for line in lines)

    def test_the_whole_suite_does_not_ask_for_it(self):
        lines = _make(_ROOT, "-n", "test", "PYTHON313=python3.13")
        assert ".venv-bpy45/bin/pytest" in lines
        assert "bpy52" not in lines
