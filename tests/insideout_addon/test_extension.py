"""The zip that Blender installs: builds, validates, holds what it needs and nothing else."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import bpy
import pytest

_ROOT = Path(__file__).resolve().parents[2]
_TOOL = Path(bpy.utils.system_resource("SCRIPTS")) / "addons_core" / "bl_pkg" / "cli" / "blender_ext.py"
_PACKAGES = ("core", "insideout_addon", "operators", "panels")
# Code, translations, pictures of assets.
_KINDS = (".py", ".json", ".png")
_FILES = (
    *("__init__.py", "blender_manifest.toml", "pyproject.toml", "constraints.txt"),
    *("README.md", "CHANGELOG.md", "LICENSE"),
)


def _build(source, target):
    command = [sys.executable, str(_TOOL), "build", "--source-dir", str(source), "--output-filepath", str(target)]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stdout + built.stderr
    return target


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    """The built zip."""
    return _build(_ROOT, tmp_path_factory.mktemp("zip") / "insideout.zip")


def test_pip_installs_every_package():
    """The engine's own environment is made by pip from this list, and not editable."""
    listed = tomllib.loads((_ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["setuptools"]["packages"]
    files = [file for name in _PACKAGES for file in (_ROOT / name).rglob("*.py") if "__pycache__" not in file.parts]
    packages = {".".join(("insideout", *file.parent.relative_to(_ROOT).parts)) for file in files}
    assert set(listed) == {"insideout", *packages}


def test_pip_installs_pictures_and_translations_too(tmp_path):
    """Without a warning: setuptools takes folders of data for packages that were forgotten."""
    pytest.importorskip("setuptools", minversion="77")
    source = tmp_path / "source"
    for name in _PACKAGES:
        shutil.copytree(_ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in _FILES:
        shutil.copy2(_ROOT / name, source / name)
    build = "import sys; from setuptools import build_meta; build_meta.build_wheel(sys.argv[1])"
    built = subprocess.run(
        [sys.executable, "-c", build, str(tmp_path)], cwd=source, capture_output=True, text=True, check=False
    )
    assert built.returncode == 0, built.stderr
    assert "absent from" not in built.stdout + built.stderr
    (wheel,) = tmp_path.glob("*.whl")
    parts = {name for name in zipfile.ZipFile(wheel).namelist() if name.startswith("insideout/")}
    files = [path for folder in _PACKAGES for path in (source / folder).rglob("*") if path.suffix in _KINDS]
    assert parts == {"insideout/__init__.py", *(f"insideout/{path.relative_to(source).as_posix()}" for path in files)}


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
    files = [path for folder in _PACKAGES for path in (_ROOT / folder).rglob("*") if path.suffix in _KINDS]
    parts = {str(path.relative_to(_ROOT)) for path in files}
    assert parts == {name for name in names if name.split("/")[0] in _PACKAGES}


def test_it_holds_nothing_else(package):
    roots = {name.split("/")[0] for name in zipfile.ZipFile(package).namelist()}
    assert roots == {*_PACKAGES, *_FILES}
    assert package.stat().st_size < 3e6


def test_captures_and_runs_that_lie_beside_it_stay_out(tmp_path):
    """The README's tour puts `my_object` and `my_run` into the checkout; DICOM files have no extension."""
    source = tmp_path / "checkout"
    for name in _PACKAGES:
        shutil.copytree(_ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in _FILES:
        shutil.copy2(_ROOT / name, source / name)
    clean = set(zipfile.ZipFile(_build(source, tmp_path / "clean.zip")).namelist())
    for name in (
        "my_object/photos/a.jpg",
        "my_object/xray/IM0001",
        "my_run/core/fused.ply",
        "my_run/work.py",
        "notes.txt",
        ".venv/lib/torch.py",
        "core/__pycache__/ply.cpython-311.pyc",
        "core/render/__pycache__/splat.nbi",
    ):
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        (source / name).write_text("x", "utf-8")
    assert set(zipfile.ZipFile(_build(source, tmp_path / "full.zip")).namelist()) == clean


def test_a_user_installs_it_and_works_with_it(package, tmp_path, random_set):
    """In a Blender of its own with nothing but this zip; see installed_session.py."""
    run = tmp_path / "run"
    random_set.save(run / "fused.ply")
    environment = {name: value for name, value in os.environ.items() if name != "INSIDEOUT_ENGINE"}
    answer = subprocess.run(
        [sys.executable, str(Path(__file__).with_name("installed_session.py")), str(package), str(run)],
        env={**environment, "BLENDER_USER_RESOURCES": str(tmp_path / "user")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert answer.returncode == 0, answer.stdout + answer.stderr
    found = json.loads(next(line for line in answer.stdout.splitlines() if line.startswith("found:"))[6:])
    assert found["installed"] == ["FINISHED"]
    assert found["beside the checkout"], "the zip stands alone"
    assert Path(found["folder"]).is_relative_to(tmp_path)
    assert found["registered"]
    assert found["preferences"]
    assert {"Check Capture", "Import", "Add Section Plane"} <= set(found["empty sidebar"])
    assert found["points"] == found["model again"] == 200
    assert found["plane"] == "InsideOut Section"
    assert {"Save Section...", "200 splats as ellipsoids"} <= set(found["sidebar"])
    assert (run / "section.png").stat().st_size > 1000
    assert found["left behind"] == {"classes": [], "properties": False, "handlers": []}
    assert found["registered again"]
    assert found["heavy"] == []


def test_versions_agree():
    versions = {
        re.search(r'^(?:__version__|version) = "(.*)"', (_ROOT / name).read_text("utf-8"), re.M).group(1)
        for name in ("__init__.py", "blender_manifest.toml", "pyproject.toml")
    }
    assert len(versions) == 1


def test_the_package_never_calls_itself_by_name():
    """As an extension it is called bl_ext.<repository>.insideout."""
    absolute = re.compile(r"^\s*(?:from|import) insideout\b", re.M)
    for folder in _PACKAGES:
        for path in (_ROOT / folder).rglob("*.py"):
            assert not absolute.search(path.read_text("utf-8")), path


def test_the_manifest_keeps_blenders_rules():
    manifest = tomllib.loads((_ROOT / "blender_manifest.toml").read_text("utf-8"))
    assert set(manifest["permissions"]) == {"files", "network"}
    for reason in manifest["permissions"].values():
        assert 0 < len(reason) <= 64
        assert not reason.endswith(".")


def test_the_licence_is_the_one_that_the_manifest_names():
    manifest = tomllib.loads((_ROOT / "blender_manifest.toml").read_text("utf-8"))
    assert manifest["license"] == ["SPDX:GPL-3.0-or-later"]
    assert "GNU GENERAL PUBLIC LICENSE\n                       Version 3" in (_ROOT / "LICENSE").read_text("utf-8")


def test_what_is_installed_is_pinned():
    """Everything that `make` installs into its environments, and what the extras ask for."""
    project = tomllib.loads((_ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    wanted = [
        *project["dependencies"],
        *(name for extra in project["optional-dependencies"].values() for name in extra),
    ]
    pinned = _pins("constraints.txt")
    for requirement in wanted:
        assert re.split(r"[=<>~]", requirement)[0].lower() in pinned, requirement
    assert "pip" in pinned
    assert {"pip", "bpy", "numpy", "pytest", "setuptools"} <= _pins("constraints-bpy45.txt")
    assert {"pip", "bpy", "numpy", "pytest"} <= _pins("constraints-bpy52.txt")


def _pins(name):
    lines = [line for line in (_ROOT / name).read_text("utf-8").splitlines() if not line.startswith("#")]
    assert all(re.fullmatch(r"[\w.-]+==[\w.]+", line) for line in lines)
    return {line.split("==")[0].lower() for line in lines}
