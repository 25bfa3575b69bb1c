"""A surface lies half way between air and the material that is there, whatever else the object is made of."""

import numpy as np
import pytest

from insideout.core.mesh import extract_mesh
from insideout.core.volume import Volume


def blurred_ball(inner: float, outer: float, skin: float = 0.0, skin_mm: float = 0.0, radius: float = 10.0) -> Volume:
    """A ball of `radius` mm in 0.5 mm voxels, half of it of each attenuation, with a skin; edges 0.5 mm wide."""
    axis = np.arange(-14, 14.25, 0.5)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    distance = np.sqrt(x**2 + y**2 + z**2) - radius

    def share(level: float) -> np.ndarray:
        return np.clip(0.5 - (distance - level) / 0.5, 0, 1)

    values = share(0.0) * np.where(x < 0, inner, outer)
    if skin_mm:
        values = values + (share(0.0) - share(-skin_mm)) * (skin - np.where(x < 0, inner, outer))
    return Volume.centered(values.astype(np.float32), np.full(3, 0.5))


def off(mesh, radius: float = 10.0) -> np.ndarray:
    """How far vertices lie outside of the sphere, without those over the seam of the two halves."""
    vertices = np.asarray(mesh.vertices)
    return np.linalg.norm(vertices, axis=1)[np.abs(vertices[:, 0]) > 1.5] - radius


def test_light_wood_beside_heavy_has_its_surface_where_it_ends():
    volume = blurred_ball(0.015, 0.045)
    assert np.abs(off(extract_mesh(volume, 0.012))).mean() > 0.1
    assert np.abs(off(extract_mesh(volume))).mean() < 0.03


def test_gilding_does_not_swell_a_coffin():
    """Thinner than a voxel, it fills the voxels outside of it to more than wood has."""
    volume = blurred_ball(0.012, 0.012, skin=0.12, skin_mm=0.3)
    at_one_level, local = off(extract_mesh(volume, 0.008)), off(extract_mesh(volume))
    assert at_one_level.mean() > 0.2
    assert np.abs(local).mean() < 0.16


def test_the_two_sides_of_a_thin_wall_do_not_pass_each_other():
    """A plate of one voxel, half as dense as it should be."""
    values = np.zeros((24, 24, 24), np.float32)
    values[11, 4:20, 4:20], values[16:22, 4:20, 4:20] = 0.02, 0.04
    mesh = extract_mesh(Volume.centered(values, np.ones(3)))
    assert mesh.is_watertight
    parts = sorted(part.volume for part in mesh.split())
    assert len(parts) == 2
    assert parts[0] == pytest.approx(16 * 16 * 1, rel=0.15)
    assert parts[1] == pytest.approx(16 * 16 * 6, rel=0.1)


def test_oblong_voxels_reach_no_farther_across_than_along():
    """Light wood two voxels thick over a heavy core: its own surface, not the core's."""
    values = np.zeros((12, 24, 24), np.float32)
    values[3:9, 6:18, 6:18], values[4:8, 8:16, 8:16] = 0.02, 0.2
    mesh = extract_mesh(Volume.centered(values, np.array([1.0, 1.0, 3.0])))
    vertices = np.asarray(mesh.vertices)
    over_core = vertices[(np.abs(vertices[:, 1]) < 2.5) & (np.abs(vertices[:, 2]) < 4) & (np.abs(vertices[:, 0]) > 1)]
    assert np.abs(over_core[:, 0]).min() == pytest.approx(6, abs=0.5)


def test_undershoot_beside_metal_does_not_swell_it():
    volume = blurred_ball(0.04, 0.04)
    shell = np.linalg.norm(np.stack(np.meshgrid(*[np.arange(-14, 14.25, 0.5)] * 3, indexing="ij")), axis=0)
    volume.values[(shell > 10.8) & (shell < 11.5)] = -0.3
    assert np.abs(off(extract_mesh(volume))).mean() < 0.05


def test_a_level_that_was_asked_for_is_kept():
    """Marching cubes puts vertices exactly on it."""
    volume = blurred_ball(0.015, 0.045)
    mesh = extract_mesh(volume, 0.012)
    assert np.abs(volume.sample(np.asarray(mesh.vertices)) - 0.012).max() < 1e-4


def test_material_at_the_border_stays_closed():
    values = np.full((12, 12, 12), 0.04, np.float32)
    values[:, :, :3] = 0.0
    values += np.random.default_rng(0).normal(0, 0.001, values.shape).astype(np.float32)
    mesh = extract_mesh(Volume.centered(values, np.ones(3)))
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(9 * 12 * 12, rel=0.05)
