"""The Warp projection of cuts' and slabs' splats and its gradients: sums over pixels by autograd in float64."""

from __future__ import annotations

import numpy as np
import pytest
import torch

wp = pytest.importorskip("warp")

from insideout.core.render.kernels.cuda.section_projection import project, project_backward, slab_of  # noqa: E402
from insideout.core.render.kernels.reference.section import sum_on_plane  # noqa: E402
from insideout.core.views import Plane  # noqa: E402

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
WIDTH, HEIGHT, CUTOFF = 23, 19, 30.0
U, V = np.array([0.5, 0.2, 0.1]), np.array([-0.2, 0.5, 0.0])


@pytest.fixture(params=[0.0, 0.01, 2.0], ids=["cut", "thin slab", "slab"])
def plane(request) -> Plane:
    return Plane(-0.5 * (WIDTH * U + HEIGHT * V), U, V, WIDTH, HEIGHT, request.param)


@pytest.fixture
def splats() -> tuple[torch.Tensor, ...]:
    """Means, quats, scales and amount, float64 leaves."""
    rng = np.random.default_rng(4)
    count = 20
    arrays = (
        rng.normal(size=(count, 3)) * 2,
        rng.normal(size=(count, 4)),
        10 ** rng.uniform(-0.1, 0.5, (count, 3)),
        rng.uniform(0.05, 1, count),
    )
    return tuple(torch.tensor(array, requires_grad=True) for array in arrays)


def on_device(splats) -> tuple[torch.Tensor, ...]:
    return tuple(tensor.detach().to(DEVICE) for tensor in splats)


def weights(rows: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
    """(N, P) amount · w of all pixels by the rows' numbers (N, ROW) and j₀, i₀ (N, 2)."""
    i, j = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    pixels = torch.stack([j.flatten(), i.flatten()], dim=1) - places[:, None]
    c11, c12, c13, c22, c23, c31, c32, c33, eta, amount = rows[:, :, None].unbind(1)
    right, down = pixels.unbind(-1)
    x, y, m = c11 * right + c12 * down + c13, c22 * down + c23, c31 * right + c32 * down + c33
    root = 2**-0.5
    mean = (torch.erf((m + eta) * root) - torch.erf((m - eta) * root)) * (np.pi / 8) ** 0.5 / eta.clamp_min(1e-9)
    mean = torch.where(eta > 0, mean, torch.exp(-0.5 * m * m))
    return amount * torch.exp(-0.5 * (x * x + y * y)) * mean


def test_the_rows_numbers_make_the_references_image(splats, plane) -> None:
    cuts = project(on_device(splats), slab_of(plane, CUTOFF, True))
    places = cuts.whole.cpu() + cuts.rests.cpu().double()
    truth = sum_on_plane(*splats, torch.ones(20, 1, dtype=torch.float64), plane).detach().flatten()
    image = weights(cuts.rows.cpu().double(), places).sum(0)
    torch.testing.assert_close(image, truth, rtol=1e-5, atol=1e-6 * float(truth.max()))


def test_the_gradients_are_the_references(splats, plane, relative_error) -> None:
    incoming = torch.randn(HEIGHT * WIDTH, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    truth = sum_on_plane(*splats, torch.ones(20, 1, dtype=torch.float64), plane).flatten()
    expected = torch.autograd.grad(truth @ incoming, splats)

    slab = slab_of(plane, CUTOFF, True)
    cuts = project(on_device(splats), slab)
    rows = cuts.rows.cpu().double().requires_grad_()
    places = cuts.whole.cpu() + cuts.rests.cpu().double()
    by_c11, by_c12, by_c13, by_c22, by_c23, *by_m, by_eta, by_amount = torch.autograd.grad(
        (weights(rows, places) @ incoming).sum(), rows
    )[0].unbind(1)
    # Σ of y·z has a first number, too, although C's is always 0: it turns the basis, which no pixel can tell.
    turned = turned_basis(rows.detach(), places, incoming)
    totals = torch.stack([by_amount, -by_c11, -by_c12, -by_c13, turned, -by_c22, -by_c23, *by_m, by_eta], dim=1)
    starts = torch.arange(21, device=DEVICE)
    found = project_backward(on_device(splats), slab, starts, totals.to(DEVICE))
    for name, mine, theirs in zip(("means", "quats", "scales", "amount"), found, expected, strict=True):
        assert relative_error(mine.cpu(), theirs) < 1e-5, name


def turned_basis(rows: torch.Tensor, places: torch.Tensor, incoming: torch.Tensor) -> torch.Tensor:
    """Σ of h·w·amount·y·z₀ (N,) over pixels."""
    i, j = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    right, down = j.flatten() - places[:, :1], i.flatten() - places[:, 1:]
    y = rows[:, 3:4] * down + rows[:, 4:5]
    return (incoming * weights(rows, places) * y * right).sum(1)


def test_what_cannot_be_drawn_has_an_empty_box_and_no_gradient(splats, plane) -> None:
    means, quats, scales, amount = (tensor.detach().clone() for tensor in splats)
    means[0, 1], quats[1, 2], scales[2, 0], amount[3], amount[4] = torch.nan, torch.inf, torch.nan, torch.inf, 0.0
    broken = on_device((means, quats, scales, amount))
    boxes = project(broken, slab_of(plane, CUTOFF, False)).boxes.cpu()
    assert not boxes[:5].any()
    assert (boxes[5:, 0] < boxes[5:, 1]).all()
    starts = torch.arange(-5, 16, device=DEVICE).clamp_min(0)
    totals = torch.ones(20, 11, dtype=torch.float64, device=DEVICE)
    gradients = project_backward(broken, slab_of(plane, CUTOFF, False), starts, totals)
    assert not any(gradient[:5].any() for gradient in gradients[:3])
    assert all(gradient[5:].any() for gradient in gradients)
