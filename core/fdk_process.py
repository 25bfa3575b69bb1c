"""FDK, SART and projections of a volume in a process of their own.

Loading ITK-RTK takes some seconds of work in which Python hears no signal. In a process of its own it loads while
the photos are looked at, and whoever cancels need not wait for it.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from typing import IO, Any

import numpy as np

from .capture.model import Projections
from .errors import CaptureError, InsideOutError
from .processes import KILLED, NO_CONSOLE
from .progress import Progress, Reporter
from .sart import SartSettings
from .views import Detector
from .volume import Volume

_LISTEN_SECONDS = 0.1
# Of the other process when it wants memory: as if the system had ended it for that.
_WANTS_MEMORY = KILLED[-1]
_one_at_a_time = threading.Lock()
_process: subprocess.Popen[bytes] | None = None


def prepare_fdk() -> None:
    """Starts loading ITK-RTK in the background; returns at once. It stays loaded, with 0.6 GB, until `end_fdk`."""
    global _process
    if _process is None or _process.poll() is not None:
        # With our own path: `python -m` would look in the working folder first, whatever lies there.
        code = f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import main; main()"
        with _signals_ignored():
            _process = subprocess.Popen(
                [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, **NO_CONSOLE
            )


@contextlib.contextmanager
def _signals_ignored() -> Iterator[None]:
    """A process that starts now ignores what ends all processes of a terminal or a job: ours is ended by us."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    kinds = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(kind, signal.SIG_IGN) for kind in kinds]
    try:
        yield
    finally:
        for kind, handler in zip(kinds, before, strict=True):
            signal.signal(kind, handler)


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
        CaptureError: as there; or there was not enough memory, for which the system may have ended the process.
        RuntimeError: it failed; with its traceback, or its exit code.
        Cancelled: through `reporter`, within a tenth of a second.
    """
    grid = projections.voxels if voxels is None else voxels
    job = (projections, subset, voxels, window, stage)
    volume: Volume = _answer("fdk", job, _killed("FDK", projections, grid), reporter or Reporter())
    return volume


def sart(
    projections: Projections,
    subset: np.ndarray | None = None,
    voxels: tuple[int, int, int] | None = None,
    reporter: Reporter | None = None,
    settings: SartSettings | None = None,
    stage: str = "initialize",
) -> Volume:
    """`core.sart.sart` in the other process, as `fdk` is: it can be cancelled within a tenth of a second."""
    grid = projections.voxels if voxels is None else voxels
    job = (projections, subset, voxels, settings, stage)
    volume: Volume = _answer("sart", job, _killed("SART", projections, grid), reporter or Reporter())
    return volume


def project(volume: Volume, detectors: Sequence[Detector], reporter: Reporter | None = None) -> np.ndarray:
    """`core.forward_projection.forward_project` in the other process: (M, height, width) line integrals."""
    killed = CaptureError(
        "the projection of {count} projections of {width} x {height} pixels was ended by the system, most likely for "
        "want of memory; lower the scan's number of voxels, or bring the scanner's own volume.",
        count=len(detectors),
        width=detectors[0].width,
        height=detectors[0].height,
    )
    images: np.ndarray = _answer("projection", (volume, list(detectors)), killed, reporter or Reporter())
    return images


def _killed(name: str, projections: Projections, grid: tuple[int, ...]) -> CaptureError:
    return CaptureError(
        "the {name} of {count} projections on {grid} voxels was ended by the system, most likely for want of memory; "
        "lower the scan's number of voxels, or bring the scanner's own volume.",
        name=name,
        count=len(projections.images),
        grid=" x ".join(str(int(count)) for count in grid),
    )


def _answer(method: str, job: tuple[Any, ...], killed: CaptureError, reporter: Reporter) -> Any:
    with _one_at_a_time:
        answer = _ask((method, *job), reporter)
    if isinstance(answer, Volume | np.ndarray):
        return answer
    if isinstance(answer, InsideOutError):
        raise answer
    name = method.upper() if method in ("fdk", "sart") else method
    if isinstance(answer, str):
        raise RuntimeError(f"the {name} failed:\n{answer}")
    # What ended the process may have been meant for us, too.
    reporter.check()
    if answer not in KILLED and not isinstance(answer, MemoryError):
        raise RuntimeError(f"the process of the {name} ended with exit code {answer}")
    raise killed


def _ask(job: tuple[Any, ...], reporter: Reporter) -> Any:
    """A volume or images, a user's error, a traceback, the exit code of a process that died over the job, or a
    MemoryError where its answer does not fit into memory here."""
    prepare_fdk()
    process = _process
    assert process is not None
    answers: queue.SimpleQueue[Any] = queue.SimpleQueue()
    # Of a thread's own: writing blocks until RTK is loaded and the job is read.
    thread = threading.Thread(target=_converse, args=(process, job, answers), daemon=True)
    thread.start()
    try:
        answer = _wait(answers, reporter)
    except BaseException:
        end_fdk()
        raise
    thread.join()
    if isinstance(answer, Volume | np.ndarray | InsideOutError):
        return answer
    code = process.wait() if answer is None else None
    end_fdk()
    return answer if code is None else code


def _wait(answers: queue.SimpleQueue[Any], reporter: Reporter) -> Any:
    """The last answer, see `_ask`, or None from a process that died. Progress is passed on."""
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
        # The pipe broke: the process is gone.
        answer = None
    except MemoryError:
        # Without its traceback, which would hold what was read so far.
        answer = MemoryError()
    except BaseException:
        answer = traceback.format_exc()
    finally:
        answers.put(answer)


def _serve(jobs: IO[bytes], answers: IO[bytes]) -> None:
    """Answers jobs until there are no more: with progress, then with what was asked for, an error or a traceback.

    Raises:
        MemoryError: there is not enough for a job or its answer, of which a part may have been read or sent.
    """
    from .fdk import fdk as fdk_here
    from .forward_projection import forward_project
    from .rtk_classes import load
    from .sart import sart as sart_here

    methods: dict[str, Callable[..., Any]] = {"fdk": fdk_here, "sart": sart_here}
    failed = ""
    try:
        load()
    except MemoryError:
        raise
    except Exception:
        failed = traceback.format_exc()
    while True:
        try:
            method, *job = pickle.load(jobs)
        except (EOFError, pickle.UnpicklingError):
            # Whoever asked is gone, perhaps in the middle of a word.
            return
        if failed:
            _send(answers, failed)
            continue

        def tell(progress: Progress) -> None:
            _send(answers, progress)

        try:
            if method == "projection":
                _send(answers, forward_project(*job))
            else:
                projections, subset, voxels, how, stage = job
                _send(answers, methods[method](projections, subset, voxels, Reporter(tell), how, stage))
        except InsideOutError as error:
            _send(answers, error)
        except BrokenPipeError:
            return
        except MemoryError:
            raise
        except Exception:
            _send(answers, traceback.format_exc())


def _send(answers: IO[bytes], answer: Any) -> None:
    pickle.dump(answer, answers, protocol=5)
    answers.flush()


def main() -> None:
    """What the other process does: it answers jobs from standard input on standard output."""
    answers = os.fdopen(os.dup(1), "wb")
    # Libraries print to standard output; only answers may.
    elsewhere = 2 if sys.stderr is not None else os.open(os.devnull, os.O_WRONLY)
    os.dup2(elsewhere, 1)
    with contextlib.suppress(BrokenPipeError):
        try:
            _serve(sys.stdin.buffer, answers)
        except MemoryError:
            # At once: whoever asked may not read any more what is still to be flushed.
            os._exit(_WANTS_MEMORY)
