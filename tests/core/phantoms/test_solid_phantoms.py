"""What holds for the coffin and the toy gun alike: distances that rays may step by, a box, landmarks, colours."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from insideout.core.phantoms.distance_grid import DistanceGrid
from insideout.core.phantoms.pharaoh import pharaoh
from insideout.core.phantoms.toy_gun import toy_gun


@pytest.fixture(scope="module", params=[pharaoh, toy_gun], ids=["pharaoh", "toy_gun"])
def phantom(request):
    return request.param()


@pytest.fixture(scope="module")
def points(phantom):
    half = 0.5 * np.array(phantom.size_mm)
    return np.random.default_rng(0).uniform(-half, half, (40_000, 3)).astype(np.float32)


@pytest.fixture(scope="module")
def rays(phantom):
    """300 rays from outside the box to random points in it: origins and unit directions."""
    rng = np.random.default_rng(2)
    half = 0.5 * np.array(phantom.size_mm)
    directions = rng.standard_normal((300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    targets = rng.uniform(-0.8 * half, 0.8 * half, (300, 3))
    return targets - 150.0 * directions, directions


@pytest.fixture(scope="module")
def fine_march(phantom, rays):
    """(300, K) distances every 0.15 mm along the rays, and how far along each is."""
    along = np.arange(60.0, 240.0, 0.15)
    line = rays[0][:, None] + along[:, None] * rays[1][:, None]
    close = np.all(np.abs(line) < 0.5 * np.array(phantom.size_mm), axis=-1)
    values = np.full(close.shape, 9.0, np.float32)
    values[close] = phantom.surface(line[close].astype(np.float32))
    return along, values


def test_no_part_reaches_out_of_the_box(phantom):
    half = 0.5 * np.array(phantom.size_mm)
    rng = np.random.default_rng(1)
    for axis in range(3):
        for side in (-1, 1):
            face = rng.uniform(-half, half, (3000, 3))
            face[:, axis] = side * half[axis]
            face = face.astype(np.float32)
            assert phantom.surface(face).min() > 0
            for part in phantom.parts:
                if part.material is not None:
                    assert part.distance(face).min() > 0, part.name


def test_landmarks_lie_on_the_surface_and_apart(phantom):
    assert 5 <= len(phantom.landmarks) <= 8
    assert np.abs(phantom.surface(phantom.landmarks.astype(np.float32))).max() < 0.05
    gaps = np.linalg.norm(phantom.landmarks[:, None] - phantom.landmarks[None], axis=-1)
    assert gaps[np.triu_indices(len(gaps), 1)].min() > 4


def test_solids_of_matter_lie_within_what_photos_show(phantom, points):
    matter = points[phantom.attenuation(points) > 0]
    assert len(matter) > 1000
    assert phantom.surface(matter).max() < 0.05


def test_no_distance_is_larger_than_the_way_to_the_surface(phantom, points):
    rng = np.random.default_rng(3)
    for part in phantom.parts:
        distance = part.distance(points)
        close = points[distance < np.sort(distance)[400]]
        samples = np.concatenate([points, *(close + rng.normal(0, s, close.shape) for s in (0.3, 1.0, 3.0, 8.0))])
        samples = samples.astype(np.float32)
        value = part.distance(samples)
        inside = value < 0
        assert inside.any(), part.name
        for here, there in ((~inside, inside), (inside, ~inside)):
            way, _ = cKDTree(samples[there]).query(samples[here])
            assert np.all(np.abs(value[here]) < 1.2 * way + 0.1), part.name


def test_stepping_by_the_distance_never_jumps_through_the_surface(phantom, rays, fine_march):
    along, values = fine_march
    hit = values.min(axis=1) < -0.1
    assert 60 < hit.sum() < 300
    latest = along[np.argmax(values < -0.1, axis=1)]
    s = np.full(300, 60.0)
    for _ in range(400):
        at = (rays[0] + s[:, None] * rays[1]).astype(np.float32)
        value = phantom.surface(at)
        s += np.where(value > 0, np.maximum(0.8 * value, 0.02), 0.0)
    assert np.all(s[hit] < latest[hit] + 0.05)


def test_baked_distances_find_the_same_first_hits(phantom, rays, fine_march):
    along, values = fine_march
    grid = DistanceGrid.bake(phantom.surface, np.array(phantom.size_mm), 0.5)
    found = grid.first_hits(*rays)
    deep = values.min(axis=1) < -1.0
    first = along[np.argmax(values < 0, axis=1)]
    agree = np.abs(found - first) < 0.6
    assert np.all(np.isfinite(found[deep]))
    assert np.mean(agree[deep]) > 0.95
    assert np.all(found[deep] < along[np.argmax(values < -1.0, axis=1)][deep] + 0.5)


def test_colours_are_colours_and_many(phantom, points):
    skin = points[np.abs(phantom.surface(points)) < 0.5]
    normals = skin / np.linalg.norm(skin, axis=1, keepdims=True)
    colors = phantom.color(skin, normals)
    assert colors.shape == (len(skin), 3)
    assert colors.min() >= 0
    assert colors.max() <= 1
    assert len(np.unique(np.round(colors * 4), axis=0)) > 10


def test_shape_decides_how_it_is_turned(phantom, points):
    near = points[np.abs(phantom.surface(points)) < 3]
    here = phantom.surface(near) < 0
    for signs in ((-1, -1, 1), (-1, 1, -1), (1, -1, -1)):
        assert np.mean(here != (phantom.surface(near * np.float32(signs)) < 0)) > 0.05


def test_no_ray_that_misses_metal_is_too_dark_or_too_clear(phantom):
    """The darkest of a few level views, metal left out, lies where detectors measure well."""
    energy = phantom.energy_kev
    assert 40 <= energy <= 80
    half = 0.5 * np.array(phantom.size_mm)
    reach = float(np.hypot(half[0], half[1]))
    across, heights = np.arange(-reach, reach, 1.5), np.arange(-half[2], half[2], 5.0)
    darkest = 0.0
    for angle in np.radians(np.arange(0, 180, 30)):
        u, v, z = np.meshgrid(across, across, heights, indexing="ij")
        turned = [u * np.cos(angle) - v * np.sin(angle), u * np.sin(angle) + v * np.cos(angle), z]
        found = phantom.attenuation(np.stack(turned, axis=-1))
        darkest = max(darkest, float(np.where(found > 0.4, 0, found).sum(axis=1).max()) * 1.5)
    assert 1.2 < darkest < 3.5
