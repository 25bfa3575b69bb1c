"""gsplat beside the `cuda` kernel: it is asked for the same picture, and only where it is installed.

gsplat itself needs a card, so a module stands in for it that takes the same arguments and draws with our reference.
"""

import sys
from types import ModuleType

import numpy as np
import pytest
import torch

from insideout.core.bench import kernels
from insideout.core.bench.kernels import Grid, Step, measure
from insideout.core.bench.scenes import scene
from insideout.core.gaussians import GaussianSet
from insideout.core.render import splat
from insideout.core.views import Camera

SMALL = Grid(renderers=("splat",), kernel="cuda", splats=(40,), sides=(24,), repeats=1)


def rasterization(
    means, quats, scales, opacities, colors, viewmats, Ks, width, height, *, near_plane, sh_degree, packed
):  # fmt: skip
    """Of gsplat 1.5, for one camera; shapes as its documentation has them."""
    count = len(means)
    assert quats.shape == (count, 4)
    assert colors.shape == (count, (sh_degree + 1) ** 2, 3)
    assert viewmats.shape == (1, 4, 4)
    assert Ks.shape == (1, 3, 3)
    (fx, _, cx), (_, fy, cy), _ = Ks[0].tolist()
    camera = Camera(width, height, fx, fy, cx, cy, viewmats[0].numpy().astype(np.float64), near=near_plane)
    rest = {"density": torch.zeros(count), "modality": torch.zeros(count, dtype=torch.uint8)}
    drawn = splat(GaussianSet(means, quats, scales, opacities, colors, **rest), camera, kernel="reference")
    return drawn.color[None], drawn.alpha[None, ..., None], {}


@pytest.fixture
def gsplat(monkeypatch):
    module = ModuleType("gsplat")
    module.rasterization = rasterization
    monkeypatch.setitem(sys.modules, "gsplat", module)
    monkeypatch.setattr("insideout.core.bench.peer.is_installed", lambda: True)
    # A card, as far as the measurement is concerned.
    monkeypatch.setattr(kernels, "_device", lambda kernel: "cpu")


def test_it_is_asked_for_the_picture_of_the_scene(gsplat):
    case = scene(60, 32)
    ours, theirs = (Step("splat", kernel, case, "cpu").render() for kernel in ("reference", "gsplat"))
    torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-6)


def test_it_has_rows_of_its_own_beside_the_cuda_kernel(gsplat):
    pytest.importorskip("warp")
    rows = measure(SMALL)
    assert [row["kernel"] for row in rows] == ["cuda", "gsplat"]
    assert all(row["backward_ms"] > 0 for row in rows)


def test_where_it_is_not_installed_nothing_is_said_of_it(monkeypatch):
    pytest.importorskip("warp")
    monkeypatch.setattr("insideout.core.bench.peer.is_installed", lambda: False)
    monkeypatch.setattr(kernels, "_device", lambda kernel: "cpu")
    assert [row["kernel"] for row in measure(SMALL)] == ["cuda"]
