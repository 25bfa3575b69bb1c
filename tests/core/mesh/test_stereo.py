"""GS2Mesh's route: stereo pairs of a rendered ball, matched and fused, give the ball back."""

import numpy as np
import pytest

from insideout.core.errors import Cancelled
from insideout.core.gaussians import GaussianSet
from insideout.core.mesh.stereo import StereoSettings, match, stereo_depth, stereo_mesh, unprojected
from insideout.core.mesh.tsdf import TsdfGrid
from insideout.core.progress import Reporter
from insideout.core.rotations import matrix_to_quat
from insideout.core.spherical_harmonics import rgb_to_sh
from insideout.core.views import Camera

CENTER = np.array([0.3, -0.2, 0.1])


def camera_at(position, size=160):
    forward = (CENTER - position) / np.linalg.norm(CENTER - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ position
    return Camera(size, size, 1.2 * size, 1.2 * size, size / 2, size / 2, matrix)


def test_lengths_are_the_published_ones():
    published = StereoSettings()
    assert (published.baseline, published.voxel, published.truncation) == (0.07, 2 / 512, 0.04)


@pytest.fixture(scope="module")
def ball():
    """6,000 opaque discs of random colours on a sphere of radius 1: round splats would show their thickness."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(6000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    across = np.cross(directions, rng.normal(size=(6000, 3)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    turns = np.stack([across, np.cross(directions, across), directions], axis=-1)
    quats = np.array([matrix_to_quat(turn) for turn in turns])
    colors = rgb_to_sh(rng.uniform(0, 1, (6000, 3))).astype(np.float32)[:, None, :]
    return GaussianSet.create(CENTER + directions, [[0.03, 0.03, 0.002]], quats=quats, opacities=0.95, sh=colors)


@pytest.fixture(scope="module")
def cameras():
    angles = np.arange(14) * 2 * np.pi / 14
    heights = np.where(np.arange(14) % 2, 1.6, -1.2)
    return [
        camera_at(CENTER + np.array([3.2 * np.cos(a), 3.2 * np.sin(a), h]))
        for a, h in zip(angles, heights, strict=True)
    ]


def test_a_textured_ball_is_found_within_three_percent_of_its_radius(ball, cameras):
    mesh = stereo_mesh(ball, cameras)
    radii = np.linalg.norm(np.asarray(mesh.vertices) - CENTER, axis=1)
    assert len(mesh.faces) > 2000
    assert np.mean(np.abs(radii - 1)) < 0.03
    assert np.percentile(np.abs(radii - 1), 95) < 0.08
    assert (np.einsum("ij,ij->i", mesh.face_normals, mesh.triangles_center - CENTER) > 0).mean() > 0.95
    colors = np.asarray(mesh.visual.vertex_colors)[:, :3]
    assert colors.std() > 20


def test_depths_are_those_of_the_ball(ball, cameras):
    _, depth = stereo_depth(ball.to_torch(), cameras[0], 0.07 * 3.5, StereoSettings(), "cpu")
    points = unprojected(cameras[0], depth)
    assert len(points) > 0.5 * np.pi * (160 * 1.2 / 3.5) ** 2
    assert np.median(np.abs(np.linalg.norm(points - CENTER, axis=1) - 1)) < 0.03


def test_a_pair_that_is_shifted_by_seven_pixels_has_that_disparity():
    image = np.random.default_rng(1).integers(0, 255, (60, 120, 3), np.uint8)
    there, back = match(image, np.roll(image, -7, axis=1), 0, 16)
    assert np.median(np.abs(there[:, 20:-20] - 7)) < 0.1
    assert np.median(np.abs(back[:, 20:-20] - 7)) < 0.1


def test_what_shows_nothing_has_no_mesh(cameras):
    nothing = GaussianSet.create(np.zeros((1, 3)), 0.01, opacities=0.001)
    assert len(stereo_mesh(nothing, cameras).faces) == 0


def test_depth_maps_of_a_plane_give_a_plane():
    camera = Camera(40, 40, 40.0, 40.0, 20.0, 20.0, np.eye(4))
    grid = TsdfGrid(np.array([-0.5, -0.5, 1.5]), np.array([0.5, 0.5, 2.5]), 0.05, 0.2)
    grid.integrate(camera, np.full((40, 40), 2.02, np.float32), np.full((40, 40, 3), 0.5))
    mesh = grid.mesh()
    np.testing.assert_allclose(mesh.vertices[:, 2], 2.02, atol=1e-3)
    assert (mesh.face_normals[:, 2] < -0.99).all()


def test_no_surface_is_made_up_where_sight_ends_behind_the_plane():
    camera = Camera(40, 40, 40.0, 40.0, 20.0, 20.0, np.eye(4))
    grid = TsdfGrid(np.array([-0.3, -0.3, 1.0]), np.array([0.3, 0.3, 3.0]), 0.05, 0.2)
    for depth in (1.98, 2.06):
        grid.integrate(camera, np.full((40, 40), depth, np.float32), np.zeros((40, 40, 3)))
    np.testing.assert_allclose(grid.mesh().vertices[:, 2], 2.02, atol=1e-3)


def test_it_can_be_stopped(ball, cameras):
    with pytest.raises(Cancelled):
        stereo_mesh(ball, cameras, reporter=Reporter(None, lambda: True))
