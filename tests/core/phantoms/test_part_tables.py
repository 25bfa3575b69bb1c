"""Path lengths through parts that replace one another, and voxel means, as geometry has them."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.phantoms.materials import Material
from insideout.core.phantoms.model import Part, Phantom
from insideout.core.phantoms.part_tables import PartTables
from insideout.core.phantoms.shapes import sphere, tube

WOOD, STEEL = Material("wood", "C6H10O5", 0.7), Material("steel", "Fe", 7.8)
CENTER = np.array([2.0, -1.0, 3.0])


def ball(radius, center=CENTER):
    return lambda points: sphere(points, center, radius)


def slab(thickness, z):
    return lambda points: np.maximum(np.abs(points[:, 2] - z) - thickness / 2, ball(12.0)(points))


def phantom(*parts, size=(32.0, 32.0, 34.0)):
    return Phantom("test", parts, parts[0].distance, lambda p, n: p, size, 50.0)


@pytest.fixture(scope="module")
def rays():
    rng = np.random.default_rng(2)
    origins = rng.uniform([70, -10, -10], [90, 10, 10], (3000, 3))
    directions = rng.uniform(-12, 12, (3000, 3)) - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def chord(origins, directions, radius, center=CENTER):
    toward = center - origins
    along = (toward * directions).sum(axis=1)
    return 2 * np.sqrt(np.maximum(radius**2 - ((toward**2).sum(axis=1) - along**2), 0))


def marched(made, origins, directions, step=0.01):
    reach = 80 + np.arange(-30, 30, step)
    rays = zip(origins, directions, strict=True)
    return np.array([step * made.attenuation(origin + reach[:, None] * way).sum() for origin, way in rays])


def test_chords_of_a_ball(rays):
    tables = PartTables.bake(phantom(Part("ball", ball(12.0), WOOD)), 0.5)

    error = tables.lengths(*rays)[0] - chord(*rays, 12.0)

    # A chord shorter than a step can be missed; it is rare, since only grazing rays have one.
    assert np.abs(error[chord(*rays, 12.0) > 12]).max() < 0.02
    assert np.abs(error).mean() < 0.02


def test_a_later_part_takes_the_place_of_an_earlier_one(rays):
    outer, hole, core = chord(*rays, 12.0), chord(*rays, 10.0), chord(*rays, 4.0)
    made = phantom(Part("ball", ball(12.0), WOOD), Part("hole", ball(10.0), None), Part("core", ball(4.0), STEEL))

    lengths = PartTables.bake(made, 0.4).lengths(*rays)

    for found, exact in ((lengths[0], outer - hole), (lengths[1], core)):
        assert np.abs(found - exact).mean() < 0.01
        assert np.quantile(np.abs(found - exact), 0.99) < 0.1


def test_order_decides_and_an_earlier_part_inside_a_later_one_is_gone(rays):
    made = phantom(Part("core", ball(4.0), STEEL), Part("ball", ball(12.0), WOOD))

    tables = PartTables.bake(made, 0.4)
    wood = tables.lengths(*rays)[tables.materials.index(WOOD)]

    assert not tables.lengths(*rays)[tables.materials.index(STEEL)].any()
    assert np.abs(wood - chord(*rays, 12.0)).mean() < 0.02


def test_parts_that_overlap_partly_agree_with_marching(rays):
    made = phantom(
        Part("ball", ball(12.0), WOOD),
        Part("left", ball(6.0, CENTER + np.array([3, 4, 0])), STEEL),
        Part("right", ball(6.0, CENTER + np.array([0, -2, 1])), None),
        Part("wire", lambda p: tube(p, CENTER + np.array([[-8, 0, 0], [0, 3, 3], [7, -4, 1]], float), 0.5), STEEL),
        Part("crack", slab(0.5, 4.0), None),
    )
    some = tuple(part[::20] for part in rays)

    tables = PartTables.bake(made, 0.4)
    mu = np.array([material.attenuation(50.0) for material in tables.materials])
    error = np.abs(mu @ tables.lengths(*some) - marched(made, *some))

    assert np.median(error) < 0.02 * mu.max()
    assert np.quantile(error, 0.97) < 0.15 * mu.max()


def test_a_thin_wire_and_a_thin_crack_are_met_by_every_ray_that_meets_them():
    wire = np.array([[0, 0, -9], [0.3, 0.2, 9]], float)
    made = phantom(
        Part("ball", ball(12.0, np.zeros(3)), WOOD),
        Part("crack", lambda p: np.abs(p[:, 2] - 0.13) - np.float32(0.25), None),
        Part("wire", lambda p: tube(p, wire, 0.5), STEEL),
        size=(26.0, 26.0, 26.0),
    )
    tables = PartTables.bake(made, 0.4)
    height = np.random.default_rng(0).uniform(-8, 8, 2000)
    origins = np.stack([np.full(2000, 50.0), np.interp(height, [-9, 9], [0, 0.2]), height], axis=1)
    across = np.tile([-1.0, 0.0, 0.0], (2000, 1))
    steel = tables.lengths(origins, across)[tables.materials.index(STEEL)]
    np.testing.assert_allclose(steel, 1.0, atol=0.02)

    columns = np.random.default_rng(1).uniform(-5, 5, (2000, 2))
    columns = columns[np.linalg.norm(columns, axis=1) > 1.5]
    down = np.tile([0.0, 0.0, -1.0], (len(columns), 1))
    wood = tables.lengths(np.column_stack([columns, np.full(len(columns), 40.0)]), down)[0]
    exact = 2 * np.sqrt(144 - (columns**2).sum(axis=1)) - 0.5
    np.testing.assert_allclose(wood, exact, atol=0.02)


def test_a_thin_thing_on_a_thick_one_is_found_when_it_is_said():
    hair = np.array([[0, 0, 0], [0, 0, 14.0]])

    def pin(points):
        return np.minimum(ball(5.0, np.zeros(3))(points), tube(points, hair, 0.15))

    across = np.array([[-1.0, 0.0, 0.0]])
    found = {}
    for said in (None, 0.3):
        made = phantom(Part("pin", pin, STEEL, thinnest_mm=said), size=(12.0, 12.0, 30.0))
        tables = PartTables.bake(made, 0.4)
        heights = np.linspace(7, 13, 300)
        origins = np.stack([np.full(300, 40.0), np.full(300, 0.03), heights], axis=1)
        found[said] = tables.lengths(origins, np.tile(across, (300, 1)))[0]
    exact = 2 * np.sqrt(0.15**2 - 0.03**2)
    np.testing.assert_allclose(found[0.3], exact, rtol=0.03)
    assert np.abs(found[None] - exact).min() > 0.1 * exact


def test_many_crossings_are_all_counted():
    balls = [Part(f"bead {i}", ball(1.0, np.array([2.5 * i - 60, 0.0, 0.0])), STEEL) for i in range(49)]
    tables = PartTables.bake(phantom(*balls, size=(126.0, 4.0, 4.0)), 0.4)

    (length,) = tables.lengths(np.array([[90.0, 0, 0]]), np.array([[-1.0, 0, 0]]))[0]

    # One bead is 2 mm; each comes out smaller by 1 %.
    assert length == pytest.approx(98.0, abs=1.5)


def test_voxel_means_are_those_of_many_samples():
    made = phantom(Part("ball", ball(12.0), WOOD), Part("hole", ball(10.0), None), Part("crack", slab(0.5, 3.2), STEEL))
    tables = PartTables.bake(made, 0.4)
    mu = np.array([material.attenuation(50.0) for material in tables.materials])
    rng = np.random.default_rng(4)
    points = rng.uniform(-11, 15, (300, 3))

    found = tables.voxel_means(points, 0.75, mu)

    around = points[:, None] + rng.uniform(-0.375, 0.375, (300, 2000, 3))
    exact = made.attenuation(around).mean(axis=1)
    assert np.abs(found - exact).mean() < 0.01 * mu.max()
    assert np.abs(found - exact).max() < 0.12 * mu.max()
    assert found.max() > 0.3 * mu.max()
