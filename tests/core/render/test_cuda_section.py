"""The Warp cuts and slabs against the reference in float64, on a card if there is one, else on Warp's CPU device."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

wp = pytest.importorskip("warp")

from insideout.core.gaussians import GaussianSet  # noqa: E402
from insideout.core.render import section  # noqa: E402
from insideout.core.views import Plane  # noqa: E402

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
FIELDS = ("means", "quats", "scales", "density", "opacities", "sh")
QUANTITIES = ("density", "occupancy", "color")
PLANE = Plane(np.array([-10.0, -8, 1]), np.array([0.5, 0.05, 0.1]), np.array([-0.06, 0.6, 0.0]), 37, 29)


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
        opacities=rng.uniform(0.1, 1, count),
        sh=rng.normal(size=(count, 4, 3)),
    )


def render(gaussians: GaussianSet, plane: Plane, quantity: str, kernel: str):
    """The image and the gradients of a random weighting of it; zeros for what does not matter to the quantity."""
    exact = kernel == "reference"
    splats = gaussians.to_torch(torch.float64 if exact else torch.float32, "cpu" if exact else DEVICE)
    leaves = {name: getattr(splats, name).requires_grad_() for name in FIELDS}
    image = section(splats, plane, quantity, kernel)
    weights = np.random.default_rng(1).normal(size=image.shape)
    (image * torch.as_tensor(weights).to(image)).sum().backward()
    grads = {name: torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for name, leaf in leaves.items()}
    return image.detach().cpu().double(), {name: grad.cpu().double() for name, grad in grads.items()}


@pytest.mark.parametrize("thickness", [0.0, 0.01, 0.2, 2.0, 20.0])
@pytest.mark.parametrize("quantity", QUANTITIES)
def test_image_and_gradients_are_the_references(blocks, quantity: str, thickness: float) -> None:
    plane = replace(PLANE, thickness_mm=thickness)
    truth, true_grads = render(scene(80, seed=2), plane, quantity, "reference")
    image, grads = render(scene(80, seed=2), plane, quantity, "cuda")
    assert (image - truth).abs().max() < 1e-4 * truth.max()
    for name, expected in true_grads.items():
        assert (grads[name] - expected).norm() <= 1e-3 * expected.norm(), name


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 33), (17, 5)])
def test_any_image_size(width: int, height: int) -> None:
    plane = replace(PLANE, width=width, height=height)
    truth, _ = render(scene(60, seed=5), plane, "density", "reference")
    image, _ = render(scene(60, seed=5), plane, "density", "cuda")
    torch.testing.assert_close(image, truth, rtol=1e-5, atol=2e-6)


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_the_same_bits_every_time(quantity: str) -> None:
    plane = replace(PLANE, thickness_mm=1.0)
    results = [render(scene(200, seed=6), plane, quantity, "cuda") for _ in range(2)]
    assert torch.equal(results[0][0], results[1][0])
    assert all(torch.equal(results[0][1][name], results[1][1][name]) for name in FIELDS)


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_splats_that_are_not_numbers_are_left_out(quantity: str) -> None:
    gaussians = scene(8)
    scales = gaussians.scales.copy()
    scales[4:] = np.nan
    image, grads = render(replace(gaussians, scales=scales), PLANE, quantity, "cuda")
    torch.testing.assert_close(image, render(gaussians.select(slice(0, 4)), PLANE, quantity, "cuda")[0])
    assert all(grad.isfinite().all() for grad in grads.values())


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_an_empty_set_is_a_black_image(quantity: str) -> None:
    image, _ = render(GaussianSet.empty(), PLANE, quantity, "cuda")
    assert image.shape[:2] == (29, 37)
    assert not image.any()
