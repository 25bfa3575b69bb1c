"""The Matryoshka is what it says: nested, thin-walled, not of revolution in shape or colour."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.phantoms.matryoshka import matryoshka


@pytest.fixture(scope="module")
def points(doll):
    half = 0.5 * np.array(doll.size_mm)
    return np.random.default_rng(0).uniform(-half, half, (60_000, 3)).astype(np.float32)


def turned(points, degrees):
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return points @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]], np.float32)


@pytest.mark.parametrize("shells", [1, 5, 9])
def test_shells_lie_inside_each_other_and_never_overlap(points, shells):
    doll = matryoshka(shells)
    parts = {part.name: part for part in doll.parts}
    assert sum(name.startswith("shell") for name in parts) == shells
    for level in range(1, shells + 1):
        cavity = parts[f"cavity {level}"].distance(points)
        inner = parts[f"shell {level + 1}" if level < shells else "little one"].distance(points)
        assert np.any(inner < 0)
        assert np.all(cavity[inner < -1e-3] < 1e-3)


@pytest.mark.parametrize("shells", [5, 9])
def test_walls_are_a_millimetre_or_more_everywhere(shells):
    doll = matryoshka(shells)
    pairs = zip(doll.parts[:-2:2], doll.parts[1:-2:2], strict=True)
    half = 0.5 * np.array(doll.size_mm)
    points = np.random.default_rng(3).uniform(-half, half, (200_000, 3)).astype(np.float32)
    for shell, cavity in pairs:
        on_cavity = np.abs(cavity.distance(points)) < 0.05
        assert on_cavity.sum() > 5
        assert shell.distance(points[on_cavity]).max() < -0.93


def test_every_wall_has_its_attenuation_and_air_has_none(doll, points):
    found = doll.attenuation(points)

    solids = {part.material.attenuation(doll.energy_kev) for part in doll.parts if part.material is not None}
    np.testing.assert_allclose(np.unique(found), sorted({0.0, *solids}), atol=1e-6)
    assert not found[doll.surface(points) > 0].any()
    assert not found[doll.parts[1].distance(points) < -2.5].all()


def test_seam_is_the_brightest_and_lies_at_the_waist(doll, points):
    bright = points[doll.attenuation(points) > 0.06]

    assert len(bright) > 20
    assert np.ptp(bright[:, 2]) < 2.0
    assert np.hypot(bright[:, 0], bright[:, 1]).min() > 24


def test_nothing_reaches_out_of_the_box(doll):
    half = 0.5 * np.array(doll.size_mm)
    rng = np.random.default_rng(1)
    for axis in range(3):
        for side in (-1, 1):
            face = rng.uniform(-half, half, (4000, 3))
            face[:, axis] = side * half[axis]
            assert doll.surface(face.astype(np.float32)).min() > 0


def test_shape_decides_how_it_is_turned(doll, points):
    near = points[np.abs(doll.surface(points)) < 6]
    here = doll.surface(near) < 0
    for degrees in (20, 90, 180, 270):
        assert np.mean(here != (doll.surface(turned(near, degrees)) < 0)) > 0.02


def test_painting_differs_all_around_and_from_left_to_right(doll):
    angle = np.linspace(-np.pi, np.pi, 400, endpoint=False)
    ring = np.stack([np.sin(angle), -np.cos(angle), np.zeros(400)], axis=1)
    points = (ring * [28, 28, 0] + [0, 0, -26]).astype(np.float32)
    colors = doll.color(points, ring)

    assert colors.min() >= 0
    assert colors.max() <= 1
    for step in (100, 200, 300):
        assert np.abs(colors - np.roll(colors, step, axis=0)).mean() > 0.1
    assert np.abs(colors - colors[::-1]).mean() > 0.05


def test_landmarks_lie_on_the_surface(doll):
    assert len(doll.landmarks) >= 3
    np.testing.assert_allclose(doll.surface(doll.landmarks.astype(np.float32)), 0, atol=0.1)


def test_voxel_means_keep_the_amount_of_material(doll, points):
    fine, coarse = doll.attenuation(points).mean(), doll.voxel_means(points, 0.75).mean()
    assert coarse == pytest.approx(fine, rel=0.03)
