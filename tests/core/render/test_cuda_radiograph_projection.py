"""The Warp projection of radiographs' splats and its gradients: sums over pixels in float64 instead of the kernel's."""

from __future__ import annotations

import numpy as np
import pytest
import torch

wp = pytest.importorskip("warp")

from insideout.core.render.kernels.cuda.radiograph_projection import (  # noqa: E402
    AFFINE,
    CONE,
    PARALLEL,
    Beam,
    project,
    project_backward,
)
from insideout.core.render.kernels.reference.radiograph import (  # noqa: E402
    detector_pixels,
    detector_tensors,
    line_integrals,
)
from insideout.core.views import Detector  # noqa: E402

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
WIDTH, HEIGHT = 23, 19
VECTORS = ("source", "center", "u", "v")
CONE_BEAM = ((60, 70, 5), (-50, -60, 3), (1.0, -0.9, 0.2), (0.25, 0.15, -1.35))
PARALLEL_BEAM = ((-3, -2, 0.5), (-40, -30, 3), (0.4, -0.6, 0.2), (0.25, 0.15, -0.9))


@pytest.fixture(params=[CONE, PARALLEL, AFFINE], ids=["cone", "parallel", "affine"])
def beam(request) -> Beam:
    beam = Beam()
    beam.kind, beam.width, beam.height, beam.cutoff, beam.keep_empty = request.param, WIDTH, HEIGHT, 30.0, True
    return beam


@pytest.fixture
def detector(beam) -> Detector:
    """Its vectors are float64 leaves."""
    vectors = PARALLEL_BEAM if beam.kind == PARALLEL else CONE_BEAM
    leaves = [torch.tensor(vector, dtype=torch.float64, requires_grad=True) for vector in vectors]
    return Detector(WIDTH, HEIGHT, *leaves, beam.kind == PARALLEL)


@pytest.fixture
def splats() -> tuple[torch.Tensor, ...]:
    """Means, quats, scales and density, float64 leaves."""
    rng = np.random.default_rng(4)
    count = 20
    arrays = (
        rng.normal(size=(count, 3)) * 5,
        rng.normal(size=(count, 4)),
        10 ** rng.uniform(0.2, 0.8, (count, 3)),
        rng.uniform(0.05, 1, count),
    )
    return tuple(torch.tensor(array, requires_grad=True) for array in arrays)


def parameters_of(splats, detector) -> tuple[torch.Tensor, ...]:
    vectors = torch.stack(detector_tensors(detector, splats[0]))
    return tuple(tensor.detach().to(DEVICE) for tensor in (*splats, vectors))


def of_pixels(rays) -> tuple[torch.Tensor, ...]:
    """z (N, P, 3), x and y (N, P) of P z, den and w (N, P) of all splats in all pixels, by the rows' numbers."""
    whole, rests, rows = (tensor.cpu().double() for tensor in (rays.whole, rays.rests, rays.rows))
    i, j = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    pixels = torch.stack([j.flatten(), i.flatten()], dim=1)
    z = torch.nn.functional.pad(pixels - (whole + rests)[:, None], (0, 1), value=1.0)
    p11, p12, p13, p22, p23, r11, r12, r13, r22, r23, r33, _ = rows[:, :, None].unbind(1)
    along, down = z[..., 0], z[..., 1]
    x, y = p11 * along + p12 * down + p13, p22 * down + p23
    den = (r11 * along + r12 * down + r13) ** 2 + (r22 * down + r23) ** 2 + r33**2
    return z, x, y, den, den.rsqrt() * torch.exp(-0.5 * (x * x + y * y) / den)


def ray_lengths(detector) -> torch.Tensor:
    source, center, u, v = detector_tensors(detector, torch.zeros((), dtype=torch.float64))
    return (detector_pixels(detector, center, u, v) - source).norm(dim=-1)


