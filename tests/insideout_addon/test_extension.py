"""The zip that Blender installs: builds, validates, holds what it needs and nothing else."""

from __future__ import annotations

import re
import subprocess
import sys
import zipfile
from pathlib import Path

import bpy
import pytest

_ROOT = Path(__file__).resolve().parents[2]
_TOOL = Path(bpy.utils.system_resource("SCRIPTS")) / "addons_core" / "bl_pkg" / "cli" / "blender_ext.py"


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    """The built zip."""
    target = tmp_path_factory.mktemp("zip") / "insideout.zip"
    command = [sys.executable, str(_TOOL), "build", "--source-dir", str(_ROOT), "--output-filepath", str(target)]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stdout + built.stderr
    return target


def test_it_validates(package):
    answer = subprocess.run(
        [sys.executable, str(_TOOL), "validate", str(package)], capture_output=True, text=True, check=False
    )
    assert answer.returncode == 0, answer.stdout + answer.stderr


def test_it_holds_the_add_on_and_the_engines_source(package):
    names = set(zipfile.ZipFile(package).namelist())
    wanted = {
        "__init__.py",
        "blender_manifest.toml",
        "pyproject.toml",
        "README.md",
        "core/worker.py",
        "core/ply.py",
        "insideout_addon/registration.py",
        "insideout_addon/engine/setup_environment.py",
        "operators/reconstruct.py",
        "panels/section.py",
    }
    assert wanted <= names


def test_it_holds_nothing_else(package):
    roots = {name.split("/")[0] for name in zipfile.ZipFile(package).namelist()}
    allowed = {"core", "insideout_addon", "operators", "panels", "__init__.py", "blender_manifest.toml"}
    assert roots - allowed <= {"pyproject.toml", "README.md", "LICENSE", "constraints.txt", "CHANGELOG.md"}
    assert not [name for name in zipfile.ZipFile(package).namelist() if "__pycache__" in name]
    assert package.stat().st_size < 3e6


def test_versions_agree():
    versions = {
        re.search(r'^(?:__version__|version) = "(.*)"', (_ROOT / name).read_text("utf-8"), re.M).group(1)
        for name in ("__init__.py", "blender_manifest.toml", "pyproject.toml")
    }
    assert len(versions) == 1


def test_the_package_never_calls_itself_by_name():
    """As an extension it is called bl_ext.<repository>.insideout."""
    absolute = re.compile(r"^\s*(?:from|import) insideout\b", re.M)
    for folder in ("core", "insideout_addon", "operators", "panels"):
        for path in (_ROOT / folder).rglob("*.py"):
            assert not absolute.search(path.read_text("utf-8")), path


def test_the_manifest_keeps_blenders_rules():
    text = (_ROOT / "blender_manifest.toml").read_text("utf-8")
    for reason in re.findall(r'^(?:files|network) = "(.*)"', text, re.M):
        assert len(reason) <= 64
        assert not reason.endswith(".")
