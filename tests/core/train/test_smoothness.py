"""Total variation of a block of voxels."""

import numpy as np
import pytest

from insideout.core.gaussians import GaussianSet
from insideout.core.render.voxels import voxelize
from insideout.core.train.smoothness import block_variation

BOX = np.array([[-8.0, -8.0, -8.0], [8.0, 8.0, 8.0]])


def some_splats(count=40):
    rng = np.random.default_rng(0)
    return GaussianSet.create(rng.uniform(-6, 6, (count, 3)), rng.uniform(0.8, 2, (count, 3)), density=0.05)


def test_a_block_as_large_as_the_box_is_all_of_it():
    splats = some_splats()
    found = block_variation(splats.to_torch(), BOX, 1.0, 16, 4.0, np.random.default_rng(1))
    values = voxelize(splats, np.full(3, -7.5), np.ones(3), (16, 16, 16), cutoff_sigmas=4.0).values
    steps = [np.abs(np.diff(values, axis=axis)) for axis in range(3)]
    wanted = sum(step.sum() for step in steps) / sum(step.size for step in steps)
    assert float(found) == pytest.approx(wanted, rel=1e-4)


def test_a_smaller_block_lies_elsewhere_for_another_seed():
    splats = some_splats().to_torch()
    found = {float(block_variation(splats, BOX, 1.0, 4, 4.0, np.random.default_rng(seed))) for seed in range(5)}
    assert len(found) == 5


def test_edges_are_told_by_the_differences_of_neighbouring_voxels():
    splats = some_splats()
    values = voxelize(splats, np.full(3, -7.5), np.ones(3), (16, 16, 16), cutoff_sigmas=4.0).values
    steps = np.concatenate([np.abs(np.diff(values, axis=axis)).ravel() for axis in range(3)])
    found = block_variation(splats.to_torch(), BOX, 1.0, 16, 4.0, np.random.default_rng(1), 0.01)
    assert float(found) == pytest.approx(float((0.01 * steps / (0.01 + steps)).mean()), rel=1e-4)
