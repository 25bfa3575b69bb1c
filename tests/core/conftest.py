"""A tiny capture with known truth, made once for all tests that need one."""

import pytest

from insideout.core.phantoms.make import CaptureSettings, make_capture

TINY = CaptureSettings(
    photos=16,
    photo_width=48,
    photo_height=64,
    projections=16,
    heldout_projections=2,
    detector_width=36,
    detector_height=48,
    voxel_mm=4.0,
    surface_mm=4.0,
    shells=5,
)


@pytest.fixture(scope="session")
def tiny_capture(tmp_path_factory):
    """The Matryoshka at 48 x 64 pixels: photos, projections, landmarks and truth.npz. Read only."""
    return make_capture("matryoshka", tmp_path_factory.mktemp("captures") / "matryoshka", TINY)


@pytest.fixture(autouse=True)
def rtk_stays_loaded(monkeypatch):
    """Loading ITK-RTK takes ten seconds: tests that run `initialize` share the process that a run ends afterwards."""
    monkeypatch.setattr("insideout.core.stages.initialize.stage.end_fdk", lambda: None)