def test_the_rows_numbers_make_the_references_image(splats, detector, beam) -> None:
    rays = project(parameters_of(splats, detector), beam)
    *_, w = of_pixels(rays)
    image = (rays.rows[:, -1:].cpu() * w).sum(0)
    if beam.kind == CONE:
        image = image * ray_lengths(detector).detach()
    truth = line_integrals(*splats, detector, "affine" if beam.kind == AFFINE else "exact").detach()
    torch.testing.assert_close(image, truth.flatten(), rtol=1e-5, atol=1e-6 * float(truth.max()))


def test_the_gradients_are_the_references(splats, detector, beam, relative_error) -> None:
    incoming = torch.randn(HEIGHT * WIDTH, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    truth = line_integrals(*splats, detector, "affine" if beam.kind == AFFINE else "exact").flatten()
    leaves = [*splats, *(getattr(detector, name) for name in VECTORS)]
    expected = torch.autograd.grad(truth @ incoming, leaves)

    parameters = parameters_of(splats, detector)
    rays = project(parameters, beam)
    z, x, y, den, w = of_pixels(rays)
    length = ray_lengths(detector) if beam.kind == CONE else torch.ones(HEIGHT * WIDTH, dtype=torch.float64)
    hw = incoming * length.detach() * w
    tau = hw * rays.rows[:, -1:].cpu() / (2 * den)
    gamma = tau * ((x * x + y * y) / den - 1)
    sums = [(tau * offset)[..., None] * z for offset in (x, y)]
    moments = [gamma * z[..., a] * z[..., b] for a, b in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))]
    totals = torch.cat([hw[..., None], *sums, torch.stack(moments, dim=-1)], dim=-1).sum(1)
    starts = torch.arange(len(totals) + 1)
    *found, to_vectors = project_backward(parameters, beam, starts.to(DEVICE), totals.to(DEVICE), want_vectors=True)
    # The rest of the way to the detector: directions are normalised, and a cone's pixels are scaled by their rays.
    part = (rays.rows[:, -1:].cpu() * w).sum(0)
    rest = (torch.stack(detector_tensors(detector, splats[0])) * to_vectors.cpu()).sum() + (part * incoming) @ length
    found += torch.autograd.grad(rest, leaves[4:])
    for name, mine, theirs in zip(("means", "quats", "scales", "density", *VECTORS), found, expected, strict=True):
        assert relative_error(mine.cpu(), theirs) < 1e-5, name


def test_outside_of_a_box_nothing_is_within_the_cutoff_and_its_edges_are(splats, detector, beam) -> None:
    beam.cutoff = 1.5
    rays = project(parameters_of(splats, detector), beam)
    _, x, y, den, _ = of_pixels(rays)
    near = ((x * x + y * y) / den <= beam.cutoff**2).reshape(-1, HEIGHT, WIDTH)
    for box, seen in zip(rays.boxes.tolist(), near, strict=True):
        left, right, top, bottom = box
        inside = torch.zeros_like(seen)
        inside[top:bottom, left:right] = True
        assert not (seen & ~inside).any()
    assert near.any()


def test_what_cannot_be_drawn_has_an_empty_box_and_no_gradient(splats, detector, beam) -> None:
    means, quats, scales, density = (tensor.detach().clone() for tensor in splats)
    means[0, 1], quats[1, 2], scales[2, 0], density[3], density[4] = torch.nan, torch.inf, torch.nan, torch.inf, 0.0
    beam.keep_empty = False
    broken = parameters_of((means, quats, scales, density), detector)
    boxes = project(broken, beam).boxes.cpu()
    assert not boxes[:5].any()
    assert (boxes[5:, 0] < boxes[5:, 1]).all()
    slot_starts = torch.arange(-4, len(means) - 3, device=DEVICE).clamp_min(0)
    gradients = project_backward(broken, beam, slot_starts, torch.ones(20, 13, device=DEVICE).double(), False)
    assert len(gradients) == 4
    assert not any(gradient[:4].any() for gradient in gradients)


def test_a_splat_without_density_is_kept_for_its_gradient(splats, detector, beam) -> None:
    means, quats, scales, density = splats
    rays = project(parameters_of((means, quats, scales, 0 * density), detector), beam)
    assert (rays.boxes[:, 0] < rays.boxes[:, 1]).all()
    assert not rays.rows[:, -1].any()
