"""Which photos see which sparse points, from a COLMAP model on disk."""

from dataclasses import replace

import numpy as np
import pytest

from insideout.core.capture import tracks
from insideout.core.capture.tracks import find_model, read_tracks
from insideout.core.errors import Cancelled
from insideout.core.views import Camera

POINTS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.5], [0.0, 1.0, -0.5], [0.5, 0.5, 0.0]])


@pytest.fixture
def cameras():
    """Four beside each other, ten units away."""
    found = []
    for x in range(4):
        pose = np.eye(4)
        pose[:3, 3] = [-x, 0, 10]
        found.append(Camera(320, 240, 300.0, 300.0, 160.0, 120.0, pose))
    return found


@pytest.fixture
def model(cameras, tmp_path):
    """The third point is seen by two photos, the fourth by one, the others by all."""
    import pycolmap

    seen = np.array([[1, 1, 1, 1], [1, 1, 1, 1], [0, 1, 1, 0], [1, 0, 0, 0]], bool)
    made = pycolmap.Reconstruction()
    params = [300.0, 300.0, 160.0, 120.0]
    made.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="PINHOLE", width=320, height=240, params=params)
    )
    for index, camera in enumerate(cameras):
        image = pycolmap.Image(name=f"{index}.jpg", camera_id=1, image_id=index + 1)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(np.zeros(2)) for _ in POINTS])
        made.add_image_with_trivial_frame(image, pycolmap.Rigid3d(camera.world_to_camera[:3]))
    for place, point in enumerate(POINTS):
        track = pycolmap.Track()
        for index in np.flatnonzero(seen[place]):
            track.add_element(int(index) + 1, place)
        made.add_point3D(point, track, np.zeros(3, np.uint8))
    folder = tmp_path / "sfm" / "model"
    folder.mkdir(parents=True)
    made.write(folder)
    return folder


def test_photos_are_known_by_their_poses(model, cameras):
    """Whatever their order, and without those that are not asked for."""
    found = read_tracks(model, [cameras[2], cameras[0], cameras[1]])
    np.testing.assert_allclose(found.points, POINTS[:3], atol=1e-12)
    pairs = set(zip(found.point.tolist(), found.photo.tolist(), strict=True))
    assert pairs == {(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2), (2, 0), (2, 2)}


def test_photos_of_the_very_same_pose_see_nothing(model, cameras):
    found = read_tracks(model, [*cameras, replace(cameras[1], width=160)])
    assert set(found.photo.tolist()) == {0, 2, 3}


def test_a_model_of_other_photos_says_nothing(model, cameras):
    moved = [replace(camera, world_to_camera=camera.world_to_camera + np.eye(4)[2]) for camera in cameras]
    assert read_tracks(model, moved) is None


def test_a_damaged_model_says_nothing(model, cameras):
    for file in model.iterdir():
        file.write_bytes(b"half")
    assert read_tracks(model, cameras) is None


def test_reading_many_points_can_be_stopped(model, cameras, monkeypatch):
    monkeypatch.setattr(tracks, "_POINTS_A_TICK", 2)
    ticks = []
    read_tracks(model, cameras, lambda: ticks.append(1))
    assert len(ticks) == 2

    def stop():
        raise Cancelled

    with pytest.raises(Cancelled):
        read_tracks(model, cameras, stop)


def test_the_run_s_own_model_comes_first(model, tmp_path):
    assert find_model(model.parent, tmp_path / "capture") == model
    assert find_model(tmp_path / "none", tmp_path / "capture") is None
    brought = tmp_path / "capture" / "sparse" / "0"
    brought.mkdir(parents=True)
    (tmp_path / "capture" / "photos").mkdir()
    (brought / "cameras.bin").write_bytes(b"")
    assert find_model(tmp_path / "none", tmp_path / "capture") == brought


def test_where_points_were_seen_is_in_pixels_of_the_camera_without_its_lens(cameras, tmp_path):
    """The model's images are twice as large and bent by a lens."""
    import pycolmap

    made = pycolmap.Reconstruction()
    params = [600.0, 320.0, 240.0, 0.1]
    lens = pycolmap.Camera(camera_id=1, model="SIMPLE_RADIAL", width=640, height=480, params=params)
    made.add_camera_with_trivial_rig(lens)
    for index, camera in enumerate(cameras[:2]):
        image = pycolmap.Image(name=f"{index}.jpg", camera_id=1, image_id=index + 1)
        local = POINTS @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(place) for place in lens.img_from_cam(local)])
        made.add_image_with_trivial_frame(image, pycolmap.Rigid3d(camera.world_to_camera[:3]))
    for place, point in enumerate(POINTS):
        track = pycolmap.Track()
        track.add_element(1, place)
        track.add_element(2, place)
        made.add_point3D(point, track, np.zeros(3, np.uint8))
    made.write(tmp_path)
    found = read_tracks(tmp_path, cameras[:2])
    local = found.points[found.point] + np.array([camera.world_to_camera[:3, 3] for camera in cameras])[found.photo]
    np.testing.assert_allclose(found.seen, 300 * local[:, :2] / local[:, 2:] + [160, 120], atol=1e-6)


def test_features_where_a_lens_folds_are_left_out(model, cameras, monkeypatch):
    def folded(reconstruction, places):
        ideal = {image_id: np.zeros((len(POINTS), 2)) for image_id in places}
        # The first point in the first photo, and the third in one of the two that see it.
        ideal[1][0] = np.nan
        ideal[2][2] = np.nan
        return ideal

    monkeypatch.setattr(tracks, "_ideal", folded)
    found = read_tracks(model, cameras)
    np.testing.assert_allclose(found.points, POINTS[:2], atol=1e-12)
    pairs = set(zip(found.point.tolist(), found.photo.tolist(), strict=True))
    assert pairs == {(0, 1), (0, 2), (0, 3), (1, 0), (1, 1), (1, 2), (1, 3)}
    assert np.isfinite(found.seen).all()
