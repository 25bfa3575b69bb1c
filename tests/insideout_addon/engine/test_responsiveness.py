"""How long the add-on keeps Blender from its window while the engine works."""

from __future__ import annotations

import importlib.util
import sys
import time

import bpy
import numpy as np
import pytest

from insideout.core.gaussians import GaussianSet, Modality
from insideout.insideout_addon.engine import job

pytestmark = pytest.mark.builds_groups


def test_the_engine_at_work_does_not_hold_up_the_window(window, monkeypatch, tmp_path):
    """The real engine until it trains on the photos; then it is cancelled."""
    if importlib.util.find_spec("torch") is None:
        pytest.skip("this environment has Blender alone; the engine is in the other")
    from insideout.core.phantoms.make import CaptureSettings, make_capture

    small = CaptureSettings(
        photos=12,
        photo_width=48,
        photo_height=64,
        projections=12,
        heldout_projections=2,
        detector_width=36,
        detector_height=48,
        voxel_mm=4.0,
        surface_mm=4.0,
        shells=5,
    )
    monkeypatch.setenv("INSIDEOUT_ENGINE", sys.executable)
    settings, state = bpy.context.scene.insideout, bpy.context.window_manager.insideout
    settings.capture = str(make_capture("matryoshka", tmp_path / "matryoshka", small))
    settings.run = str(tmp_path / "run")
    assert bpy.ops.insideout.reconstruct() == {"FINISHED"}
    assert job.job_running()
    window.run(lambda: state.stage == "surface" and state.iteration > 5, within_s=400)
    assert state.loss > 0
    began = time.monotonic()
    bpy.ops.insideout.cancel()
    window.run(lambda: not job.job_running(), within_s=10)
    assert time.monotonic() - began < 1.0
    assert (state.message, state.error) == ("Canceled", "")
    window.check()


def test_a_flood_and_the_import_at_the_end_do_not_either(window, make_engine, tmp_path):
    """100,000 splats, as many as a small real model has; read in another thread."""
    rng = np.random.default_rng(0)
    model = GaussianSet.create(
        rng.normal(0, 20, (100_000, 3)), 0.5, density=rng.uniform(0, 0.05, 100_000), modality=Modality.XRAY
    )
    model.save(tmp_path / "made.ply")
    make_engine(
        "import pathlib, shutil\n"
        "out = pathlib.Path(arguments[arguments.index('--out') + 1]); out.mkdir()\n"
        "end = time.time() + 2\n"
        "while time.time() < end:\n"
        "    for i in range(100): send('progress', stage='fuse', fraction=0.5, iteration=i, iterations=100, loss=0.5)\n"
        "    send('stage', stage='fuse', state='started')\n"
        f"shutil.copy({str(tmp_path / 'made.ply')!r}, out / 'fused.ply')\n"
        "send('done', run=str(out))\n"
    )
    settings = bpy.context.scene.insideout
    settings.capture, settings.run = str(tmp_path / "capture"), str(tmp_path / "run")
    assert bpy.ops.insideout.reconstruct() == {"FINISHED"}
    window.run(lambda: settings.model is not None, within_s=60)
    assert len(settings.model.data.points) == 100_000
    window.check()
