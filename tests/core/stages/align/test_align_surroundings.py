"""Objects in front of a background that is not plain: the room and the table are told from what stands on it."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.gaussians import GaussianSet
from insideout.core.stages.align.global_fit import fit_globally
from insideout.core.stages.align.surfaces import shell_points
from insideout.core.stages.align.surroundings import on_the_object
from insideout.core.views import Camera


def looking_at(target, center):
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ center
    return Camera(100, 100, 100.0, 100.0, 50.0, 50.0, pose)


def cameras(distance=200.0, heights=(0.3, 0.6)):
    """All around, looking at the origin; half of a view is 100 mm wide there."""
    turns = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    return [
        looking_at(np.zeros(3), distance * np.array([np.cos(a) * np.cos(up), np.sin(a) * np.cos(up), np.sin(up)]))
        for up in heights
        for a in turns
    ]


@pytest.fixture
def scene(bodies):
    """A lump on a table in a room, splats in mm: (object's, table's, walls')."""
    rng = np.random.default_rng(0)
    rgb, truth = bodies.shell(bodies.lump, 3)
    lump = truth.apply(rgb.means.astype(np.float64))
    lowest = lump[:, 2].min()
    turn, far = rng.uniform(0, 2 * np.pi, 6000), 140 * np.sqrt(rng.random(6000))
    table = np.c_[far * np.cos(turn), far * np.sin(turn), lowest + rng.normal(0, 0.4, 6000)]
    walls = rng.normal(size=(3000, 3))
    walls[:, 2] = np.abs(walls[:, 2])
    walls *= 600 / np.linalg.norm(walls, axis=1, keepdims=True)
    return lump, table, walls


def test_the_room_and_the_table_are_left_out_and_the_object_stays(scene):
    lump, table, _ = scene
    kept = on_the_object(np.concatenate(scene), cameras())
    assert kept[: len(lump)].mean() > 0.9
    assert kept[len(lump) : len(lump) + len(table)].mean() < 0.01
    assert not kept[len(lump) + len(table) :].any()


def test_a_rough_table_and_floaters_over_it_are_told_all_the_same(scene):
    lump, table, _ = scene
    rng = np.random.default_rng(2)
    rough = table + rng.normal(0, 0.8, table.shape)
    floaters = rng.uniform([-60, -60, 0], [60, 60, 120], (30, 3))
    kept = on_the_object(np.concatenate([lump, rough, floaters]), cameras())
    assert kept[: len(lump)].mean() > 0.9
    assert kept[len(lump) : len(lump) + len(table)].mean() < 0.05


def test_a_table_of_few_splats_is_found(scene):
    """An even colour needs few of them."""
    lump, table, _ = scene
    few = table[:2000]
    kept = on_the_object(np.concatenate([lump, few]), cameras())
    assert kept[: len(lump)].mean() > 0.9
    assert kept[len(lump) :].mean() < 0.05


def test_photos_taken_in_passing_keep_everything(scene):
    """Their axes meet nowhere, or anywhere: the ball that they look at is a guess."""
    lump, _, _ = scene
    rail = [looking_at(np.array([x, 300.0, 0.0]), np.array([x, 200.0, 0.0])) for x in np.linspace(-50, 50, 8)]
    assert on_the_object(lump, rail).all()


def test_the_alignment_finds_an_object_on_a_table(scene, bodies, lump_surface):
    rgb, truth = bodies.shell(bodies.lump, 3)
    whole = GaussianSet.create(truth.inverse().apply(np.concatenate(scene)), 0.5 / truth.scale, opacities=0.8)
    views = [(camera.transformed(truth.inverse()), None) for camera in cameras()]
    fit = fit_globally(shell_points(whole, views), lump_surface, rotations=24)
    assert bodies.errors(fit.best.similarity, truth, rgb.means).on_target


def box_splats(high=30.0):
    """The faces of a box of 60 x 60 x `high` mm, its underside too."""
    rng = np.random.default_rng(1)
    points = rng.uniform(-1, 1, (6000, 3)) * [30, 30, high / 2]
    axis = rng.integers(0, 3, 6000)
    points[np.arange(6000), axis] = np.sign(points[np.arange(6000), axis]) * np.array([30, 30, high / 2])[axis]
    return points


@pytest.mark.parametrize("heights", [(0.3, 0.6), (-0.6, 0.6), (-0.3, -0.6)])
def test_a_box_keeps_its_flat_faces(heights):
    """Without a table: its top is flat and half of what is seen, and so is its underside."""
    assert on_the_object(box_splats(), cameras(heights=heights)).all()


def test_a_box_whose_underside_is_seen_from_above_alone_keeps_its_walls():
    """As wide as the box, the underside is no table."""
    kept = on_the_object(box_splats(), cameras(heights=(0.4, 0.8)))
    assert kept.all()


def test_a_thin_plate_is_no_table():
    assert on_the_object(box_splats(high=1.0), cameras()).all()


def test_too_few_points_are_left_alone():
    assert on_the_object(np.zeros((10, 3)), cameras()).all()
