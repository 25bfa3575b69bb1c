"""FDK in a process of its own.

Loading ITK-RTK takes some ten seconds of work in which Python hears no signal. In a process of its own it loads while
the photos are looked at, and whoever cancels need not wait for it.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import pickle
import queue
import subprocess
import sys
import threading
import traceback
from typing import IO, Any

import numpy as np

from .capture.model import Projections
from .errors import CaptureError, InsideOutError
from .progress import Progress, Reporter
from .volume import Volume

_LISTEN_SECONDS = 0.1
# On Windows each console program would flash a window.
_NO_CONSOLE: dict[str, Any] = {"creationflags": getattr(subprocess, "CREATE_NO_WINDOW", 0)}
_process: subprocess.Popen[bytes] | None = None


def prepare_fdk() -> None:
    """Starts loading ITK-RTK in the background; returns at once. It stays loaded, with 0.6 GB, until `end_fdk`."""
    global _process
    if _process is None or _process.poll() is not None:
        command = [sys.executable, "-m", __name__]
        _process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, **_NO_CONSOLE)


@atexit.register
def end_fdk() -> None:
    """Ends the process, whatever it is doing; nothing if there is none."""
    global _process
    if _process is None:
        return
    _process.kill()
    _process.wait()
    for pipe in (_process.stdin, _process.stdout):
        # What could not be written any more is flushed once more on closing.
        with contextlib.suppress(OSError):
            pipe.close()  # type: ignore[union-attr]
    _process = None


def fdk(
    projections: Projections,
    subset: np.ndarray | None = None,
    voxels: tuple[int, int, int] | None = None,
    reporter: Reporter | None = None,
    window: str = "ramp",
    stage: str = "initialize",
) -> Volume:
    """`core.fdk.fdk` in the other process: same arguments, same volume, same errors; one at a time.

    Raises:
        CaptureError: as there; or the process was ended by the system, most likely for want of memory.
        Cancelled: through `reporter`, within a tenth of a second.
    """
    reporter = reporter or Reporter()
    prepare_fdk()
    assert _process is not None
    answers: queue.SimpleQueue[Any] = queue.SimpleQueue()
    job = (projections, subset, voxels, window, stage)
    # Of a thread's own: writing blocks until RTK is loaded and the job is read.
    thread = threading.Thread(target=_converse, args=(_process, job, answers), daemon=True)
    thread.start()
    try:
        answer = _wait(answers, reporter)
    except BaseException:
        end_fdk()
        raise
    thread.join()
    if isinstance(answer, Volume):
        return answer
    if isinstance(answer, InsideOutError):
        raise answer
    end_fdk()
    if isinstance(answer, str):
        raise RuntimeError(f"the FDK failed:\n{answer}")
    grid = " x ".join(str(int(count)) for count in (projections.voxels if voxels is None else voxels))
    raise CaptureError(
        f"the FDK of {len(projections.images)} projections on {grid} voxels was ended by the system, most likely for "
        "want of memory; lower the scan's number of voxels, or bring the scanner's own volume."
    )


def _wait(answers: queue.SimpleQueue[Any], reporter: Reporter) -> Any:
    """The last answer: a volume, an error, a traceback, or None from a process that died. Progress is passed on."""
    while True:
        try:
            answer = answers.get(timeout=_LISTEN_SECONDS)
        except queue.Empty:
            reporter.check()
            continue
        if not isinstance(answer, Progress):
            return answer
        reporter.update(answer)


def _converse(process: subprocess.Popen[bytes], job: tuple[Any, ...], answers: queue.SimpleQueue[Any]) -> None:
    answer: Any = None
    try:
        pickle.dump(job, process.stdin, protocol=5)  # type: ignore[arg-type]
        process.stdin.flush()  # type: ignore[union-attr]
        answer = pickle.load(process.stdout)  # type: ignore[arg-type]
        while isinstance(answer, Progress):
            answers.put(answer)
            answer = pickle.load(process.stdout)  # type: ignore[arg-type]
    except (OSError, EOFError, pickle.UnpicklingError, ValueError):
        answer = None
    answers.put(answer)


def _serve(jobs: IO[bytes], answers: IO[bytes]) -> None:
    """Answers jobs until there are no more: with progress, then with a volume, an error or a traceback."""
    from .fdk import fdk as here
    from .fdk import load

    load()
    while True:
        try:
            projections, subset, voxels, window, stage = pickle.load(jobs)
        except EOFError:
            return

        def tell(progress: Progress) -> None:
            _send(answers, progress)

        try:
            _send(answers, here(projections, subset, voxels, Reporter(tell), window, stage))
        except InsideOutError as error:
            _send(answers, error)
        except BrokenPipeError:
            return
        except Exception:
            _send(answers, traceback.format_exc())


def _send(answers: IO[bytes], answer: Any) -> None:
    pickle.dump(answer, answers, protocol=5)
    answers.flush()


def _main() -> None:
    import signal

    # Ctrl-C reaches all processes of a terminal; ours is ended by the one that started it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    # Libraries print to standard output; only answers may.
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    with contextlib.suppress(BrokenPipeError):
        _serve(sys.stdin.buffer, answers)


if __name__ == "__main__":
    _main()
