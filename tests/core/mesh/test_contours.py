"""Contours of a section lie where the body's outline lies, in millimetres."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.mesh import contours
from insideout.core.views import Plane


@pytest.fixture
def axial_plane():
    """z = −1, one pixel 0.5 mm, rows running towards −y."""
    return Plane(origin=[-14.0, 14.0, -1.0], u=[0.5, 0, 0], v=[0, -0.5, 0], width=56, height=56)


def test_ball_is_cut_in_a_circle(ball_volume, axial_plane):
    (circle,) = contours(ball_volume(), axial_plane, 0.025)

    np.testing.assert_allclose(np.linalg.norm(circle - [1, 2, -1], axis=1), 10, atol=0.1)
    np.testing.assert_allclose(circle[:, 2], -1)
    np.testing.assert_allclose(circle[0], circle[-1])


def test_hollow_ball_has_two_longest_first(ball_volume, axial_plane):
    outer, inner = contours(ball_volume(cavity=6.0), axial_plane, 0.025)

    assert np.linalg.norm(outer - [1, 2, -1], axis=1).mean() == pytest.approx(10, abs=0.05)
    assert np.linalg.norm(inner - [1, 2, -1], axis=1).mean() == pytest.approx(6, abs=0.05)


def test_a_tilted_plane(ball_volume):
    u, v = 0.4 * np.array([0.6, 0.8, 0]), 0.4 * np.array([0, 0, -1.0])
    plane = Plane(origin=np.array([1, 2, -1]) - 35 * u - 35 * v, u=u, v=v, width=70, height=70)

    (circle,) = contours(ball_volume(), plane, 0.025)

    np.testing.assert_allclose(np.linalg.norm(circle - [1, 2, -1], axis=1), 10, atol=0.1)
    np.testing.assert_allclose((circle - [1, 2, -1]) @ plane.normal, 0, atol=1e-9)


def test_material_that_leaves_the_image_is_closed_along_its_border():
    plane = Plane(origin=[0.0, 0.0, 0.0], u=[1.0, 0, 0], v=[0, 1.0, 0], width=4, height=3)

    (line,) = contours(np.ones((3, 4)), plane, 0.5)

    np.testing.assert_allclose(line[0], line[-1])
    np.testing.assert_allclose([line.min(axis=0), line.max(axis=0)], [[0, 0, 0], [4, 3, 0]])


def test_short_lines_can_be_left_out(ball_volume, axial_plane):
    assert len(contours(ball_volume(cavity=3.0), axial_plane, 0.025, shortest_mm=30)) == 1


def test_section_must_fit_the_plane(axial_plane):
    with pytest.raises(ValueError, match="pixels"):
        contours(np.zeros((5, 5)), axial_plane, 0.5)
