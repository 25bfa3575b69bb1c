"""Kernels kept on disk are those of the sources, also where a helper in another file changed."""

import ast
import subprocess
import sys
import time

import pytest

from insideout.core.compiled import CORE, FOLDERS, SOURCES, njit, work_clock

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
if len(sys.argv) > 2:
    print("imported", flush=True)
    sys.stdin.readline()
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


def test_a_process_that_runs_with_the_old_sources_leaves_nothing_to_new_ones(run, tmp_path):
    """As during an update: it has the old helper in memory, and compiles when it first needs it."""
    command = [sys.executable, "-c", RUN, str(tmp_path), "wait"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as old:
        assert old.stdout.readline() == "imported\n"
        (tmp_path / "helper.py").write_text(HELPER.replace("2 * x", "3 * x"))
        assert run() == (13, False)
        assert old.communicate("\n")[0] == "12 0\n"
    assert run() == (13, True)


def test_numba_may_be_switched_off(tmp_path, monkeypatch, run):
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    script = RUN.replace(", sum(kernel.stats.cache_hits.values())", "")
    command = [sys.executable, "-c", script, str(tmp_path)]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "12\n"


def test_what_would_go_past_it_is_refused():
    with pytest.raises(ValueError, match="decorated with options alone"):
        njit("f8(f8)", cache=True)


def test_what_is_not_of_numba_stays(run, tmp_path):
    run()
    (folder,) = (tmp_path / "cache").iterdir()
    (folder / "notes.txt").write_text("a user's own")
    (tmp_path / "helper.py").write_text(HELPER + "\n")
    run()
    assert (folder / "notes.txt").read_text() == "a user's own"


def test_every_kernel_that_is_kept_counts():
    """`numba.njit` itself is only for what is compiled anew in each process."""
    for path in sorted(CORE.rglob("*.py")):
        text = path.read_text("utf-8")
        if "cache=True" in text and "njit" in text and path.name != "compiled.py":
            assert path in KERNELS, path
            names = [alias.name for node in ast.walk(ast.parse(text)) if _of_numba(node) for alias in node.names]
            assert "njit" not in names
            assert "numba.njit" not in text


@pytest.mark.parametrize("path", KERNELS, ids=lambda path: str(path.relative_to(CORE)))
def test_all_that_a_kernel_is_compiled_with_counts(path):
    """What its body and its decorator name, and what these constants are made of."""
    tree = ast.parse(path.read_text("utf-8"))
    sources = {
        alias.asname or alias.name: _file_of(path, node)
        for node in tree.body
        if isinstance(node, ast.ImportFrom) and node.level
        for alias in node.names
    }
    made_of = {
        target.id: _names(node.value)
        for node in tree.body
        if isinstance(node, ast.Assign)
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    kernels = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef) and _is_kernel(node)]
    used, more = set(), set().union(*map(_names, kernels))
    while more:
        used |= more
        more = set().union(*(made_of.get(name, set()) for name in more)) - used
    for name in used & sources.keys():
        assert sources[name] in [*KERNELS, CORE / "compiled.py"], f"{name} of {sources[name]}"


def _of_numba(node):
    return isinstance(node, ast.ImportFrom) and node.module == "numba"


def _is_kernel(function):
    return any("njit" in ast.unparse(decorator) for decorator in function.decorator_list)


def _names(tree):
    return {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}


def _file_of(path, node):
    folder = path.parents[node.level - 1]
    return folder.joinpath(*(node.module or "__init__").split(".")).with_suffix(".py")


def test_the_clock_of_work_leaves_out_compiling():
    @njit
    def kernel(x):
        return x + 1

    wall, work = time.perf_counter(), work_clock()
    kernel(1.0)
    wall, work = time.perf_counter() - wall, work_clock() - work
    compiling = kernel.get_metadata(kernel.signatures[0])["timers"]["compiler_lock"]
    # Two listeners of Numba's do not read their clocks at the same moment.
    assert wall - work >= 0.99 * compiling > 0
    assert work >= 0
