"""The toy gun: thin plastic in two shells around air, a helical steel spring, screws in bosses, a board with a cell."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.phantoms.toy_gun import hull, toy_gun
from insideout.core.phantoms.toy_gun_layout import AXIS_Z, GAP_MM, MUZZLE, SCREWS, WALL_MM


@pytest.fixture(scope="module")
def gun():
    return toy_gun()


@pytest.fixture(scope="module")
def parts(gun):
    return {part.name: part for part in gun.parts}


def scatter(low, high, count=40_000, seed=0):
    return np.random.default_rng(seed).uniform(low, high, (count, 3)).astype(np.float32)


def inside(part, points):
    return points[part.distance(points) < 0]


def test_shells_are_thin_plastic_around_air(gun, parts):
    assert 1.5 <= WALL_MM <= 2.0
    plastic = parts["left shell"].material.attenuation(gun.energy_kev)
    points = scatter((-60, -18, -45), (24, 18, 32), 120_000)
    wall = points[(hull().distance(points) < -0.8) & (hull().distance(points) > -WALL_MM + 0.05)]
    found = gun.attenuation(wall)
    at_rest = np.isclose(found, plastic, rtol=1e-4)
    assert at_rest.mean() > 0.93
    hollow = inside(parts["cavity"], points)
    assert np.mean(gun.attenuation(hollow) == 0) > 0.7
    assert np.all(gun.attenuation(scatter((22, -3, 11), (44, 3, 17), 2000)) == 0)
    assert np.all(gun.attenuation(np.float32([MUZZLE])) == 0)


def test_two_halves_meet_in_a_gap_of_air_at_the_middle(gun, parts):
    points = scatter((-60, -2, -45), (20, 2, 30))
    wall = points[(hull().distance(points) < -0.8) & (hull().distance(points) > -WALL_MM + 0.05)]
    left, right = parts["left shell"].distance(wall) < 0, parts["right shell"].distance(wall) < 0
    assert right.sum() > 200
    assert wall[right][:, 1].max() < -0.5 * GAP_MM + 1e-4
    # Fin, guard and sight belong to the left shell and reach over the middle; they touch few places of the wall.
    assert np.mean(wall[left][:, 1] > 0.5 * GAP_MM - 1e-4) > 0.8
    gap = wall[~left & ~right & (np.abs(wall[:, 1]) < 0.5 * GAP_MM)]
    assert np.mean(gun.attenuation(gap) == 0) > 0.8


def test_the_spring_is_steel_wire_of_1_mm_wound_into_a_helix(gun, parts):
    spring = parts["spring"]
    assert spring.material.formula == "Fe"
    points = inside(spring, scatter((-28, -6, AXIS_Z - 6), (9, 6, AXIS_Z + 6), 400_000))
    from_axis = np.hypot(points[:, 1], points[:, 2] - AXIS_Z)
    assert from_axis.min() > 3.6
    assert from_axis.max() < 4.8
    # Between its closed ends every turn lies one pitch further, wherever around the axis one looks.
    for angle in np.radians([0, 90, 200]):
        x = np.arange(-24.5, 5.0, 0.02)
        line = np.stack([x, np.full_like(x, 4.2 * np.cos(angle)), np.full_like(x, AXIS_Z + 4.2 * np.sin(angle))], 1)
        wire = spring.distance(line.astype(np.float32)) < 0
        starts, ends = x[1:][wire[1:] & ~wire[:-1]], x[1:][~wire[1:] & wire[:-1]]
        assert len(starts) >= 9
        np.testing.assert_allclose(np.diff(starts), np.diff(starts).mean(), atol=0.06)
        whole = min(len(starts), len(ends))
        first = 1 if ends[0] < starts[0] else 0
        widths = ends[first:whole] - starts[: whole - first]
        assert np.median(widths) == pytest.approx(1.0, abs=0.08)
    np.testing.assert_allclose(gun.attenuation(points), spring.material.attenuation(gun.energy_kev), rtol=1e-5)


def test_each_screw_sits_in_a_boss_and_its_head_is_seen_from_the_right(gun, parts):
    for screw in SCREWS:
        shaft = np.float32([[screw.x, screw.end_y - 0.5, screw.z]])
        assert parts["screws"].distance(shaft)[0] < 0
        around = shaft + np.float32([[1.8, -0.6, 0]])
        assert parts["bosses"].distance(around)[0] < 0
        y = np.arange(-30.0, 0.0, 0.02)
        line = np.stack([np.full_like(y, screw.x + 1.2), y, np.full_like(y, screw.z + 0.9)], 1).astype(np.float32)
        first = y[np.argmax(gun.surface(line) < 0)]
        metal = y[np.argmax(gun.attenuation(line) > 0.4)]
        assert first == pytest.approx(screw.head_y, abs=0.05)
        assert metal == pytest.approx(screw.head_y, abs=0.3)
        assert np.all(gun.attenuation(line[y < screw.head_y - 0.05]) == 0)


def test_all_metal_together_is_tiny_and_lies_inside(gun, parts):
    points = scatter((-60, -18, -45), (60, 18, 45), 300_000)
    metal = points[gun.attenuation(points) > 0.4]
    assert 50 < len(metal) < 0.01 * len(points)
    assert gun.surface(metal).max() < 0


@pytest.mark.parametrize("name", ["plunger", "spring", "lever", "board", "cell", "sound disc", "wires", "lamp"])
def test_what_lies_inside_stays_in_the_hollow(parts, name):
    points = scatter((-55, -16, -44), (20, 16, 32), 400_000, seed=3)
    found = inside(parts[name], points)
    assert len(found) > 3
    inner = parts["cavity"].distance(found)
    assert np.mean(inner < 0) > 0.99


def test_the_board_carries_a_cell_whose_filling_is_lighter_than_its_can(gun, parts):
    points = inside(parts["cell"], scatter((-45, 3, 9), (-28, 8, 23)))
    found = gun.attenuation(points)
    assert len(np.unique(np.round(found, 3))) == 2
    gap = parts["board"].distance(points).min()
    assert abs(gap) < 0.7


def test_colours_are_bright_and_differ_from_left_to_right(gun):
    side = scatter((-35, 0, 5), (0, 20, 25), 60_000)
    side = side[np.abs(gun.surface(side)) < 0.3]
    side = side[side[:, 1] > 5]
    normal = np.tile([0.0, 1.0, 0.0], (len(side), 1))
    left, right = gun.color(side, normal), gun.color(side * np.float32([1, -1, 1]), -normal)
    assert np.abs(left - right).mean() > 0.1
    assert np.ptp(left, axis=1).mean() > 0.5
