"""Images of a phantom agree with its geometry."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.phantoms import photos
from insideout.core.phantoms.distance_grid import DistanceGrid
from insideout.core.phantoms.photos import BACKGROUND, render_photo
from insideout.core.phantoms.projections import count_photons, project
from insideout.core.phantoms.scanner import scan_geometry
from insideout.core.phantoms.settings import CaptureSettings
from insideout.core.phantoms.shots import camera_ring, plan_shots
from insideout.core.phantoms.spectrum import monochromatic


def test_line_integrals_are_those_of_the_attenuation(doll, doll_tables):
    detector = scan_geometry(doll, 11, 15).detector(0.7)

    (image,) = project(doll_tables, [detector], monochromatic(doll.energy_kev))

    origins, directions = (part.reshape(-1, 3) for part in detector.rays())
    step = 0.04
    reach = np.linalg.norm(detector.source) + np.arange(-55, 55, step)
    marched = np.zeros(len(origins))
    for ray, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
        marched[ray] = step * doll.attenuation(origin + reach[:, None] * direction).sum()
    # A ray that grazes a wall turns microns of depth into millimetres of chord, so a few may be further off.
    error = np.abs(image.ravel() - marched)
    assert np.quantile(error, 0.97) < 0.01
    assert error.max() < 0.05
    assert image.max() > 0.6


def test_detector_sees_the_phantom_whole(doll, doll_tables):
    scan = scan_geometry(doll, 60, 74)
    images = project(doll_tables, scan.detectors(np.array([0.0, 1.0, 2.5])), monochromatic(doll.energy_kev))

    border = np.concatenate([images[:, [0, -1]].ravel(), images[:, :, [0, -1]].ravel()])
    assert not border.any()


def test_noise_is_that_of_counting():
    rng = np.random.default_rng(0)
    clean = np.full((200, 200), 1.5)

    noisy = count_photons(clean, 10_000, rng)

    assert noisy.mean() == pytest.approx(1.5, abs=0.002)
    assert noisy.std() == pytest.approx(np.exp(0.75) / 100, rel=0.03)
    assert np.isfinite(count_photons(np.full((5, 5), 60.0), 100, rng)).all()


@pytest.fixture(scope="module")
def surface_grid(doll):
    return DistanceGrid.bake(doll.surface, np.array(doll.size_mm), 0.5)


def test_every_photo_shows_the_doll_whole_on_a_plain_background(doll, surface_grid):
    for camera in camera_ring(6, max(doll.size_mm), 48, 64, np.random.default_rng(0)):
        image = render_photo(doll, surface_grid, camera)
        assert image.shape == (64, 48, 3)
        edge = np.concatenate([image[[0, -1]].reshape(-1, 3), image[:, [0, -1]].reshape(-1, 3)])
        np.testing.assert_allclose(edge, np.broadcast_to(BACKGROUND, edge.shape), atol=1e-3)
        shown = np.abs(image - np.asarray(BACKGROUND)).max(axis=-1) > 0.06
        assert 0.15 < shown.mean() < 0.6


def test_photo_shows_points_where_the_camera_projects_them(doll, surface_grid):
    camera = camera_ring(6, max(doll.size_mm), 96, 128, np.random.default_rng(0))[3]
    image = render_photo(doll, surface_grid, camera)
    shown = np.abs(image - np.asarray(BACKGROUND)).max(axis=-1) > 0.06

    rng = np.random.default_rng(1)
    points = rng.uniform(-50, 50, (4000, 3)).astype(np.float32)
    inside = points[doll.surface(points) < -0.5]
    seen = inside @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    column = camera.fx * seen[:, 0] / seen[:, 2] + camera.cx
    row = camera.fy * seen[:, 1] / seen[:, 2] + camera.cy

    assert np.mean(shown[row.astype(int), column.astype(int)]) > 0.995
    rows, columns = np.nonzero(shown)
    assert row.min() == pytest.approx(rows.min(), abs=4)
    assert column.max() == pytest.approx(columns.max() + 1, abs=4)


@pytest.mark.parametrize("effect", [None, "rolling_shutter", "motion_blur", "defocus", "lens", "moving_background"])
def test_a_photo_made_in_bands_of_rows_has_the_same_bits(doll, surface_grid, monkeypatch, effect):
    """However large a photo is, only some of its rays are in memory."""
    effects = () if effect is None else (effect,)
    settings = CaptureSettings(photos=1, photo_width=24, photo_height=32, photos_by="rays", effects=effects)
    (shot,) = plan_shots(max(doll.size_mm), settings, np.random.default_rng(0))
    whole = render_photo(doll, surface_grid, shot)
    monkeypatch.setattr(photos, "_RAYS_AT_ONCE", 3000)
    np.testing.assert_array_equal(render_photo(doll, surface_grid, shot), whole)
