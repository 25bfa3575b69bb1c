"""k-means, cluster levels and the fine step."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.gaussians import GaussianSet
from insideout.core.stages.align.kmeans import kmeans
from insideout.core.stages.align.local_fit import cluster_moves, normal_moves


def test_k_equal_to_n_makes_each_point_its_own_cluster():
    points = np.random.default_rng(0).normal(size=(200, 3))
    centroids, labels = kmeans(points, 200, seed=0)
    assert len(centroids) == 200
    assert np.allclose(centroids[labels], points)


def test_identical_points_share_a_cluster():
    points = np.repeat(np.random.default_rng(0).normal(size=(5, 3)), 40, axis=0)
    for count in (1, 3, 5, 200):
        centroids, labels = kmeans(points, count, seed=0)
        assert len(centroids) == min(count, 5)
        assert np.isfinite(centroids).all()
        assert labels.max() == len(centroids) - 1
    centroids, _ = kmeans(np.zeros((30, 3)), 30, seed=0)
    assert len(centroids) == 1


@pytest.mark.parametrize("count", [2, 50, 150, 299])
def test_no_cluster_is_empty_and_each_point_is_in_its_nearest(count):
    points = np.random.default_rng(1).normal(size=(300, 3)) ** 3
    centroids, labels = kmeans(points, count, seed=3)
    assert (np.bincount(labels, minlength=len(centroids)) > 0).all()
    distance = np.linalg.norm(points[:, None] - centroids[None], axis=2)
    assert np.allclose(distance[np.arange(300), labels], distance.min(axis=1))


def test_the_same_seed_gives_the_same_clusters():
    points = np.random.default_rng(1).normal(size=(500, 3))
    first, second = kmeans(points, 50, seed=7), kmeans(points, 50, seed=7)
    assert np.array_equal(first[0], second[0])
    assert np.array_equal(first[1], second[1])


def test_kmeans_refuses_no_points():
    with pytest.raises(ValueError, match="points"):
        kmeans(np.zeros((0, 3)), 4, seed=0)


@pytest.fixture
def dented(bodies):
    """The lump's shell in mm with a smooth 1 mm bulge on one side, and where it should be."""
    rgb, truth = bodies.shell(bodies.lump, 2)
    rgb = rgb.transformed(truth)
    means = rgb.means.astype(np.float64)
    bulge = 1.0 * np.exp(-((means - [30, 0, 0]) ** 2).sum(axis=1) / (2 * 12.0**2))
    outward = means / np.linalg.norm(means, axis=1, keepdims=True)
    moved = GaussianSet.create(means + bulge[:, None] * outward, 0.5, opacities=0.8)
    return moved, np.ones(len(rgb), bool), bulge > 0.3


def _height(gaussians, surface):
    _, nearest = surface.tree.query(gaussians.means)
    return ((gaussians.means - surface.points[nearest]) * surface.normals[nearest]).sum(axis=1)


@pytest.mark.parametrize("divisor", [10, 2, 1])
def test_a_cluster_level_takes_a_smooth_bulge_back(divisor, dented, lump_surface):
    rgb, members, bulged = dented
    moves = cluster_moves(rgb, members, lump_surface, divisor, limit=3000, seed=0)
    assert moves.matched > 0.2 * moves.clusters
    before, after = _height(rgb, lump_surface), _height(moves.applied(rgb), lump_surface)
    assert np.abs(after[bulged]).mean() < 0.8 * np.abs(before[bulged]).mean()


def test_neighbouring_splats_move_alike_so_that_no_seam_appears(dented, lump_surface):
    from scipy.spatial import cKDTree

    rgb, members, _ = dented
    shift = cluster_moves(rgb, members, lump_surface, 10, limit=3000, seed=0).shift
    distance, near = cKDTree(rgb.means).query(rgb.means, k=2)
    step = np.linalg.norm(shift - shift[near[:, 1]], axis=1)
    assert np.percentile(step, 99) < 0.15 + 0.3 * np.percentile(distance[:, 1], 99)


def test_no_splat_moves_further_than_a_local_spacing(dented, lump_surface):
    rgb, members, _ = dented
    far = GaussianSet.create(rgb.means * 1.3, 0.5, opacities=0.8)
    fine = normal_moves(far, members, lump_surface).shift
    level = cluster_moves(far, members, lump_surface, 1, limit=3000, seed=0).shift
    assert np.linalg.norm(fine, axis=1).max() < 2.0
    assert np.linalg.norm(level, axis=1).max() < 3.0


def test_splats_off_the_object_stay_where_they_are(dented, lump_surface):
    rgb, members, _ = dented
    floater = GaussianSet.create([[300.0, 0, 0]], 0.5, opacities=0.8)
    both = GaussianSet.concatenate([rgb, floater])
    members = np.append(members, False)
    assert not normal_moves(both, members, lump_surface).shift[-1].any()
    assert np.linalg.norm(cluster_moves(both, members, lump_surface, 10, 3000, 0).shift[-1]) < 1e-6


def test_the_fine_step_lays_splats_on_the_surface(dented, lump_surface):
    rgb, members, _ = dented
    moves = normal_moves(rgb, members, lump_surface)
    assert np.abs(_height(moves.applied(rgb), lump_surface)).mean() < 0.6 * np.abs(_height(rgb, lump_surface)).mean()
