"""The coffin: walls of wood, a joint with dowels, and in it a wrapped body with bones, resin and an amulet."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from insideout.core.phantoms.glyphs import write
from insideout.core.phantoms.pharaoh import JOINT_Y, hull, pharaoh


@pytest.fixture(scope="module")
def coffin():
    return pharaoh()


@pytest.fixture(scope="module")
def parts(coffin):
    return {part.name: part for part in coffin.parts}


@pytest.fixture(scope="module")
def points(coffin):
    half = 0.5 * np.array(coffin.size_mm)
    return np.random.default_rng(0).uniform(-half, half, (120_000, 3)).astype(np.float32)


def inside(part, points):
    return points[part.distance(points) < 0]


def test_it_stands_on_its_foot_end_120_mm_tall(coffin):
    z = np.arange(-64, 64, 0.05)
    axis = np.stack([np.zeros_like(z), np.full_like(z, 4.2), z], axis=1).astype(np.float32)
    solid = z[coffin.surface(axis) < 0]
    assert solid.min() == pytest.approx(-60, abs=0.3)
    assert 119 < np.ptp(solid) < 122.5


def test_walls_are_of_wood_and_4_to_6_mm_thick(coffin, parts):
    rng = np.random.default_rng(1)
    skin = rng.uniform([-25, -24, -50], [25, 22, 60], (60_000, 3)).astype(np.float32)
    skin = skin[np.abs(hull().distance(skin)) < 0.05]
    wall = skin[(np.abs(skin[:, 1] - JOINT_Y) > 6) & (np.abs(skin[:, 0]) > 2)]
    step = 0.05
    normal = np.stack([hull().distance(wall + step * e) for e in np.eye(3, dtype="f4")], axis=1)
    normal -= hull().distance(wall)[:, None]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    depths = np.arange(0, 9, 0.05)
    inward = wall[:, None] - depths[:, None] * normal[:, None].astype(np.float32)
    hollow = parts["cavity"].distance(inward.reshape(-1, 3).astype(np.float32)).reshape(len(wall), -1) < 0
    thickness = depths[np.argmax(hollow, axis=1)][hollow.any(axis=1)]
    assert len(thickness) > 100
    assert np.quantile(thickness, [0.05, 0.5]) == pytest.approx([4.5, 4.5], abs=0.4)
    for name in ("lid", "trough", "dowels"):
        assert parts[name].material.formula == "C6H10O5"


def test_lid_and_trough_meet_in_a_joint_of_air_that_dowels_cross(coffin, parts):
    lid, trough, dowels = (parts[name] for name in ("lid", "trough", "dowels"))
    rng = np.random.default_rng(2)
    near = rng.uniform([-24, JOINT_Y - 3, -58], [24, JOINT_Y + 3, 58], (200_000, 3)).astype(np.float32)
    assert inside(lid, near)[:, 1].max() <= JOINT_Y
    assert inside(trough, near)[:, 1].min() >= JOINT_Y
    wall = near[(np.abs(hull().distance(near) + 2.2) < 1.5) & (np.abs(near[:, 1] - JOINT_Y) < 0.2)]
    pegged = dowels.distance(wall) < 0
    assert 0.005 < pegged.mean() < 0.2
    assert np.all(coffin.attenuation(wall[~pegged]) == 0)
    assert np.all(coffin.attenuation(wall[pegged]) > 0)
    heights = np.unique(np.round(wall[pegged][:, 2] / 8))
    assert len(heights) >= 4


def test_the_body_lies_in_the_coffin_with_air_around_it(coffin, parts, points):
    body = inside(parts["linen"], points)
    assert len(body) > 3000
    assert parts["cavity"].distance(body).max() < 0
    ring = points[(parts["cavity"].distance(points) < 0) & (parts["linen"].distance(points) > 0)]
    assert np.all(coffin.attenuation(ring) == 0)
    assert len(ring) > 0.3 * len(body)


def test_wrappings_lie_in_layers_around_the_body(parts, points):
    names = ("linen", "loose linen", "soaked linen", "body")
    sets = [parts[name].distance(points) < 0 for name in names]
    for outer, inner in pairwise(sets):
        assert np.all(outer[inner])
        assert outer.sum() > 1.1 * inner.sum()
    loose, soaked = parts["loose linen"].material, parts["soaked linen"].material
    assert loose.density_g_cm3 < parts["linen"].material.density_g_cm3 < soaked.density_g_cm3


def test_the_spine_has_separate_vertebrae(parts):
    z = np.arange(0.0, 36.0, 0.1)
    y = np.arange(5.0, 10.0, 0.2)
    column = np.stack(np.broadcast_arrays(0.0, y[None], z[:, None]), axis=-1).reshape(-1, 3).astype(np.float32)
    bone = (parts["bones"].distance(column) < 0).reshape(len(z), len(y)).mean(axis=1) > 0.3
    assert np.sum(bone[1:] & ~bone[:-1]) >= 14


def test_bones_are_within_the_wrappings_and_there_are_two_legs_and_a_skull(parts, points):
    bones = inside(parts["bones"], points)
    assert parts["soaked linen"].distance(bones).max() < 0
    thighs = bones[np.abs(bones[:, 2] + 15) < 8]
    assert np.sum(thighs[:, 0] > 2) > 10
    assert np.sum(thighs[:, 0] < -2) > 10
    assert np.abs(thighs[:, 0]).min() > 2
    assert parts["bones"].distance(np.float32([[0.3, 5.2, 50.0]]))[0] < 0


def test_the_skull_holds_air_and_a_pool_of_resin_with_a_level_surface(coffin, parts):
    rng = np.random.default_rng(4)
    brain = rng.uniform([-5, 0, 40], [5, 11, 51], (20_000, 3)).astype(np.float32)
    brain = brain[parts["brain cavity"].distance(brain) < 0]
    resin = parts["resin"].distance(brain) < 0
    assert 0.1 < resin.mean() < 0.5
    assert np.all(coffin.attenuation(brain[~resin]) == 0)
    assert brain[resin][:, 1].mean() > brain[~resin][:, 1].mean() + 2


def test_the_amulet_is_the_densest_and_lies_on_the_chest(coffin, parts):
    energy = coffin.energy_kev
    values = {name: part.material.attenuation(energy) for name, part in parts.items() if part.material}
    assert max(values, key=values.get) == "amulet"
    chest = np.random.default_rng(5).uniform([-8, -8, 8], [8, 2, 28], (40_000, 3)).astype(np.float32)
    amulet = inside(parts["amulet"], chest)
    assert len(amulet) > 50
    assert np.all(parts["linen"].distance(amulet) < 0)
    np.testing.assert_allclose(coffin.attenuation(amulet), values["amulet"], rtol=1e-5)


def test_headdress_is_striped_and_the_left_differs_from_the_right(coffin):
    z = np.linspace(34, 56, 400)
    line = np.stack([np.full(400, 13.0), np.full(400, 8.0), z], axis=1).astype(np.float32)
    colors = coffin.color(line, np.tile([1.0, 0, 0], (400, 1)))
    blue = colors[:, 2] > colors[:, 0]
    assert np.sum(blue[1:] != blue[:-1]) >= 8
    front = np.random.default_rng(6).uniform([2, -20, 0], [20, 0, 34], (20_000, 3)).astype(np.float32)
    solid = coffin.surface(front) < 0
    other = coffin.surface(front * np.float32([-1, 1, 1])) < 0
    assert np.mean(solid != other) > 0.02


def test_signs_differ_along_a_band_and_leave_ground_between_them():
    u, v = (grid.ravel() for grid in np.meshgrid(np.linspace(-1, 1, 40), np.linspace(0, 12, 480)))
    ink = write(u, v, 1).reshape(12, 40, 40)
    assert np.all((ink.mean(axis=(1, 2)) > 0.05) & (ink.mean(axis=(1, 2)) < 0.6))
    assert len({sign.tobytes() for sign in ink}) >= 4
    assert not np.array_equal(ink.ravel(), write(u, v, 2))
