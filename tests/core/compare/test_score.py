"""Held-out projections of rows whose method draws them in a way of its own."""

from types import SimpleNamespace

import numpy as np
import pytest

from insideout.core.capture.detectors import CircularScan
from insideout.core.capture.model import Projections
from insideout.core.capture.pinhole import camera_of
from insideout.core.compare.score import _projections
from insideout.core.evaluate.heldout import some_held_out
from insideout.core.evaluate.metrics import psnr
from insideout.core.gaussians import GaussianSet
from insideout.core.progress import Reporter
from insideout.core.render import radiograph
from insideout.core.stages.surface.x_gaussian import projected

SPLATS = GaussianSet.create(
    np.array([[3.0, 0, 0], [-2, 4, 1], [0, -3, -4]]),
    np.array([[4.0, 2, 2], [2, 3, 2], [3, 3, 1]]),
    density=np.array([0.05, 0.08, 0.06]),
    opacities=np.array([0.4, 0.6, 0.5]),
    modality=1,
)


@pytest.fixture(scope="module")
def projections():
    """Forty, of which two are trained on; those kept back are off by less the later they were taken."""
    scan = CircularScan(24, 20, (1.6, 1.6), source_to_axis_mm=60.0, source_to_detector_mm=90.0)
    angles = np.arange(40) * 2 * np.pi / 40
    detectors = scan.detectors(angles)
    exact = np.stack([radiograph(SPLATS.to_torch(), detector).numpy() for detector in detectors])
    rng = np.random.default_rng(0)
    images = exact + rng.normal(0, 0.1, exact.shape) * (1 - np.arange(40) / 50)[:, None, None]
    held_out = np.arange(40) >= 2
    return Projections(
        images.astype(np.float32), detectors, held_out, angles, np.array([[-12.0] * 3, [12.0] * 3]), (16, 16, 16)
    )


def figures(projections, leave_out=("internal",), **drawn):
    report = {
        "stages": {"surface": {"settings": {"xray": drawn}}},
        "heldout": {"projections": {"psnr": 12.5}},
    }
    run = SimpleNamespace(read_set=lambda stage, name: SPLATS)
    study = SimpleNamespace(
        capture=SimpleNamespace(projections=projections),
        settings=SimpleNamespace(kernel="cpu"),
        reporter=Reporter(),
    )
    made = SimpleNamespace(report=report, run=run, method=SimpleNamespace(leave_out=leave_out))
    return _projections(study, made)


@pytest.mark.parametrize("drawn", [{"model": "x_gaussian"}, {"mode": "affine", "cutoff_sigmas": 2.0}])
def test_all_that_were_kept_back_count_as_for_other_rows(projections, drawn):
    """While a set is fitted only sixteen are looked at."""

    def shown(index):
        detector = projections.detectors[index]
        if "model" in drawn:
            return projected(SPLATS, camera_of(detector), projections.peak(np.arange(2)))
        return radiograph(SPLATS.to_torch(), detector, mode="affine", cutoff_sigmas=2.0).numpy()

    kept_back = np.flatnonzero(projections.held_out)
    peak = projections.peak(kept_back)
    each = {int(i): psnr(shown(i), projections.images[i], peak) for i in kept_back}
    found = figures(projections, **drawn)["psnr"]
    assert found == pytest.approx(np.mean(list(each.values())), abs=1e-6)
    assert abs(found - np.mean([each[int(i)] for i in some_held_out(projections)])) > 1e-3


def test_a_row_drawn_exactly_has_what_its_report_says(projections):
    assert figures(projections, model="additive", mode="exact") == {"psnr": 12.5}


@pytest.mark.parametrize("drawn", [{"model": "x_gaussian"}, {"mode": "affine"}])
def test_so_has_one_that_the_internal_stage_went_on_with(projections, drawn):
    assert figures(projections, leave_out=(), **drawn) == {"psnr": 12.5}
