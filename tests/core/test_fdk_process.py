"""FDK in a process of its own gives what FDK gives here, and can be left at any time."""

import signal
import time
from dataclasses import replace

import numpy as np
import pytest

from insideout.core import fdk_process
from insideout.core.capture.detectors import CircularScan
from insideout.core.capture.model import Projections
from insideout.core.errors import Cancelled, CaptureError
from insideout.core.fdk import fdk
from insideout.core.progress import Reporter
from insideout.core.rtk import run_filter
from insideout.core.told import Told


@pytest.fixture(scope="module")
def projections():
    angles = np.radians(np.arange(0, 360, 15.0))
    detectors = CircularScan(24, 20, (2.0, 2.0), 120.0, 180.0).detectors(angles)
    images = np.random.default_rng(0).random((len(angles), 20, 24), np.float32)
    box = np.array([[-10.0, -10.0, -9.0], [10.0, 10.0, 9.0]])
    return Projections(images, detectors, np.arange(len(angles)) % 5 == 0, angles, box, (14, 12, 10))


@pytest.fixture
def new_process():
    fdk_process.end_fdk()
    yield
    fdk_process.end_fdk()


def test_cancelled_while_rtk_loads_it_ends_at_once(new_process, projections):
    start = time.monotonic()
    with pytest.raises(Cancelled):
        fdk_process.fdk(projections, reporter=Reporter(is_cancelled=lambda: time.monotonic() - start > 0.3))
    assert time.monotonic() - start < 1.3


def test_the_volume_is_the_same_with_progress_and_again(projections):
    heard = []
    every = np.ones(len(projections.images), bool)
    first = fdk_process.fdk(projections, every, (9, 8, 7), Reporter(heard.append), "hann", "report")
    second = fdk_process.fdk(projections)
    expected = fdk(projections, every, (9, 8, 7), window="hann")
    assert np.array_equal(first.values, expected.values)
    assert np.array_equal(first.origin_mm, expected.origin_mm)
    assert np.array_equal(second.values, fdk(projections).values)
    assert {progress.stage for progress in heard} == {"report"}
    assert heard[-1].fraction == 1.0


def test_files_in_the_working_folder_are_not_taken_for_modules(new_process, projections, tmp_path, monkeypatch):
    for name in ("insideout.py", "queue.py"):
        (tmp_path / name).write_text("raise ImportError('this is the user's')")
    monkeypatch.chdir(tmp_path)
    assert np.isfinite(fdk_process.fdk(projections).values).all()


def test_what_ends_all_processes_of_a_job_leaves_this_one_to_us(new_process, projections):
    fdk_process.prepare_fdk()
    for number in (signal.SIGINT, signal.SIGTERM):
        fdk_process._process.send_signal(number)
    assert np.isfinite(fdk_process.fdk(projections).values).all()


def test_an_answer_that_cannot_be_read_is_told(projections, monkeypatch):
    def fail(stream):
        raise ImportError("no module of the answer's")

    fdk_process.prepare_fdk()
    monkeypatch.setattr(fdk_process.pickle, "load", fail)
    with pytest.raises(RuntimeError, match="no module of the answer's"):
        fdk_process.fdk(projections)


class _Hungry:
    """Wants 4 EB of memory where it is unpacked."""

    def __reduce__(self):
        return bytearray, (1 << 62,)


@pytest.mark.parametrize("box", [_Hungry(), range(10**14)], ids=["the job", "the work on it"])
def test_want_of_memory_in_the_process_says_what_to_do(projections, box):
    with pytest.raises(
        CaptureError, match=r"24 projections on 14 x 12 x 10 voxels .* want of memory; lower the scan's"
    ):
        fdk_process.fdk(replace(projections, box_mm=box))
    assert np.isfinite(fdk_process.fdk(projections).values).all(), "the next one is not"


def test_want_of_memory_for_the_answer_says_what_to_do(projections, monkeypatch):
    def fail(stream):
        raise MemoryError

    fdk_process.prepare_fdk()
    monkeypatch.setattr(fdk_process.pickle, "load", fail)
    with pytest.raises(CaptureError, match="want of memory"):
        fdk_process.fdk(projections)


@pytest.mark.parametrize("says", ["itkImport.hxx:179:\nFailed to allocate memory for image.", "std::bad_alloc"])
def test_what_itk_cannot_allocate_is_want_of_memory(says):
    class Full:
        def AddObserver(self, event, watch):
            pass

        def Update(self):
            raise RuntimeError(says)

    with pytest.raises(MemoryError):
        run_filter(Full(), None, lambda: None, Told("FDK"))


def test_the_user_s_mistakes_come_back_as_themselves(projections):
    lying = [replace(detector, u=detector.v, v=-np.asarray(detector.u)) for detector in projections.detectors]
    with pytest.raises(CaptureError, match="turn the geometry so that z is the scanner's axis"):
        fdk_process.fdk(replace(projections, detectors=lying))


def test_a_fault_of_the_program_comes_back_with_its_traceback(projections):
    with pytest.raises(RuntimeError, match="Traceback"):
        fdk_process.fdk(replace(projections, box_mm="no box"))


def test_ended_by_the_system_it_says_what_to_do(new_process, projections):
    def kill():
        if fdk_process._process is not None:
            fdk_process._process.kill()
        return False

    with pytest.raises(CaptureError, match=r"24 projections on 14 x 12 x 10 voxels .* want of memory"):
        fdk_process.fdk(projections, reporter=Reporter(is_cancelled=kill))
    assert fdk_process._process is None
