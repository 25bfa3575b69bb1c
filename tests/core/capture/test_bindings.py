import os
import signal
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest

from insideout.core.capture import bindings

_ENDED = """
import os, signal
{before}
from insideout.core.capture.bindings import load_pycolmap
load_pycolmap()
os.kill(os.getpid(), signal.SIGTERM)
print("still here")
"""


@pytest.mark.skipif(os.name == "nt", reason="Windows ends a process without a signal")
class TestSignals:
    """A process of their own: they would end this one."""

    def test_sigterm_stays_with_whoever_handled_it(self):
        ended = _run(_ENDED.format(before='signal.signal(signal.SIGTERM, lambda *_: print("told"))'))
        assert (ended.returncode, ended.stdout.split("\n")) == (0, ["told", "still here", ""])

    def test_where_nobody_did_it_ends_the_process_without_a_stack_trace(self):
        ended = _run(_ENDED.format(before=""))
        assert (ended.returncode, ended.stdout, ended.stderr) == (-signal.SIGTERM, "", "")

    def test_in_another_thread_which_may_not_handle_signals_it_is_loaded_all_the_same(self):
        code = (
            "import threading\n"
            "from insideout.core.capture.bindings import load_pycolmap\n"
            "thread = threading.Thread(target=lambda: print(load_pycolmap().__name__))\n"
            "thread.start()\n"
            "thread.join()\n"
        )
        assert _run(code).stdout == "pycolmap\n"


def test_all_of_the_engine_loads_it_here():
    core = Path(bindings.__file__).parents[1]
    assert [path.name for path in core.rglob("*.py") if _imports_pycolmap(path)] == ["bindings.py"]


def _imports_pycolmap(path):
    """Whether a module does, other than for its types alone."""
    lines = [line.strip() for line in path.read_text("utf-8").splitlines()]
    found = [before for before, line in pairwise(["", *lines]) if line.startswith(("import pycolmap", "from pycolmap"))]
    return any(before != "if TYPE_CHECKING:" for before in found)


def _run(code):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
