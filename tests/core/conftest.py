"""A tiny capture with known truth, made once for all tests that need one."""

from dataclasses import replace

import pytest

from insideout.core.phantoms.make import CaptureSettings, make_capture
from insideout.core.settings import Settings
from insideout.core.train.schedule import in_iterations

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


@pytest.fixture(scope="session")
def tiny_settings():
    """The draft preset with a handful of iterations in every stage; of both halves at the rates of so few."""
    settings = Settings.of("draft")
    stages = dict(settings.stages)
    # Forty iterations split nothing: a coarse start would stay coarse.
    stages["initialize"] = replace(stages["initialize"], hull_cells=24, most_rgb=1500, start="fdk", xray_splats=1500)
    surface = stages["surface"]
    stages["surface"] = replace(surface, rgb=in_iterations(surface.rgb, 60), xray=in_iterations(surface.xray, 40))
    joint = replace(stages["internal"].joint, iterations=8)
    stages["internal"] = replace(
        stages["internal"], xray_iterations=8, display_iterations=8, rgb_iterations=8, joint=joint
    )
    stages["fuse"] = replace(stages["fuse"], iterations=8)
    return replace(settings, stages=stages)


@pytest.fixture(autouse=True)
def rtk_stays_loaded(monkeypatch):
    """Loading ITK-RTK takes seconds: tests that run `initialize` share the process that a run ends afterwards."""
    monkeypatch.setattr("insideout.core.stages.initialize.stage.end_fdk", lambda: None)
