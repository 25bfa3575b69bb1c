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
