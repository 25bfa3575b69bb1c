"""Marching cubes gives closed surfaces of the right size, cavities included."""

from __future__ import annotations

import numpy as np
import pytest
from skimage.measure import marching_cubes

from insideout.core.errors import SettingError
from insideout.core.mesh import extract_mesh
from insideout.core.volume import Volume


def ball(radius):
    return 4 / 3 * np.pi * radius**3


def test_ball_has_its_volume_and_place(ball_volume):
    mesh = extract_mesh(ball_volume(), 0.025)

    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(ball(10), rel=0.01)
    np.testing.assert_allclose(mesh.center_mass, [1, 2, -1], atol=0.01)
    reach = np.linalg.norm(mesh.vertices - [1, 2, -1], axis=1)
    np.testing.assert_allclose(reach, 10, atol=0.05)


def test_normals_point_out_of_the_material(ball_volume):
    mesh = extract_mesh(ball_volume(cavity=6.0), 0.025)

    from_center = mesh.vertices - [1, 2, -1]
    outer = np.linalg.norm(from_center, axis=1) > 8
    outward = (mesh.vertex_normals * from_center).sum(axis=1)
    assert np.all(outward[outer] > 0)
    assert np.all(outward[~outer] < 0)


def test_cavity_is_kept_and_not_counted_as_material(ball_volume):
    mesh = extract_mesh(ball_volume(cavity=7.0), 0.025)

    assert mesh.is_watertight
    assert mesh.body_count == 2
    assert mesh.volume == pytest.approx(ball(10) - ball(7), rel=0.01)


def test_without_a_level_all_that_is_not_air_has_a_surface(ball_volume):
    volume = ball_volume(cavity=7.0)
    steel = np.zeros_like(volume.values)
    steel[tuple(n // 2 for n in steel.shape)] = 1.0

    assert extract_mesh(volume).volume == pytest.approx(ball(10) - ball(7), rel=0.03)
    with_steel = Volume(volume.values + steel, volume.spacing_mm, volume.origin_mm)
    assert extract_mesh(with_steel, smallest_mm3=2.0).volume == pytest.approx(ball(10) - ball(7), rel=0.03)


def test_voxels_may_be_oblong(ball_volume):
    fine = ball_volume(spacing=0.25).values
    count = len(fine)
    blocks = fine.reshape(count // 4, 4, count // 2, 2, count).mean(axis=(1, 3))

    mesh = extract_mesh(Volume.centered(blocks, np.array([0.25, 0.5, 1.0])), 0.025)

    np.testing.assert_allclose(mesh.bounds, [[-9, -8, -11], [11, 12, 9]], atol=0.15)


def test_material_that_reaches_the_border_is_closed(ball_volume):
    mesh = extract_mesh(ball_volume(half=9.0, center=(0, 0, 0)), 0.025)

    assert mesh.is_watertight
    np.testing.assert_allclose(mesh.bounds, [[-9] * 3, [9] * 3], atol=0.26)


def test_a_dense_voxel_moves_no_border():
    values = np.zeros((20, 20, 20), np.float32)
    values[:10] = 0.05
    values[5, 10, 10] = 5.0
    mesh = extract_mesh(Volume.centered(values, np.ones(3)), 0.025)
    np.testing.assert_allclose(mesh.bounds, [[-10] * 3, [10, 10, 0]], atol=1e-3)


def test_pores_of_a_few_voxels_stay_and_specks_of_noise_go(ball_volume):
    """The terracotta's bubbles: of eight voxels most were dropped."""
    volume = ball_volume()
    volume.values[20:22, 20:22, 20:22] = 0.0
    volume.values[2, 2, 2] = 0.03

    assert extract_mesh(volume, 0.025).body_count == 2
    assert extract_mesh(volume, 0.025, smallest_mm3=0.0).body_count == 3
    assert extract_mesh(volume, 0.025, smallest_mm3=16 * float(np.prod(volume.spacing_mm))).body_count == 1


def test_nodes_exactly_on_the_level_leave_no_hole():
    values = np.zeros((8, 8, 8), np.float32)
    values[2:6, 2:6, 2:6] = 0.04
    values[4, 4, 6] = 0.02
    assert extract_mesh(Volume.centered(values, np.ones(3)), 0.02).is_watertight


def test_noise_stays_watertight(ball_volume):
    volume = ball_volume()
    volume.values[:] += np.random.default_rng(1).normal(0, 0.02, volume.values.shape).astype(np.float32)

    assert extract_mesh(volume, 0.025).is_watertight


def test_no_surface_is_said(ball_volume):
    with pytest.raises(SettingError, match="choose a level between them"):
        extract_mesh(ball_volume(), 0.5)
    with pytest.raises(SettingError, match="same everywhere"):
        extract_mesh(Volume.centered(np.ones((4, 4, 4), np.float32), np.ones(3)))
    with pytest.raises(SettingError, match="lower smallest_mm3"):
        extract_mesh(ball_volume(), 0.025, smallest_mm3=1e6)


def test_an_ambiguous_face_that_both_cells_close_leaves_no_pocket_of_nothing():
    """A wall of a matryoshka's mesh, 577 thousand triangles, had four of them that enclosed nothing."""
    values = np.array([[[-6.2, 0.3], [11.1, -1.0]], [[-7.1, 4.1], [7.9, -5.0]], [[-5.0, 8.5], [3.1, -5.5]]], np.float32)
    padded = np.pad(values, 1, constant_values=-10.0)
    _, faces, _, _ = marching_cubes(padded, 0.0, gradient_direction="descent")
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2).reshape(-1, 2)
    assert set(np.unique(edges, axis=0, return_counts=True)[1]) == {2, 4}
    mesh = extract_mesh(Volume(values, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)), level_mm_inv=0.0, smallest_mm3=0.0)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert len(mesh.faces) == len(faces) - 4
