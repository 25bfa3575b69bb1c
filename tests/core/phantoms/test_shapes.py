"""Signed distances are distances: zero on the surface, negative inside, slope one."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.phantoms import shapes


@pytest.fixture
def points():
    return np.random.default_rng(0).uniform(-20, 20, (2000, 3)).astype(np.float32)


def slope(distance, points, step=0.01):
    gradient = [(distance(points + step * e) - distance(points - step * e)) / (2 * step) for e in np.eye(3, dtype="f4")]
    return np.linalg.norm(gradient, axis=0)


def test_sphere(points):
    found = shapes.sphere(points, np.array([1, 2, 3]), 5.0)
    np.testing.assert_allclose(found, np.linalg.norm(points - [1, 2, 3], axis=1) - 5, atol=1e-4)


def test_tube_is_capsules_along_the_path(points):
    straight = np.array([[0, 0, -5], [0, 0, 0], [0, 0, 5]], float)
    beyond = points - np.clip(points[:, 2:], -5, 5) * [0, 0, 1]
    np.testing.assert_allclose(shapes.tube(points, straight, 2.0), np.linalg.norm(beyond, axis=1) - 2, atol=1e-4)


def test_ellipsoid_is_zero_on_its_surface_with_slope_one():
    rng = np.random.default_rng(1)
    turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    unit = rng.standard_normal((500, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    surface = ((unit * [6, 3, 4]) @ turn + [1, 0, 2]).astype(np.float32)

    def distance(at):
        return shapes.ellipsoid(at, np.array([1, 0, 2]), turn, (6, 3, 4))

    np.testing.assert_allclose(distance(surface), 0, atol=1e-4)
    np.testing.assert_allclose(slope(distance, surface), 1, atol=0.02)


def test_profile_of_a_ball_with_its_bottom_cut_off(points):
    polar = np.linspace(np.radians(130), 0, 40)
    profile = shapes.Profile.through(10 * np.stack([np.sin(polar), np.cos(polar)], axis=1))

    bottom = 10 * np.cos(np.radians(130))
    outside = np.linalg.norm(points, axis=1) - 10
    above = (points[:, 2] > bottom) & (outside < 8)
    expected = np.maximum(outside, bottom - points[:, 2])
    np.testing.assert_allclose(profile.distance(points)[above], expected[above], atol=0.02)
    below = np.array([[0, 0, bottom - 3], [4, 0, bottom - 1]], np.float32)
    np.testing.assert_allclose(profile.distance(below), [3, 1], atol=0.02)


def test_scaling_keeps_distances_true(points):
    half = shapes.moved(lambda p: shapes.sphere(p, np.zeros(3), 8.0), 0.5, (1, 0, -2))
    np.testing.assert_allclose(half(points), np.linalg.norm(points - [1, 0, -2], axis=1) - 4, atol=1e-4)


def test_smooth_union_only_fills_the_edge():
    first, second = np.array([-1.0, 5.0, 0.1]), np.array([3.0, 1.0, 0.1])
    joined = shapes.smooth_union(first, second, 1.0)
    np.testing.assert_allclose(joined[:2], [-1, 1])
    assert joined[2] == pytest.approx(0.1 - 0.25)
