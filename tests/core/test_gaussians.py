"""GaussianSet: moving, joining and picking splats keeps what they mean."""

import numpy as np
import pytest
import torch

from insideout.core.gaussians import GaussianSet, Modality
from insideout.core.rotations import normalize_quats, quats_to_matrices
from insideout.core.similarity import Similarity
from insideout.core.spherical_harmonics import sh_basis


def random_set(count=7, degree=3, seed=0):
    rng = np.random.default_rng(seed)
    return GaussianSet.create(
        rng.normal(size=(count, 3)),
        rng.uniform(0.1, 2.0, (count, 3)),
        quats=rng.normal(size=(count, 4)),
        opacities=rng.uniform(0.05, 0.95, count),
        sh=rng.normal(size=(count, (degree + 1) ** 2, 3)),
        density=rng.uniform(0, 0.1, count),
        modality=rng.integers(0, 3, count),
    )


def random_similarity(seed=1):
    rng = np.random.default_rng(seed)
    rotation = quats_to_matrices(normalize_quats(rng.normal(size=(1, 4))))[0]
    return Similarity(3.7, rotation, rng.normal(size=3))


def test_a_similarity_moves_the_covariances_as_it_moves_points():
    gaussians, similarity = random_set(), random_similarity()
    moved = gaussians.transformed(similarity)
    turn = similarity.scale * similarity.rotation
    np.testing.assert_allclose(moved.covariances(), turn @ gaussians.covariances() @ turn.T, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(moved.means, similarity.apply(gaussians.means), rtol=1e-5, atol=1e-5)


def test_line_integrals_survive_a_change_of_scale():
    gaussians, similarity = random_set(), random_similarity()
    moved = gaussians.transformed(similarity)
    np.testing.assert_allclose(
        moved.density[:, None] * moved.scales, gaussians.density[:, None] * gaussians.scales, rtol=1e-5
    )


def test_colour_turns_with_the_object():
    gaussians, similarity = random_set(), random_similarity()
    moved = gaussians.transformed(similarity)
    direction = np.array([[0.6, 0.0, 0.8]])
    before = np.einsum("k,nkc->nc", sh_basis(direction, 3)[0], gaussians.sh)
    after = np.einsum("k,nkc->nc", sh_basis(direction @ similarity.rotation.T, 3)[0], moved.sh)
    np.testing.assert_allclose(after, before, atol=1e-5)


def test_joining_sets_pads_the_lower_degree():
    joined = GaussianSet.concatenate([random_set(3, degree=0), random_set(2, degree=2)])
    assert len(joined) == 5
    assert joined.sh_degree == 2
    assert not joined.sh[:3, 1:].any()


def test_an_empty_set_joins_and_moves():
    empty = GaussianSet.empty()
    assert len(empty.transformed(random_similarity())) == 0
    assert len(GaussianSet.concatenate([empty, random_set(2)])) == 2


def test_torch_and_back_is_the_same_set():
    gaussians = random_set()
    back = gaussians.to_torch(torch.float64).to_numpy()
    np.testing.assert_array_equal(back.sh, gaussians.sh)
    assert back.modality.dtype == np.uint8


def test_torch_and_numpy_covariances_agree():
    gaussians = random_set()
    np.testing.assert_allclose(gaussians.to_torch().covariances().numpy(), gaussians.covariances(), rtol=1e-4)


def test_selecting_by_modality():
    gaussians = random_set(50)
    clones = gaussians.select(gaussians.modality == Modality.CLONE)
    assert 0 < len(clones) < 50
    assert np.all(clones.modality == Modality.CLONE)


def test_a_zero_quaternion_becomes_no_rotation():
    gaussians = GaussianSet.create(np.zeros((1, 3)), 1.0, quats=np.zeros((1, 4)))
    np.testing.assert_array_equal(gaussians.quats, [[1, 0, 0, 0]])


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_degree_follows_from_the_coefficients(degree):
    assert random_set(degree=degree).sh_degree == degree
