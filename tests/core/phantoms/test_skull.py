"""The skull is what it says: hollow, spongy between tables, toothed, and carried by a metal rod."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.ndimage import label

from insideout.core.phantoms import skull as module
from insideout.core.phantoms.skull import skull


@pytest.fixture(scope="module")
def phantom():
    return skull()


@pytest.fixture(scope="module")
def parts(phantom):
    return {part.name: part for part in phantom.parts}


def line(start, end, count=2000):
    return (np.linspace(0, 1, count)[:, None] * (np.array(end) - start) + start).astype(np.float32)


def layer(z, spacing=0.1, half=(20.0, 24.0), middle=(0.0, -26.0)):
    x = np.arange(-half[0], half[0], spacing)
    y = np.arange(-half[1], half[1], spacing) + middle[1]
    grid = np.stack(np.broadcast_arrays(x[None, :], y[:, None], z), axis=-1)
    return grid.reshape(-1, 3).astype(np.float32), grid.shape[:2]


def runs(values):
    """The values along a line, each stretch of equal ones once."""
    return [float(values[0])] + [float(b) for a, b in pairwise(values) if a != b]


def attenuation_of(phantom, parts, name):
    return pytest.approx(parts[name].material.attenuation(phantom.energy_kev), rel=1e-5)


def test_it_is_about_ten_centimetres_tall(phantom):
    column = line([0.4, -2.0, -52], [0.4, -2.0, 52], 4000)
    inside = column[phantom.surface(column) < 0][:, 2]
    assert 90 < np.ptp(inside) <= 100


@pytest.mark.parametrize("away", [[0, 0, 1], [0.3, 0.5, 0.8], [-0.5, 0.6, 0.6], [0, 0.9, 0.45], [0.7, 0.2, 0.6]])
def test_vault_is_spongy_between_two_tables_around_air(phantom, parts, away):
    away = np.array(away) / np.linalg.norm(away)
    spots = line([0, 4, 20], np.array([0, 4, 20]) + 50 * away, 5000)
    values = phantom.attenuation(spots)
    bone, spongy = (attenuation_of(phantom, parts, name) for name in ("cranium", "diploe"))

    assert runs(values) == [0.0, bone, spongy, bone, 0.0]
    wall = 0.01 * np.count_nonzero(values)
    assert 2.0 < wall < 4.5
    for table in np.flatnonzero(np.diff(values))[[0, 2]]:
        assert 0.5 < 0.01 * np.argmax(values[table + 1 :] != values[table + 1]) < 1.6


def test_every_wall_of_the_braincase_is_bone(phantom, parts):
    """Looking out from the braincase one meets bone or metal everywhere but in its holes."""
    rng = np.random.default_rng(0)
    away = rng.standard_normal((600, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    reach = np.arange(0, 55, 0.15)
    spots = np.array([0, 6, 20]) + reach[None, :, None] * away[:, None]
    values = phantom.attenuation(spots.astype(np.float32))
    thickness = 0.15 * np.count_nonzero(values, axis=1)

    assert np.mean(thickness > 1.0) > 0.97
    assert phantom.attenuation(np.array([[0.0, 6.0, 20.0]]))[0] == 0


def test_rod_is_metal_of_four_millimetres_all_the_way_into_the_skull_base(phantom, parts):
    steel = parts["rod"].material.attenuation(phantom.energy_kev)
    along = phantom.attenuation(line([0.4, -2.0, -48.5], [0.4, -2.0, 2.0]))
    np.testing.assert_allclose(along, steel, rtol=1e-5)
    for z in (-40, -33.5, -20, -8):
        across = phantom.attenuation(line([-6, -2.0, z], [6, -2.0, z], 2401))
        assert 0.005 * np.count_nonzero(np.isclose(across, steel)) == pytest.approx(4.0, abs=0.05)
    above = phantom.attenuation(line([0.4, -2.0, 3.0], [0.4, -2.0, 5.0]))
    np.testing.assert_allclose(above, parts["cranium"].material.attenuation(phantom.energy_kev), rtol=1e-5)


def test_metal_stands_out_from_bone(phantom, parts):
    rod, bone = (parts[name].material.attenuation(phantom.energy_kev) for name in ("rod", "cranium"))
    plate = parts["plate and screws"].material.attenuation(phantom.energy_kev)
    assert rod > 10 * bone
    assert plate > 3.5 * bone


def test_canal_leads_from_the_braincase_down_through_the_column(phantom):
    assert not phantom.attenuation(line([0, 8.0, 15], [0, 7.5, -48])).any()


@pytest.mark.parametrize(("z", "count"), [(-13.5, 15), (-18.6, 15), (-22.4, 16), (-27.0, 16)])
def test_teeth_are_single_crowns_and_roots_and_one_is_lost(parts, z, count):
    spots, shape = layer(z)
    _, found = label((parts["teeth"].distance(spots) < 0).reshape(shape))
    assert found == count


def test_front_teeth_bite_edge_to_edge_without_joining(parts):
    spots, _ = layer(-20.55, 0.2)
    front = spots[np.abs(spots[:, 0]) < 6]
    assert parts["teeth"].distance(front).min() > 0
    for height in (-0.6, 0.6):
        assert parts["teeth"].distance(front + np.float32([0, 0, height])).min() < 0


def test_lost_tooth_is_on_his_left(parts):
    spots, _ = layer(-18.4, 0.2)
    filled = spots[parts["teeth"].distance(spots) < 0]
    left, right = np.sum(filled[:, 0] > 0), np.sum(filled[:, 0] < 0)
    assert 0.85 < left / right < 0.97


def test_orbits_and_nose_are_open_to_the_front(phantom):
    for x, z in ((13, 6.5), (-13, 6.5), (2.4, -4.5), (-2.4, -4.5)):
        values = phantom.attenuation(line([x, -44, z], [0.8 * x, -24, z]))
        assert not values.any()


def test_orbits_do_not_open_into_the_braincase(phantom):
    for side in (-1, 1):
        values = phantom.attenuation(line([side * 12.8, -30, 7], [side * 11, -18, 26]))
        assert values.any()


def test_cheekbones_are_arches_with_room_behind_them(phantom):
    for side in (-1, 1):
        values = phantom.attenuation(line([side * 31, -11, -2.4], [side * 15, -11, -2.4], 3200))
        assert runs(values)[:3] == [0.0, runs(values)[1], 0.0]
        assert 2.0 < 0.005 * np.argmin(values[np.argmax(values > 0) :]) < 4.5


def test_sinuses_are_air_enclosed_in_bone(phantom, parts):
    rng = np.random.default_rng(8)
    spots = rng.uniform([-18, -38, -14], [18, -5, 22], (60_000, 3)).astype(np.float32)
    inside = spots[parts["sinuses"].distance(spots) < 0]

    assert not phantom.attenuation(inside).any()
    assert parts["cranium"].distance(inside).max() < -0.3
    assert parts["braincase"].distance(inside).min() > 0.3
    for spot in ([11.6, -25, -6.2], [-11.6, -25, -6.2], [0.8, -12.5, 1.8], [3.6, -35.2, 15.6], [0, -26, 9]):
        assert np.linalg.norm(inside - spot, axis=1).min() < 1


def test_plate_bridges_the_burr_hole(phantom, parts):
    titanium = parts["plate and screws"].material.attenuation(phantom.energy_kev)
    through = line([-13.65 + 5.8, -14.63 + 2.5, 40.68 - 7.7], [-13.65 - 3.5, -14.63 - 1.5, 40.68 + 4.6])
    assert [value for value in runs(phantom.attenuation(through)) if value] == [pytest.approx(titanium, rel=1e-5)]
    assert module.plate(np.array([[13.65, -14.63, 40.68]], np.float32))[0] > 5


def test_each_bone_has_its_own_pastel_and_sutures_are_dark(phantom):
    spots = np.array(
        [
            [0, -36, 26],
            [18, 6, 44],
            [-18, 6, 44],
            [0, 40, 12],
            [28, 3, 8],
            [0, -40, -12],
            [0, -38, -33],
            [1.7, -39.6, -18.4],
        ]
    )
    colors = phantom.color(spots.astype(np.float32), np.zeros_like(spots))
    apart = np.linalg.norm(colors[:, None] - colors[None], axis=-1) + np.eye(len(spots))
    assert apart.min() > 0.06
    across = line([-6, 12, 48.2], [6, 12, 48.2], 600)
    brightness = phantom.color(across, across).mean(axis=1)
    assert brightness.min() < 0.5 * np.median(brightness)
    assert np.mean(brightness < 0.5 * np.median(brightness)) < 0.15
