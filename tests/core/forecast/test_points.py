"""How long sparse points of photos take: what there is to find on them, two of the photos tell."""

from dataclasses import replace

import numpy as np
import pytest

from insideout.core.capture.model import Photo, Photos
from insideout.core.capture.read import read_capture
from insideout.core.capture.sfm_steps import pairs_by_pose
from insideout.core.forecast.forecast import forecast
from insideout.core.forecast.points import PointsTime, time_points
from insideout.core.forecast.speed import Speed, StepTime, measure_speed
from insideout.core.progress import unstopped
from insideout.core.settings import Settings
from insideout.core.views import Camera


@pytest.fixture
def ring(tmp_path):
    """Twelve photos from all around, each matched with ten others at most; every fourth is held out."""
    photos = []
    for index, angle in enumerate(np.linspace(0, 2 * np.pi, 12, endpoint=False)):
        forward = -np.array([np.cos(angle), np.sin(angle), 0.0])
        right = np.cross(forward, [0.0, 0.0, 1.0])
        pose = np.eye(4)
        pose[:3, :3] = right, np.cross(forward, right), forward
        pose[2, 3] = 4.0
        camera = Camera(64, 48, 80.0, 80.0, 32.0, 24.0, pose)
        photos.append(Photo(tmp_path / f"{index:02d}.png", camera, held_out=index % 4 == 3))
    return Photos(photos)


@pytest.fixture
def timed(monkeypatch):
    """The photos that were timed; each takes half a second, a pair a tenth."""
    seen = []

    def time_features(photos, workdir, reporter):
        assert not list(workdir.iterdir())
        seen.extend(photos)
        return 0.5, 0.1

    monkeypatch.setattr("insideout.core.capture.sfm.time_features", time_features)
    return seen


def test_all_photos_that_are_trained_on_take_what_two_of_them_take(ring, timed):
    training = [photo for photo in ring.photos if not photo.held_out]
    pairs = pairs_by_pose([photo.path.stem for photo in training], [photo.camera for photo in training])
    assert time_points(ring, unstopped).seconds(ring) == pytest.approx(0.5 * len(training) + 0.1 * len(pairs))
    assert all(photo in training for photo in timed)
    assert tuple(sorted(photo.path.stem for photo in timed)) in pairs
    one, other = (photo.camera.center for photo in timed)
    apart = sorted(np.linalg.norm(photo.camera.center - one) for photo in training)
    assert apart[1] < np.linalg.norm(other - one) < apart[-1], "neither next to each other nor far apart"


def test_where_nothing_is_to_be_matched_nothing_is_timed(ring, timed):
    assert time_points(Photos(ring.photos[:1]), unstopped) is None
    assert time_points(Photos(ring.photos[:7:6]), unstopped) is None, "they look at each other"
    assert time_points(Photos([replace(photo, held_out=True) for photo in ring.photos]), unstopped) is None
    assert not timed


def test_of_two_photos_both_are_timed(ring, timed):
    two = Photos(ring.photos[:2])
    assert time_points(two, unstopped).seconds(two) == pytest.approx(2 * 0.5 + 0.1)
    assert timed == two.photos


def test_features_are_found_and_matched_as_they_will_be(tiny_capture):
    found = time_points(read_capture(tiny_capture).photos, unstopped)
    assert found.photo > 0
    assert found.pair > 0


def test_timing_can_be_stopped(tiny_capture):
    class StoppedError(Exception):
        pass

    def tick():
        raise StoppedError

    with pytest.raises(StoppedError):
        time_points(read_capture(tiny_capture).photos, tick)


def test_time_is_by_photo_and_by_pair(ring):
    assert PointsTime(1.0, 0.0).seconds(ring) == 9
    assert PointsTime(0.0, 1.0).seconds(ring) > 9


def test_features_of_photos_take_what_they_were_measured_to(tiny_capture):
    """Photos of a rough surface have ten times as many as those of a smooth one, on whatever machine."""
    capture = read_capture(tiny_capture)
    settings, plain = Settings.of("standard"), Speed(*[StepTime(0.01, 0.0, 0.0)] * 3, slowness=2.0)
    points = PointsTime(0.5, 0.1)
    none, found = (
        forecast(capture, settings, speed).parts["initialize photos"]
        for speed in (plain, replace(plain, points=points))
    )
    assert found - none == pytest.approx(points.seconds(capture.photos))


def test_photos_that_came_with_points_have_no_features_to_be_found(tiny_capture):
    capture = read_capture(tiny_capture)
    with_points = replace(capture, photos=replace(capture.photos, points=np.zeros((4, 3))))
    assert measure_speed(capture, 32).points is not None
    assert measure_speed(with_points, 32).points is None
    bare = [replace(photo, camera=None) for photo in capture.photos.photos]
    found = measure_speed(replace(capture, photos=replace(capture.photos, photos=bare)), 32)
    assert found.points is None, "cameras are to be found first"
