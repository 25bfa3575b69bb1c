"""Voxel volumes against direct evaluation, and their gradients."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import pytest
import torch

from insideout.core.errors import SettingError
from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.render import voxels
from insideout.core.render.voxels import LastAverages, voxel_averages, voxelize, voxelize_block
from insideout.core.rotations import quats_to_matrices
from insideout.core.volume import Volume

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


def sheets(thickness: float, count: int = 200) -> GaussianSet:
    """Discs within 16 mm, `thickness` mm thin, that lie every way."""
    rng = np.random.default_rng(3)
    return GaussianSet.create(
        rng.uniform(2, 14, (count, 3)),
        np.column_stack([np.full(count, thickness), rng.uniform(1, 3, (count, 2))]),
        quats=rng.normal(size=(count, 4)),
        density=rng.uniform(0.2, 1, count),
    )


def finely(gaussians: GaussianSet, spacing: np.ndarray, shape_xyz: np.ndarray, parts: int) -> np.ndarray:
    """Averages of `parts`³ points a voxel; voxel [0, 0, 0] is centred on 0."""
    points = voxelize(gaussians, (1 / parts - 1) / 2 * spacing, spacing / parts, tuple(shape_xyz[::-1] * parts)).values
    nx, ny, nz = shape_xyz
    return points.reshape(nz, parts, ny, parts, nx, parts).mean(axis=(1, 3, 5), dtype=np.float64)


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (0.5, 1.0, 2.0)], ids=["cubes", "oblong"])
@pytest.mark.parametrize(("thickness", "most"), [(1.0, 0.0005), (0.7, 0.0005), (0.3, 0.0005), (0.1, 0.002)])
def test_averages_are_those_of_all_points_of_a_voxel(spacing: tuple, thickness: float, most: float) -> None:
    step = np.array(spacing)
    gaussians, shape = sheets(thickness), np.round(16 / step).astype(int)
    grid = Volume(np.zeros(shape[::-1], np.float32), step, np.zeros(3))
    truth = finely(gaussians, step, shape, 12)
    averages = voxel_averages(gaussians, grid).values
    assert np.sqrt(np.mean((averages - truth) ** 2)) < most * truth.max()


def test_averages_of_sheets_are_far_nearer_than_values_at_voxel_centres() -> None:
    gaussians, shape = sheets(0.1), np.full(3, 16)
    grid = Volume(np.zeros(shape, np.float32), np.ones(3), np.zeros(3))
    truth = finely(gaussians, np.ones(3), shape, 12)
    at_centers = voxelize(gaussians, np.zeros(3), 1.0, (16, 16, 16)).values
    error = np.abs(voxel_averages(gaussians, grid).values - truth).mean()
    assert error < 0.05 * np.abs(at_centers - truth).mean()


def saved(gaussians: GaussianSet, folder: Path) -> GaussianSet:
    """What comes back from a file."""
    gaussians.save(folder / "saved.ply")
    return GaussianSet.load(folder / "saved.ply").to_numpy()


def test_a_fat_splat_is_not_cut_up_for_a_thin_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Parts cost by their number; those of a voxel that thin splats need are no use to fat ones."""
    fat, thin = sheets(2.0), sheets(0.1)
    grid = Volume(np.zeros((16, 16, 16), np.float32), np.ones(3), np.zeros(3))
    apart = [voxel_averages(splats, grid).values for splats in (fat, thin)]
    drawn, plain = {}, voxels.voxelize
    monkeypatch.setattr(voxels, "voxelize", lambda *args: drawn.update({args[3]: len(args[0])}) or plain(*args))
    both = voxel_averages(GaussianSet.concatenate([fat, thin]), grid).values
    assert drawn == {(16, 16, 16): len(fat), (48, 48, 48): len(thin)}
    np.testing.assert_allclose(both, sum(apart), rtol=1e-6, atol=1e-6)


