"""Convex hulls of many points: the same as of all at once, in steps."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.errors import SettingError
from insideout.insideout_addon.physics.hulls import convex_hull, hull_in_steps


def ways(count=2000):
    found = np.random.default_rng(1).normal(size=(count, 3))
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def scattered(kind, count=50_000):
    rng = np.random.default_rng(0)
    if kind == "ball":
        return 20 * ways(count) * rng.uniform(size=(count, 1)) ** (1 / 3) + (5.0, -80.0, 3.0)
    if kind == "box":
        return rng.uniform((-1, -20, -3), (1, 20, 3), (count, 3))
    if kind == "sphere":
        return 20 * ways(count)
    # Thinner than the ways in which the farthest points are looked for can tell.
    disc = rng.uniform(-20, 20, (count, 3)) * (1, 1, 1e-3)
    return disc @ np.linalg.qr(rng.normal(size=(3, 3)))[0]


@pytest.mark.parametrize("kind", ["ball", "box", "sphere", "disc"])
def test_it_reaches_as_far_as_the_points_each_way(blender, kind):
    points = scattered(kind)
    vertices, faces = convex_hull(points)
    apart = (points @ ways().T).max(axis=0) - (vertices @ ways().T).max(axis=0)
    # Blender makes hulls of whole numbers, 10,000 along the longest side.
    assert np.abs(apart).max() < 2e-4 * np.ptp(points, axis=0).max()
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("ij,ij->i", normals, corners[:, 0] - vertices.mean(axis=0)) >= -1e-6).all()
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()


def test_many_points_have_many_steps(blender):
    shares = list(hull_in_steps(scattered("sphere", 100_000)))
    assert len(shares) > 8
    assert shares == sorted(shares)
    assert 0 < shares[0] <= shares[-1] <= 1


def test_three_corners_enclose_nothing(blender):
    with pytest.raises(SettingError, match="the model is flat"):
        convex_hull(scattered("box", 3))
