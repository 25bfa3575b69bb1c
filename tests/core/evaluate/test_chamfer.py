"""Chamfer distance and hidden point removal, hard inputs included."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.evaluate.chamfer import chamfer, hidden_point_removal, outer_points


def _ball(count, seed=0):
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def test_a_shift_of_sparse_points_is_its_length():
    grid = np.stack(np.meshgrid(*[np.arange(5) * 10.0] * 3), axis=-1).reshape(-1, 3)
    result = chamfer(grid, grid + np.array([1.0, 0, 0]))
    assert result.mm == pytest.approx(1.0)
    assert result.squared_mm2 == pytest.approx(1.0)
    assert result.percent_of_diagonal == pytest.approx(100 / np.linalg.norm([40, 40, 40]))


def test_it_counts_both_ways():
    few, many = np.array([[0.0, 0, 0]]), np.array([[0.0, 0, 0], [4.0, 0, 0]])
    assert chamfer(few, many).mm == chamfer(many, few).mm == pytest.approx(1.0)


def test_trimming_lets_one_set_miss_a_part():
    ball = _ball(3000)
    cap_missing = ball[ball[:, 2] > -0.7]
    assert chamfer(cap_missing, ball, keep=0.8).mm < 1e-9
    assert chamfer(cap_missing, ball).mm > 0.01


@pytest.mark.parametrize("bad", [np.zeros((0, 3)), np.array([[np.nan, 0, 0]])], ids=["empty", "nan"])
def test_it_refuses_what_has_no_distance(bad):
    with pytest.raises(ValueError, match="finite"):
        chamfer(bad, np.zeros((4, 3)))


def test_a_viewpoint_sees_the_near_half_of_a_ball():
    ball = _ball(2000)
    visible = hidden_point_removal(ball, np.array([5.0, 0, 0]))
    assert visible[ball[:, 0] > 0.35].mean() > 0.9
    assert not visible[ball[:, 0] < 0].any()


def test_from_all_around_the_shell_is_kept_and_the_inside_removed():
    shell, inside = _ball(3000), _ball(3000, seed=1) * 0.6
    outer = outer_points(np.concatenate([shell, inside]))
    radius = np.linalg.norm(outer, axis=1)
    assert (radius > 0.99).sum() > 2900
    assert (radius < 0.7).sum() < 30


@pytest.mark.parametrize(
    "points",
    [
        np.c_[np.random.default_rng(0).random((200, 2)), np.zeros(200)],
        np.c_[np.linspace(0, 1, 50), np.zeros((50, 2))],
        np.zeros((30, 3)),
        np.zeros((2, 3)),
        np.zeros((0, 3)),
    ],
    ids=["coplanar", "line", "identical", "two", "none"],
)
def test_degenerate_sets_have_an_answer(points):
    assert len(outer_points(points)) <= len(points)
    assert hidden_point_removal(points, np.array([0.3, 0.3, 4.0])).shape == (len(points),)


def test_a_viewpoint_in_the_plane_of_the_points_or_on_one_of_them_is_safe():
    flat = np.c_[np.random.default_rng(0).random((200, 2)), np.zeros(200)]
    assert hidden_point_removal(flat, np.array([3.0, 0.5, 0.0])).any()
    assert hidden_point_removal(flat, flat[0]).any()


def test_many_points_are_thinned_by_a_seeded_draw():
    ball = _ball(5000)
    first, second = outer_points(ball, limit=1000, seed=3), outer_points(ball, limit=1000, seed=3)
    assert len(first) <= 1000
    assert np.array_equal(first, second)
