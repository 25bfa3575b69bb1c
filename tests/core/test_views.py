"""Camera, Detector and Plane: where each pixel lies."""

import numpy as np
import pytest

from insideout.core.rotations import normalize_quats, quats_to_matrices
from insideout.core.similarity import Similarity
from insideout.core.views import Camera, Detector, Plane


def project(camera, points):
    matrix = np.asarray(camera.world_to_camera)
    p = points @ matrix[:3, :3].T + matrix[:3, 3]
    depth = 1.0 if camera.orthographic else p[:, 2]
    return np.stack([camera.fx * p[:, 0] / depth + camera.cx, camera.fy * p[:, 1] / depth + camera.cy], -1)


def some_camera(orthographic=False):
    pose = np.eye(4)
    pose[:3, :3] = quats_to_matrices(normalize_quats(np.array([[0.9, 0.1, -0.3, 0.2]])))[0]
    pose[:3, 3] = [0.1, -0.2, 5.0]
    return Camera(64, 48, 70.0, 72.0, 31.0, 25.0, pose, orthographic)


def test_rows_of_an_image_lie_where_they_lay_in_the_whole():
    camera, points = some_camera(), np.random.default_rng(0).uniform(-1, 1, (20, 3))
    rows = camera.rows(10, 17)
    assert (rows.width, rows.height) == (64, 7)
    np.testing.assert_allclose(project(rows, points), project(camera, points) - [0, 10], atol=1e-12)
    for view in (
        rows,
        rows.resized(128, 14),
        rows.rows(2, 3),
        rows.transformed(Similarity(2.0, np.eye(3), np.ones(3))),
    ):
        np.testing.assert_allclose(view.field_of_view(), camera.field_of_view())


def test_a_camera_moved_with_the_scene_sees_the_same_image():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(20, 3))
    similarity = Similarity(40.0, quats_to_matrices(normalize_quats(rng.normal(size=(1, 4))))[0], rng.normal(size=3))
    for orthographic in (False, True):
        camera = some_camera(orthographic)
        moved = camera.transformed(similarity)
        np.testing.assert_allclose(project(moved, similarity.apply(points)), project(camera, points), atol=1e-9)


def test_the_centre_of_a_camera_is_where_its_axes_meet():
    camera = some_camera()
    matrix = camera.world_to_camera
    np.testing.assert_allclose(matrix[:3, :3] @ camera.center + matrix[:3, 3], 0, atol=1e-12)


def test_resizing_keeps_the_field_of_view():
    camera = some_camera()
    points = np.array([[0.3, 0.1, 0.2]])
    np.testing.assert_allclose(project(camera.resized(32, 24), points), project(camera, points) / 2)


def test_the_middle_ray_of_a_centred_cone_goes_through_the_axis():
    detector = Detector(3, 5, source=[100, 0, 0], center=[-50, 0, 0], u=[0, 1, 0], v=[0, 0, -1])
    origins, directions = detector.rays()
    np.testing.assert_allclose(origins[2, 1], [100, 0, 0])
    np.testing.assert_allclose(directions[2, 1], [-1, 0, 0])
    assert directions[0, 1, 2] > 0, "the first row is the top"


def test_parallel_rays_share_one_direction():
    detector = Detector(4, 2, source=[-2, 0, 0], center=[-50, 0, 0], u=[0, 1, 0], v=[0, 0, -1], parallel=True)
    origins, directions = detector.rays()
    np.testing.assert_allclose(directions, np.broadcast_to([-1.0, 0, 0], directions.shape))
    np.testing.assert_allclose(origins[0, 0], [-50, -1.5, 0.5])


@pytest.mark.parametrize(("width", "height"), [(6, 4), (7, 5)])
def test_a_block_of_detector_pixels_has_its_ray_in_their_middle(width, height):
    """What is left over at the right and bottom is cut; the blocks stay where they were."""
    detector = Detector(width, height, source=[100, 0, 0], center=[-50, 3, 2], u=[0, 1.5, 0], v=[0, 0.1, -2])
    (origins, directions), blocks = detector.rays(), detector.in_blocks(2)
    hits = origins + directions * (150 / -directions[..., :1])
    across, through = blocks.rays()
    assert (blocks.width, blocks.height) == (3, 2)
    middles = hits[:4, :6].reshape(2, 2, 3, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(across + through * (150 / -through[..., :1]), middles, atol=1e-9)


def test_a_detector_smaller_than_a_block_has_none():
    with pytest.raises(ValueError, match="no blocks of 4 x 4"):
        Detector(3, 8, source=[100, 0, 0], center=[-50, 0, 0], u=[0, 1, 0], v=[0, 0, -1]).in_blocks(4)


def test_plane_pixels_start_half_a_step_from_the_corner():
    plane = Plane([1, 2, 3], [0.5, 0, 0], [0, 0, -0.25], 4, 2)
    points = plane.points()
    np.testing.assert_allclose(points[0, 0], [1.25, 2, 2.875])
    np.testing.assert_allclose(points[1, 3], [2.75, 2, 2.625])
    np.testing.assert_allclose(plane.normal, [0, 1, 0])
