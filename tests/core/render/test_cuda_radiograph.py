"""The Warp radiographs against the reference in float64, on a card if there is one, else on Warp's CPU device."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

wp = pytest.importorskip("warp")

from insideout.core.gaussians import GaussianSet, Modality  # noqa: E402
from insideout.core.render import radiograph  # noqa: E402
from insideout.core.views import Detector  # noqa: E402

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
PARAMETERS = ("means", "quats", "scales", "density")
VECTORS = ("source", "center", "u", "v")


def detector(source, center, u, v, parallel: bool = False) -> Detector:
    return Detector(37, 29, *(np.array(vector, float) for vector in (source, center, u, v)), parallel)


DETECTORS = {
    "cone": detector((100, 0, 0), (-80, 0, 0), (0, 1.3, 0), (0, 0, -1.4)),
    "parallel": detector((-1, 0, 0), (-80, 0, 0), (0, 0.8, 0), (0, 0, -0.8), True),
    "offset": detector((100, 3, -2), (-80, 9, 6), (0, 1.3, 0), (0, 0, -1.4)),
    "tilted": detector((60, 70, 5), (-50, -60, 3), (1.0, -0.9, 0.2), (0.25, 0.15, -1.35)),
    "tilted parallel": detector((-3, -2, 0.5), (-40, -30, 3), (0.4, -0.6, 0.2), (0.25, 0.15, -0.9), True),
    "source inside": detector((3, 1, 0.2), (-80, 4, 1), (0.05, 4.2, 0.1), (0.1, 0.05, -4.2)),
}


@pytest.fixture(params=[False, True], ids=["a thread a tile", "a thread a pixel"])
def blocks(request, monkeypatch) -> None:
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", request.param)


def scene(count: int, seed: int = 0) -> GaussianSet:
    rng = np.random.default_rng(seed)
    return GaussianSet.create(
        rng.normal(size=(count, 3)) * 5,
        10 ** rng.uniform(-0.6, 0.5, (count, 3)),
        quats=rng.normal(size=(count, 4)),
        density=rng.uniform(0.05, 1, count),
    )


def render(gaussians: GaussianSet, view: Detector, kernel: str, mode: str = "exact"):
    """The image and the gradients of a random weighting of it, for every parameter of splats and detector."""
    exact = kernel == "reference"
    splats = gaussians.to_torch(torch.float64 if exact else torch.float32, "cpu" if exact else DEVICE)
    leaves = {name: getattr(splats, name).requires_grad_() for name in PARAMETERS}
    leaves |= {name: torch.tensor(getattr(view, name), dtype=torch.float64, requires_grad=True) for name in VECTORS}
    image = radiograph(splats, replace(view, **{name: leaves[name] for name in VECTORS}), kernel, mode)
    weights = np.random.default_rng(3).normal(size=image.shape)
    (image * torch.as_tensor(weights).to(image)).sum().backward()
    return image.detach().cpu().double(), {name: leaf.grad.cpu().double() for name, leaf in leaves.items()}


@pytest.mark.parametrize("mode", ["exact", "affine"])
@pytest.mark.parametrize("name", DETECTORS)
def test_image_and_gradients_are_the_references(blocks, name: str, mode: str) -> None:
    truth, true_grads = render(scene(60, seed=2), DETECTORS[name], "reference", mode)
    image, grads = render(scene(60, seed=2), DETECTORS[name], "cuda", mode)
    assert (image - truth).abs().max() < 1e-5 * truth.max()
    for parameter, expected in true_grads.items():
        assert (grads[parameter] - expected).norm() < 3e-4 * expected.norm(), parameter


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 33), (17, 5)])
def test_any_image_size(width: int, height: int) -> None:
    view = replace(DETECTORS["offset"], width=width, height=height)
    truth, _ = render(scene(40, seed=5), view, "reference")
    image, _ = render(scene(40, seed=5), view, "cuda")
    torch.testing.assert_close(image, truth, rtol=1e-5, atol=1e-5 * float(truth.max()))


def test_the_same_bits_every_time(blocks) -> None:
    results = [render(scene(200, seed=6), DETECTORS["tilted"], "cuda") for _ in range(2)]
    assert torch.equal(results[0][0], results[1][0])
    assert all(torch.equal(results[0][1][name], results[1][1][name]) for name in results[0][1])


def test_a_cutoff_costs_no_more_than_it_says() -> None:
    splats = scene(1, seed=7).to_torch()
    full = radiograph(splats.to_torch(torch.float64), DETECTORS["cone"], "reference")
    for cutoff in (3.0, 4.0, 5.3):
        image = radiograph(splats.to_torch(device=DEVICE), DETECTORS["cone"], "cuda", cutoff_sigmas=cutoff)
        error = (image.cpu().double() - full).abs().max() / full.max()
        assert error <= np.exp(-0.5 * cutoff**2) + 1e-6


def test_clones_and_splats_that_are_not_numbers_are_left_out() -> None:
    gaussians = scene(10)
    modality = np.full(10, Modality.XRAY, np.uint8)
    modality[5:8] = Modality.CLONE
    means = gaussians.means.copy()
    means[8:] = np.nan
    broken = replace(gaussians, modality=modality, means=means)
    image, grads = render(broken, DETECTORS["cone"], "cuda")
    torch.testing.assert_close(image, render(gaussians.select(slice(0, 5)), DETECTORS["cone"], "cuda")[0])
    assert all(grad.isfinite().all() for grad in grads.values())


def test_an_empty_set_is_a_black_image() -> None:
    image, _ = render(GaussianSet.empty(), DETECTORS["cone"], "cuda")
    assert image.shape == (29, 37)
    assert not image.any()
