"""`insideout bench training` and `memory`, on sizes that take seconds."""

import sys

import pytest

from insideout.core.bench import memory
from insideout.core.bench.memory import MeasurementError, measure_memory, peak_bytes
from insideout.core.bench.training import TrainingCase, snowman, train
from insideout.core.errors import SettingError


@pytest.fixture(scope="module")
def trained():
    return train(TrainingCase(splats=800, side=48, photos=6, iterations=60))


def test_a_short_training_already_shows_the_object(trained):
    assert trained["heldout_psnr"] > 18
    assert trained["step_ms"] == pytest.approx(1e3 * trained["seconds"] / 60)


def test_the_parts_of_a_step_add_up_to_it(trained):
    share = trained["share"]
    assert {
        "project",
        "sort",
        "blend",
        "blend_backward",
        "project_backward",
        "loss",
        "activation",
        "adam",
        "rest",
    } == set(share)
    assert sum(share.values()) == pytest.approx(1)
    assert min(share.values()) > 0
    assert trained["kernel_share"] == pytest.approx(1 - share["rest"])


def test_a_training_on_a_card_comes_out_alike_and_one_without_a_card_is_refused(trained, monkeypatch):
    import torch

    from insideout.core.bench import training

    pytest.importorskip("warp")
    if not torch.cuda.is_available():
        with pytest.raises(SettingError, match="no NVIDIA card"):
            train(TrainingCase(kernel="cuda"))
        # Warp's CPU back end draws then: what is trained is the same.
        monkeypatch.setattr(training, "require_card", lambda: None)
    drawn = train(TrainingCase(splats=800, side=48, photos=6, iterations=60, kernel="cuda"))
    assert drawn["heldout_psnr"] == pytest.approx(trained["heldout_psnr"], abs=0.2)


def test_the_object_lies_in_its_box():
    import numpy as np

    phantom = snowman()
    half = 0.5 * np.array(phantom.size_mm)
    rng = np.random.default_rng(0)
    points = rng.uniform(-1.5, 1.5, (20_000, 3)) * half
    inside = phantom.surface(points.astype(np.float32)) < 0
    assert inside.any()
    assert np.all(np.abs(points[inside]) <= half)


where_it_is_told = pytest.mark.skipif(sys.platform == "win32", reason="Windows does not tell it")


@where_it_is_told
def test_memory_is_that_of_the_whole_process():
    row = measure_memory("splat", 1000, 32)
    assert (row["splats"], row["width"]) == (1000, 32)
    assert 50 < row["before_mb"] <= row["peak_mb"] < 2000
    assert peak_bytes() > 50e6


def test_a_system_that_does_not_tell_it_is_no_reason_to_choose_fewer_splats(tmp_path, monkeypatch):
    """Windows has neither; no process is started in vain."""
    monkeypatch.setattr(memory, "_STATUS", tmp_path / "none")
    monkeypatch.setitem(sys.modules, "resource", None)
    monkeypatch.setattr(memory.subprocess, "run", lambda *args, **kwargs: pytest.fail("a process was started"))
    with pytest.raises(SettingError, match="does not tell how much memory"):
        measure_memory("splat", 10, 8)


@where_it_is_told
def test_a_process_that_fails_is_told():
    with pytest.raises(MeasurementError, match="there is no renderer photo"):
        measure_memory("photo", 10, 8)
