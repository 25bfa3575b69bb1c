"""Rotations, similarities and colour functions agree with each other."""

import numpy as np
import pytest

from insideout.core.rotations import (
    matrices_to_quats,
    matrix_to_quat,
    multiply_quats,
    normalize_quats,
    quats_to_matrices,
)
from insideout.core.similarity import Similarity
from insideout.core.spherical_harmonics import rgb_to_sh, rotate_sh, sh_basis, sh_degree, sh_to_rgb


@pytest.fixture
def rotations():
    return quats_to_matrices(normalize_quats(np.random.default_rng(0).normal(size=(20, 4))))


def test_quaternion_matrix_and_back(rotations):
    half_turns = np.array([np.diag(d) for d in ([1, -1, -1], [-1, 1, -1], [-1, -1, 1], [1, 1, 1])], float)
    for matrix in [*rotations, *half_turns]:
        quat = matrix_to_quat(matrix)
        assert quat[0] >= 0
        np.testing.assert_allclose(quats_to_matrices(quat[None])[0], matrix, atol=1e-12)


def test_many_matrices_at_once_have_the_same_quaternions(rotations):
    half_turns = np.array([np.diag(d) for d in ([1, -1, -1], [-1, 1, -1], [-1, -1, 1], [1, 1, 1])], float)
    matrices = np.concatenate([rotations, half_turns, half_turns @ rotations[0]])
    quats = matrices_to_quats(matrices)
    one_by_one = np.array([matrix_to_quat(matrix) for matrix in matrices])
    np.testing.assert_allclose(np.abs((quats * one_by_one).sum(axis=1)), 1.0, atol=1e-12)
    np.testing.assert_allclose(quats_to_matrices(quats), matrices, atol=1e-12)
    assert matrices_to_quats(np.zeros((0, 3, 3))).shape == (0, 4)


def test_quaternion_products_are_matrix_products(rotations):
    left, right = matrix_to_quat(rotations[0]), matrix_to_quat(rotations[1])
    product = quats_to_matrices(multiply_quats(left, right)[None])[0]
    np.testing.assert_allclose(product, rotations[0] @ rotations[1], atol=1e-12)


def test_similarities_compose_and_invert(rotations):
    first = Similarity(2.0, rotations[0], np.array([1.0, 2, 3]))
    second = Similarity(0.3, rotations[1], np.array([-1.0, 0, 5]))
    points = np.random.default_rng(1).normal(size=(5, 3))
    np.testing.assert_allclose(second.after(first).apply(points), second.apply(first.apply(points)))
    np.testing.assert_allclose(first.inverse().apply(first.apply(points)), points)
    np.testing.assert_allclose(Similarity.from_json(first.to_json()).apply(points), first.apply(points))


def test_turned_harmonics_are_the_old_ones_seen_from_the_turned_side(rotations):
    sh = np.random.default_rng(2).normal(size=(4, 16, 3))
    directions = np.random.default_rng(3).normal(size=(9, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before = np.einsum("dk,nkc->dnc", sh_basis(directions, 3), sh)
    turned = rotate_sh(sh, rotations[0])
    after = np.einsum("dk,nkc->dnc", sh_basis(directions @ rotations[0].T, 3), turned)
    np.testing.assert_allclose(after, before, atol=1e-10)


def test_the_basis_is_orthonormal_on_the_sphere():
    count = 20_000
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    angle = np.pi * (1 + 5**0.5) * index
    ring = np.sqrt(1 - z * z)
    values = sh_basis(np.stack([ring * np.cos(angle), ring * np.sin(angle), z], -1), 3)
    np.testing.assert_allclose(4 * np.pi * values.T @ values / count, np.eye(16), atol=2e-3)


def test_colours_go_through_the_dc_coefficient_unchanged():
    rgb = np.array([[0.0, 0.5, 1.0]])
    np.testing.assert_allclose(sh_to_rgb(rgb_to_sh(rgb)), rgb)


def test_an_odd_number_of_coefficients_is_refused():
    with pytest.raises(ValueError, match="1, 4, 9 or 16"):
        sh_degree(5)
