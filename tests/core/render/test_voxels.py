"""Voxel volumes against direct evaluation, and their gradients."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest
import torch

from insideout.core.errors import SettingError
from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.render.voxels import voxelize, voxelize_block
from insideout.core.rotations import quats_to_matrices

FIELDS = ("means", "quats", "scales", "density")
GRID = (np.array([-5.0, -4, -6]), np.array([0.5, 0.6, 0.7]), (11, 13, 9))


def scene(count: int, seed: int = 0) -> GaussianSet:
    rng = np.random.default_rng(seed)
    return GaussianSet.create(
        rng.normal(size=(count, 3)) * 4,
        10 ** rng.uniform(-0.6, 0.4, (count, 3)),
        quats=rng.normal(size=(count, 4)),
        density=rng.uniform(0.05, 1, count),
    )


def direct(splats: GaussianSet) -> torch.Tensor:
    """Every splat at every voxel, in plain torch."""
    origin, spacing, shape = GRID
    z, y, x = np.meshgrid(*[np.arange(size) for size in shape], indexing="ij")
    points = torch.as_tensor(np.stack([x, y, z], axis=-1) * spacing + origin)
    rotations = quats_to_matrices(splats.quats / splats.quats.norm(dim=1, keepdim=True))
    apart = points[..., None, :] - splats.means
    white = torch.einsum("zyxni,nij->zyxnj", apart, rotations) / splats.scales
    return torch.exp(-0.5 * (white * white).sum(-1)) @ splats.density


def test_volume_is_the_model_at_the_voxel_centres() -> None:
    gaussians = scene(60)
    volume = voxelize(gaussians, *GRID)
    truth = direct(gaussians.to_torch(torch.float64)).numpy()
    np.testing.assert_allclose(volume.values, truth, rtol=1e-5, atol=2e-6 * truth.max())
    np.testing.assert_array_equal(volume.origin_mm, GRID[0])
    np.testing.assert_array_equal(volume.spacing_mm, GRID[1])


def test_volume_of_a_whole_splat_holds_its_mass() -> None:
    scales = np.array([[1.0, 0.6, 0.8]])
    gaussians = GaussianSet.create(np.array([[0.3, -0.2, 0.1]]), scales, density=0.5)
    volume = voxelize(gaussians, [-8, -8, -8], 0.25, (65, 65, 65))
    mass = volume.values.sum(dtype=np.float64) * 0.25**3
    assert mass == pytest.approx(0.5 * (2 * np.pi) ** 1.5 * scales.prod(), rel=1e-5)


def test_block_gradients_equal_those_of_direct_evaluation() -> None:
    weights = torch.as_tensor(np.random.default_rng(1).normal(size=GRID[2]))
    results = []
    for dtype in (torch.float64, torch.float32):
        splats = scene(60).to_torch(dtype)
        leaves = [getattr(splats, name).requires_grad_() for name in FIELDS]
        values = direct(splats) if dtype == torch.float64 else voxelize_block(splats, *GRID)
        (values * weights.to(dtype)).sum().backward()
        results.append((values.detach().double(), [leaf.grad.double() for leaf in leaves]))
    (truth, truth_grads), (values, grads) = results
    assert (values - truth).abs().max() < 1e-5 * truth.max()
    for expected, grad in zip(truth_grads, grads, strict=True):
        assert (grad - expected).norm() < 1e-4 * expected.norm()


def test_cutoff_leaves_out_only_the_tails() -> None:
    gaussians = GaussianSet.create(np.zeros((1, 3)), 1.0, density=1.0)
    values = voxelize(gaussians, [-6, -6, -6], 0.25, (49, 49, 49), cutoff_sigmas=3).values
    full = voxelize(gaussians, [-6, -6, -6], 0.25, (49, 49, 49)).values
    assert np.abs(values - full).max() <= np.exp(-4.5) + 1e-6


def test_bits_do_not_depend_on_the_number_of_threads() -> None:
    threads = numba.get_num_threads()
    volumes, gradients = [], []
    try:
        for count in {1, threads}:
            numba.set_num_threads(count)
            splats = scene(600, seed=2).to_torch()
            splats.means.requires_grad_()
            block = voxelize_block(splats, *GRID)
            block.square().sum().backward()
            volumes.append(block.detach())
            gradients.append(splats.means.grad)
    finally:
        numba.set_num_threads(threads)
    assert all(torch.equal(volume, volumes[0]) for volume in volumes)
    assert all(torch.equal(grad, gradients[0]) for grad in gradients)


@pytest.mark.parametrize(
    "scale",
    [(30, 3e-5, 3e-5), (30, 30, 3e-5), (1e-8, 1e-8, 1e-8), (1e8, 1e8, 1e8)],
    ids=["needle", "disc", "tiny", "huge"],
)
def test_extreme_shapes_stay_finite_and_right(scale: tuple) -> None:
    gaussians = GaussianSet.create(
        np.array([[-3.0, -1.6, -2.5]]), np.array([scale]), quats=np.array([[0.9, 0.1, 0.3, -0.2]]), density=0.5
    )
    splats = gaussians.to_torch()
    leaves = [getattr(splats, name).requires_grad_() for name in FIELDS]
    values = voxelize_block(splats, *GRID)
    values.sum().backward()
    truth = direct(gaussians.to_torch(torch.float64))
    assert (values.detach() - truth).abs().max() <= 1e-3 * truth.max()
    assert all(leaf.grad.isfinite().all() for leaf in leaves)


def test_empty_set_clones_and_splats_that_are_not_numbers_show_nothing() -> None:
    clones = replace(scene(5), modality=np.full(5, Modality.CLONE, np.uint8))
    broken = replace(scene(5), means=np.full((5, 3), np.nan, np.float32))
    for gaussians in (GaussianSet.empty(), clones, broken):
        assert np.abs(voxelize(gaussians, *GRID).values).max() == 0


@pytest.mark.parametrize("grid", [(np.zeros(3), 0.0, (4, 4, 4)), (np.zeros(3), 1.0, (4, 0, 4))])
def test_a_wrong_grid_says_what_is_wrong(grid: tuple) -> None:
    with pytest.raises(SettingError):
        voxelize(scene(1), *grid)
