"""Kernels kept on disk are those of the sources, also where a helper in another file changed."""

import ast
import subprocess
import sys

import pytest

from insideout.core.compiled import CORE, FOLDERS, SOURCES

HELPER = """
from insideout.core.compiled import njit
FACTOR = 10

@njit(cache=True)
def scaled(x):
    return 2 * x
"""
KERNEL = """
from {where} import njit
from helper import FACTOR, scaled

@njit(cache=True)
def kernel(x):
    return scaled(x) + FACTOR
"""
RUN = """
import sys
sys.path.insert(0, sys.argv[1])
from pathlib import Path
import insideout.core.compiled as compiled
compiled.CORE, compiled.SOURCES, compiled.FOLDERS = Path(sys.argv[1]), ("helper.py", "kernel.py"), ()
from kernel import kernel
print(kernel(1), sum(kernel.stats.cache_hits.values()))
"""
KERNELS = [
    *(CORE / name for name in SOURCES),
    *(path for name in FOLDERS for path in sorted((CORE / name).glob("*.py"))),
]


@pytest.fixture
def run(tmp_path, monkeypatch):
    """What a new process computes, and whether it found that on disk."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("PYTHONPATH", str(CORE.parents[1]))
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    (tmp_path / "helper.py").write_text(HELPER)
    (tmp_path / "kernel.py").write_text(KERNEL.format(where="insideout.core.compiled"))

    def new_process():
        command = [sys.executable, "-c", RUN, str(tmp_path)]
        value, found = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
        return int(value), found == "1"

    return new_process


def test_kernels_are_compiled_once(run):
    assert [run(), run(), run()] == [(12, False), (12, True), (12, True)]


@pytest.mark.parametrize(("before", "after", "value"), [("2 * x", "3 * x", 13), ("FACTOR = 10", "FACTOR = 20", 22)])
def test_a_helper_or_a_constant_that_changed_in_another_file_is_seen(run, tmp_path, before, after, value):
    run()
    (tmp_path / "helper.py").write_text(HELPER.replace(before, after))
    assert [run(), run()] == [(value, False), (value, True)]


def test_numba_alone_would_not_see_it(run, tmp_path):
    """Once it does, this module can go."""
    (tmp_path / "kernel.py").write_text(KERNEL.format(where="numba"))
    (tmp_path / "helper.py").write_text(HELPER.replace("insideout.core.compiled", "numba"))
    run()
    (tmp_path / "helper.py").write_text((tmp_path / "helper.py").read_text().replace("2 * x", "3 * x"))
    assert run() == (12, True)


def test_what_is_not_of_numba_stays(run, tmp_path):
    run()
    (folder,) = (tmp_path / "cache").iterdir()
    (folder / "notes.txt").write_text("a user's own")
    (tmp_path / "helper.py").write_text(HELPER + "\n")
    run()
    assert (folder / "notes.txt").read_text() == "a user's own"


def test_every_kernel_that_is_kept_is_renewed():
    """`numba.njit` itself is only for what is compiled anew in each process."""
    for path in sorted(CORE.rglob("*.py")):
        text = path.read_text("utf-8")
        if "cache=True" in text and "njit" in text and path.name != "compiled.py":
            assert path in KERNELS, path
            assert "numba.njit" not in text
            assert "from numba import njit" not in text


@pytest.mark.parametrize("path", KERNELS, ids=lambda path: str(path.relative_to(CORE)))
def test_all_that_a_kernel_is_compiled_with_counts(path):
    tree = ast.parse(path.read_text("utf-8"))
    sources = {
        alias.asname or alias.name: _file_of(path, node)
        for node in tree.body
        if isinstance(node, ast.ImportFrom) and node.level
        for alias in node.names
    }
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef) and _is_kernel(node)]
    used = {
        name.id
        for function in functions
        for part in function.body
        for name in ast.walk(part)
        if isinstance(name, ast.Name)
    }
    for name in used & sources.keys():
        assert sources[name] in [*KERNELS, CORE / "compiled.py"], f"{name} of {sources[name]}"


def _is_kernel(function):
    return any("njit" in ast.unparse(decorator) for decorator in function.decorator_list)


def _file_of(path, node):
    folder = path.parents[node.level - 1]
    return folder.joinpath(*(node.module or "__init__").split(".")).with_suffix(".py")
