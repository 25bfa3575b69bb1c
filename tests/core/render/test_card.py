"""Drawing on a card what the processor holds; without a card Warp's CPU back end draws, and the rest is the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from insideout.core.compare.compare import compare
from insideout.core.compare.options import CompareSettings
from insideout.core.errors import SettingError
from insideout.core.gaussians import GaussianSet
from insideout.core.pipeline import reconstruct
from insideout.core.render import card, radiograph, section, splat
from insideout.core.settings import Settings
from insideout.core.views import Camera, Detector, Plane

CAMERA = Camera(21, 17, 20.0, 20.0, 10.5, 8.5, np.eye(4))
DETECTOR = Detector(21, 17, np.array([0.0, 0, -9]), np.array([0.0, 0, 9]), np.array([0.8, 0, 0]), np.array([0, 0.8, 0]))
PLANE = Plane(np.array([-2.0, -2, 4]), np.array([0.2, 0, 0]), np.array([0, 0.2, 0]), 21, 17)


def leaves(dtype: torch.dtype = torch.float32) -> GaussianSet:
    """Twelve splats about (0, 0, 4), on the processor."""
    rng = np.random.default_rng(4)
    gaussians = GaussianSet.create(
        rng.normal(size=(12, 3)) * 0.7 + [0, 0, 4],
        rng.uniform(0.2, 0.6, (12, 3)),
        quats=rng.normal(size=(12, 4)),
        opacities=rng.uniform(0.1, 0.9, 12),
        sh=rng.normal(size=(12, 4, 3)) * 0.3,
        density=rng.uniform(0.1, 1.0, 12),
    ).to_torch(dtype)
    names = ("means", "quats", "scales", "opacities", "sh", "density")
    return replace(gaussians, **{name: getattr(gaussians, name).requires_grad_() for name in names})


DRAW = {
    "splat": (lambda gaussians, kernel: splat(gaussians, CAMERA, kernel=kernel).color, ("opacities", "sh")),
    "radiograph": (lambda gaussians, kernel: radiograph(gaussians, DETECTOR, kernel), ("density",)),
    "section density": (lambda gaussians, kernel: section(gaussians, PLANE, "density", kernel), ("density",)),
    "section occupancy": (lambda gaussians, kernel: section(gaussians, PLANE, "occupancy", kernel), ("opacities",)),
    "section color": (lambda gaussians, kernel: section(gaussians, PLANE, "color", kernel), ("opacities", "sh")),
}


@pytest.mark.parametrize("name", DRAW)
def test_images_and_gradients_come_back_to_the_processor(name: str, relative_error) -> None:
    pytest.importorskip("warp")
    draw, values = DRAW[name]
    truth, ours = leaves(torch.float64), leaves()
    expected, image = draw(truth, "reference"), draw(ours, "cuda")
    assert image.device.type == "cpu"
    assert relative_error(image, expected) < 1e-5
    weights = torch.linspace(0.5, 1.5, image.numel(), dtype=torch.float64).reshape(image.shape)
    (expected * weights).sum().backward()
    (image * weights.float()).sum().backward()
    for parameter in ("means", "quats", "scales", *values):
        found = getattr(ours, parameter).grad
        assert found.device.type == "cpu"
        assert relative_error(found, getattr(truth, parameter).grad) < 1e-3, parameter


def test_what_densification_reads_comes_back_as_well() -> None:
    pytest.importorskip("warp")
    image = splat(leaves(), CAMERA, kernel="cuda")
    expected = splat(leaves(), CAMERA, kernel="cpu")
    for each in (image, expected):
        each.color.sum().backward()
    for name in ("visible", "radii_px", "screen_grad"):
        found = getattr(image.info, name)
        assert found.device.type == "cpu"
        torch.testing.assert_close(found, getattr(expected.info, name), rtol=1e-3, atol=1e-5)


def test_a_run_on_a_card_that_is_missing_is_refused_before_anything_is_written(tiny_capture, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(card, "find_spec", lambda name: object())
    with pytest.raises(SettingError, match="no NVIDIA card"):
        reconstruct(tiny_capture, tmp_path / "run", preset="draft", kernel="cuda")
    assert not (tmp_path / "run").exists()


def test_a_comparison_is_refused_before_anything_is_written_too(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(card, "find_spec", lambda name: object())
    settings = CompareSettings(settings=Settings.of("draft", kernel="cuda"))
    with pytest.raises(SettingError, match="no NVIDIA card"):
        compare([tmp_path / "capture"], tmp_path / "comparison", settings)
    assert not (tmp_path / "comparison").exists()


def test_a_card_that_torch_alone_can_use_is_told_of(monkeypatch) -> None:
    warp = pytest.importorskip("warp")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(warp, "is_cuda_available", lambda: False)
    with pytest.raises(SettingError, match="that NVIDIA Warp cannot use"):
        card.require_card()


def test_more_pairs_than_can_be_numbered_are_refused(monkeypatch) -> None:
    pytest.importorskip("warp")
    from insideout.core.render.kernels.cuda import tiles

    monkeypatch.setattr(tiles, "MOST_PAIRS", 5)
    with pytest.raises(SettingError, match="more than the kernel 'cuda' can list"):
        splat(leaves(), CAMERA, kernel="cuda")


def test_what_numba_draws_beside_a_card_is_compiled_and_told_of(tiny_capture, tmp_path) -> None:
    from insideout.core.capture.read import read_capture
    from insideout.core.run_folder import RunFolder
    from insideout.core.stages.context import StageContext

    context = StageContext(read_capture(tiny_capture), RunFolder(tmp_path), kernel="cuda")
    assert context.compiled("splat", "splat_effects", "radiograph") == ("splat_effects",)


def test_warp_that_is_missing_is_named_with_what_installs_it(monkeypatch) -> None:
    monkeypatch.setattr(card, "find_spec", lambda name: None)
    with pytest.raises(SettingError, match=r'NVIDIA Warp is not installed; run pip install "insideout\[cuda\]"'):
        card.require_card()