def test_a_model_that_is_averaged_again_costs_nothing_beside_splats_that_do_not_attenuate(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A run's files have the radiative splats, its figures all of them, from a file where scales are logarithms."""
    grid = Volume(np.zeros((16, 16, 16), np.float32), np.ones(3), np.zeros(3))
    model, coarser = saved(sheets(0.3), tmp_path), Volume(np.zeros((8, 8, 8), np.float32), 2 * np.ones(3), np.zeros(3))
    photos = replace(sheets(1.0), density=np.zeros(len(sheets(1.0)), np.float32))
    averages, made = LastAverages(), []
    monkeypatch.setattr(voxels, "voxel_averages", lambda *given: made.append(voxel_averages(*given)) or made[-1])
    first = averages(model, grid)
    both = saved(GaussianSet.concatenate([photos, model]), tmp_path)
    assert not np.array_equal(both.scales[len(photos) :], model.scales), "or the file kept all its digits"
    assert averages(both, grid) is first
    np.testing.assert_array_equal(first.values, voxel_averages(model, grid).values)
    assert len(made) == 1
    # Another model, another grid, and one that was long ago are averaged.
    for given in ((sheets(0.5), grid), (model, coarser), (model, grid)):
        np.testing.assert_array_equal(averages(*given).values, voxel_averages(*given).values)
    assert len(made) == 4


def test_averages_are_the_same_slab_by_slab(monkeypatch: pytest.MonkeyPatch) -> None:
    grid = Volume(np.zeros((16, 16, 16), np.float32), np.ones(3), np.zeros(3))
    whole = voxel_averages(sheets(0.1), grid).values
    slabs, plain = [], voxels.voxelize
    monkeypatch.setattr(voxels, "_AT_ONCE", 5 * 16 * 16 * 27)
    monkeypatch.setattr(voxels, "voxelize", lambda *args: slabs.append(args[3][0] // 3) or plain(*args))
    np.testing.assert_allclose(voxel_averages(sheets(0.1), grid).values, whole, atol=1e-5 * whole.max())
    assert slabs == [5, 5, 5, 1]


def test_a_slice_of_voxels_far_higher_than_wide_fits_into_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """1000 x 1000 voxels of 0.1 x 0.1 x 5 mm would be cut into 150 layers each."""
    grid = Volume(np.zeros((2, 16, 16), np.float32), np.array([1.0, 1.0, 16.0]), np.array([0.0, 0.0, -8.0]))
    whole = voxel_averages(sheets(0.3), grid).values
    made, plain, most = [], voxels.voxelize, 4 * 16 * 16 * 12
    monkeypatch.setattr(voxels, "_AT_ONCE", most)
    monkeypatch.setattr(voxels, "voxelize", lambda *args: made.append(np.prod(args[3])) or plain(*args))
    found = voxel_averages(sheets(0.3), grid).values
    assert max(made) <= most
    assert found.sum() == pytest.approx(whole.sum(), rel=0.02)
    # Fewer parts, which stay cubes: high ones would blur along the slice and miss sheets between two of them.
    assert np.sqrt(np.mean((found - whole) ** 2)) < 0.03 * whole.max()


def test_wide_splats_need_no_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """A large grid's parts would take minutes."""
    seen = []
    plain = voxels.voxelize
    monkeypatch.setattr(voxels, "voxelize", lambda *args: seen.append(args[3]) or plain(*args))
    wide = scene(40)
    grid = Volume(np.zeros((8, 8, 8), np.float32), np.full(3, 0.4 * float(wide.scales.min())), np.zeros(3))
    voxel_averages(wide, grid)
    voxel_averages(wide, replace(grid, spacing_mm=50 * grid.spacing_mm))
    assert seen == [(8, 8, 8), (24, 24, 24)]


def test_averages_of_nothing_are_zero() -> None:
    grid = Volume(np.zeros((4, 4, 4), np.float32), np.ones(3), np.zeros(3))
    clones = replace(scene(5), modality=np.full(5, Modality.CLONE, np.uint8))
    for nothing in (GaussianSet.empty(), clones):
        assert not voxel_averages(nothing, grid).values.any()


def test_averages_keep_the_mass_of_a_sheet_along_the_voxels() -> None:
    scales = np.array([[1.0, 0.08, 0.8]])
    gaussians = GaussianSet.create(np.array([[0.3, -0.2, 0.1]]), scales, density=0.5)
    grid = Volume(np.zeros((20, 20, 20), np.float32), np.full(3, 0.8), np.full(3, -7.6))
    mass = voxel_averages(gaussians, grid).values.sum(dtype=np.float64) * 0.8**3
    assert mass == pytest.approx(0.5 * (2 * np.pi) ** 1.5 * scales.prod(), rel=0.02)


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
