"""Pieces give distances one can march by, and looking only where they matter changes nothing."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.phantoms.sculpture import (
    Piece,
    add,
    box,
    carve,
    egg,
    limb,
    paired,
    plate,
    posed,
    rail,
    sculpt,
    turned,
)

PIECES = {
    "ellipsoid": egg((1, 2, -1), (6, 3, 2), turn=(10, 20, 30)),
    "egg": egg((0, 0, 0), (6, 3, 2), (3, 5, 4)),
    "boxy egg": egg((0, 1, 0), (6, 4, 5), power=4),
    "limb": limb([(-4, 0, 0), (2, 1, 0), (4, 4, 3)], (1.0, 2.0, 0.5)),
    "box": box((1, 0, 0), (4, 2, 1), turn=(0, 30, 10), rounding=0.5),
    "rail": rail([(-4, 0, 0), (0, 2, 1), (5, 0, 2)], 3.0, 1.0, 0.5),
    "plate": plate([(-3, -3), (4, -2), (1, 4)], lambda points: 1.0 + 0.1 * points[:, 2], 1.0, 0.3),
    "pair": paired(egg((5, 0, 0), (2, 2, 3))),
    "posed pair": posed(paired(egg((5, 1, 0), (2, 1, 3))), (20, 10, 40), (1, 0, 2)),
}


@pytest.fixture(scope="module")
def points():
    return np.random.default_rng(0).uniform(-12, 12, (30_000, 3)).astype(np.float32)


@pytest.mark.parametrize("name", PIECES)
def test_every_piece_lies_in_its_ball(name, points):
    piece = PIECES[name]
    centers = [piece.center, piece.center * [-1, 1, 1]] if piece.paired else [piece.center]
    away = np.min([np.linalg.norm(points - center, axis=1) for center in centers], axis=0) - piece.reach
    inside = piece.of(points) < 0
    assert inside.any()
    assert away[inside].max() < 1e-4


@pytest.mark.parametrize("name", PIECES)
def test_no_piece_says_more_than_the_way_to_its_surface(name, points):
    """Walking by 0.8 of a distance, as rays do, never gets past the surface in any direction."""
    piece = PIECES[name]
    found = piece.of(points)
    rng = np.random.default_rng(1)
    for _ in range(8):
        step = rng.standard_normal(points.shape)
        step *= 0.8 * np.abs(found)[:, None] / np.linalg.norm(step, axis=1, keepdims=True)
        there = piece.of((points + step).astype(np.float32))
        crossed = ((there < 0) != (found < 0)) & (np.abs(found) > 1e-3)
        assert not crossed.any()


@pytest.mark.parametrize("name", PIECES)
def test_distance_rises_by_one_a_millimetre_at_the_surface(name):
    piece = PIECES[name]
    points = np.random.default_rng(2).uniform(-9, 9, (200_000, 3)).astype(np.float32)
    points = points[np.abs(piece.of(points)) < 0.02]
    steps = 0.01 * np.eye(3, dtype=np.float32)
    slope = np.stack([piece.of(points + step) - piece.of(points - step) for step in steps]) / 0.02
    assert len(points) > 100
    assert np.median(np.linalg.norm(slope, axis=0)) == pytest.approx(1.0, abs=0.06)


def test_looking_only_near_each_piece_changes_nothing(points):
    steps = (
        add(PIECES["boxy egg"], 1.0),
        add(PIECES["limb"], 2.0),
        carve(PIECES["box"], 0.8),
        add(PIECES["pair"]),
        carve(egg((-5, 0, 1), (2, 2, 2))),
    )
    everywhere = tuple(
        type(step)(Piece(step.piece.distance, step.piece.center, 1e4, step.piece.paired), step.blend, step.carved)
        for step in steps
    )
    for start in (None, np.linalg.norm(points - [3, 3, 3], axis=1) - 4):
        found, whole = sculpt(points, steps, start), sculpt(points, everywhere, start)
        np.testing.assert_array_equal(found < 0, whole < 0)
        close = np.abs(whole) < 1.0
        np.testing.assert_allclose(found[close], whole[close], atol=1e-5)


def test_carving_takes_away_and_adding_joins():
    ball, bite = egg((0, 0, 0), (3, 3, 3)), egg((3, 0, 0), (1, 1, 1))
    spots = np.array([[2.5, 0, 0], [0, 0, 0], [3.5, 0, 0]], np.float32)
    assert (sculpt(spots, (add(ball), carve(bite))) < 0).tolist() == [False, True, False]
    assert (sculpt(spots, (add(ball), add(bite))) < 0).tolist() == [True, True, True]


def test_carving_starts_from_what_is_given():
    spots = np.zeros((1, 3), np.float32)
    assert sculpt(spots, (carve(egg((0, 0, 0), (1, 1, 1))),), np.array([-5.0]))[0] == pytest.approx(1.0)


def test_ball_box_and_tapering_limb_are_exact():
    spots = np.array([[5, 0, 0], [0, 4, 3], [1, 0, 0]], np.float32)
    np.testing.assert_allclose(egg((0, 0, 0), (2, 2, 2)).of(spots), [3, 3, -1], atol=1e-5)
    np.testing.assert_allclose(box((0, 0, 0), (2, 2, 2)).of(spots), [3, np.hypot(2, 1), -1], atol=1e-5)
    np.testing.assert_allclose(limb([(0, 0, 0), (4, 0, 0)], (1, 2)).of(spots), [-1, 4, -1.25], atol=1e-5)


def test_turning_is_about_the_fixed_axes():
    np.testing.assert_allclose(turned((0, 0, 90))[0], [0, 1, 0], atol=1e-6)
    tall = egg((0, 0, 0), (3, 1, 1), turn=(0, 0, 90))
    assert tall.of(np.array([[0, 2.5, 0]], np.float32))[0] < 0 < tall.of(np.array([[2.5, 0, 0]], np.float32))[0]


def test_posing_turns_the_pair_about_the_pivot():
    pair = posed(paired(egg((4, 0, 0), (1, 1, 1))), (0, 0, 90), (0, 1, 0))
    spots = np.array([[1, 5, 0], [1, -3, 0], [4, 0, 0]], np.float32)
    assert (pair.of(spots) < 0).tolist() == [True, True, False]
