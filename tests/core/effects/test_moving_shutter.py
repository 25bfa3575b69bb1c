"""Which sparse points tell of cameras that move while their photos are read out, and which do not."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from insideout.core.capture.model import Photo, Photos
from insideout.core.effects import rolling_shutter
from insideout.core.effects.choose import look_at_photos
from insideout.core.effects.paths import row_poses
from insideout.core.effects.photos import PhotoEvidence
from insideout.core.effects.request import parse_effects

SIZE, EXTENT, NOISE_PX = 240, 70.0, 0.3


@pytest.fixture(scope="module")
def points():
    """On both walls, and between them."""
    return np.random.default_rng(5).uniform([-32, -25, -26], [32, 25, 26], (150, 3))


def drawn(camera, points, poses=None):
    """(P, 2) columns and rows, each point from its own pose (P, 4, 4) if given."""
    matrix = np.asarray(camera.world_to_camera) if poses is None else poses
    local = np.einsum("...ij,pj->pi" if poses is None else "pij,pj->pi", matrix[..., :3, :3], points)
    local = local + matrix[..., :3, 3]
    return local[:, :2] / local[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def read_out(camera, points, motion, axis=1):
    """(P, 2) where a photo shows points that is read out along an axis while the camera makes a motion (6,)."""
    numbers, where = torch.cat([torch.from_numpy(motion), torch.zeros(6, dtype=torch.float64)]), drawn(camera, points)
    for _ in range(4):
        poses = row_poses(camera.world_to_camera, numbers, torch.from_numpy(where[:, axis] / SIZE), EXTENT).numpy()
        where = drawn(camera, points, poses)
    return where


def motions(cameras, points, px, rng):
    """(N, 6), each of which moves points by so many px a readout, told evenly over the rows."""
    found = []
    for camera in cameras:
        motion = rng.standard_normal(6) * [0.01, 0.01, 0.01, 0.02, 0.02, 0.02]
        ways = read_out(camera, points, motion) - drawn(camera, points)
        found.append(motion * px / np.sqrt(12 * (ways**2).sum(axis=1).mean()))
    return found


@pytest.fixture
def seen_at(cameras, points, photographs, tmp_path):
    """What is found where points are seen at `shown` (N, P, 2) px, each by about half of the cameras."""

    def look(shown, seed=0, some=None, cameras=cameras):
        rng = np.random.default_rng(100 + seed)
        some = slice(None) if some is None else some
        shown = np.array(shown) + NOISE_PX * rng.standard_normal((len(cameras), len(points), 2))
        seen = (rng.random((len(points), len(cameras))) < 0.6)[some]
        model = photographs.write_model(tmp_path / "model", cameras, points[some], seen, shown[:, some])
        photos = Photos([Photo(Path(f"{index}.png"), camera) for index, camera in enumerate(cameras)])
        return PhotoEvidence(photos, points, SIZE, model)

    return look


def moving(cameras, points, px, seed=0, axis=1):
    paths = motions(cameras, points, px, np.random.default_rng(seed))
    return [read_out(camera, points, motion, axis) for camera, motion in zip(cameras, paths, strict=True)]


@pytest.mark.parametrize(("px", "found"), [(0.0, False), (0.2, False), (1.2, True), (4.0, True)])
def test_found_from_half_a_pixel(px, found, cameras, points, seen_at):
    finding = rolling_shutter.detect(seen_at(moving(cameras, points, px)))
    assert finding.found is found
    # Points give way to what photos from one side have in common.
    assert finding.strength == pytest.approx(0.85 * px, rel=0.25, abs=0.2)
    assert finding.unit == "px"


@pytest.mark.slow
@pytest.mark.parametrize(("px", "found"), [(0.0, False), (0.2, False), (1.2, True), (4.0, True)])
def test_right_on_nearly_all_seeds(px, found, cameras, points, seen_at):
    seen = [seen_at(moving(cameras, points, px, seed), seed) for seed in range(20)]
    assert np.mean([rolling_shutter.detect(one).found is found for one in seen]) >= 0.95


def test_a_size_of_training_has_its_own_pixels(cameras, points, seen_at):
    given = seen_at(moving(cameras, points, 1.2))
    half = rolling_shutter.detect(replace(given, long_side=SIZE // 4))
    assert half.found is False
    assert half.strength < 0.5 < rolling_shutter.detect(given).strength


def test_photos_read_out_by_columns_are_not_learnt(cameras, points, seen_at):
    finding = rolling_shutter.detect(seen_at(moving(cameras, points, 4.0, axis=0)))
    assert finding.found is None
    assert "only rows are learned" in finding.reason


def test_a_lens_that_bends_lines_is_no_motion(cameras, points, seen_at):
    """By up to 2 px in the corners, which is more than residuals of a finished model."""
    shown = []
    for camera in cameras:
        where = drawn(camera, points) - SIZE / 2
        shown.append(where * (1 + 0.012 * (where**2).sum(axis=1, keepdims=True) / (SIZE / 2) ** 2) + SIZE / 2)
    finding = rolling_shutter.detect(seen_at(shown))
    assert finding.found is False


def test_poses_that_are_a_little_off_are_no_motion(cameras, points, seen_at):
    """By a pixel and more for the whole of a photo."""
    rng = np.random.default_rng(0)
    shown = [drawn(camera, points) + 1.2 * rng.standard_normal(2) for camera in cameras]
    assert rolling_shutter.detect(seen_at(shown)).found is not True


def test_a_tenth_of_wrong_matches_is_no_motion(cameras, points, seen_at):
    rng, shown = np.random.default_rng(0), []
    for camera in cameras:
        where = drawn(camera, points)
        wrong = rng.random(len(points)) < 0.1
        where[wrong] += rng.normal(0, 3.0, (wrong.sum(), 2))
        shown.append(where)
    assert rolling_shutter.detect(seen_at(shown)).found is False


def test_cannot_tell_without_points_or_with_too_few(cameras, points, seen_at):
    given = seen_at(moving(cameras, points, 4.0))
    assert rolling_shutter.detect(replace(given, model=None)).found is None
    few = rolling_shutter.detect(seen_at(moving(cameras, points, 4.0), some=slice(0, 35)))
    assert few.found is None
    assert few.strength is None


def test_held_out_photos_have_no_say(cameras, points, seen_at):
    given = seen_at(moving(cameras, points, 4.0))
    photos = [replace(photo, held_out=place >= 2) for place, photo in enumerate(given.photos.photos)]
    assert rolling_shutter.detect(replace(given, photos=Photos(photos))).found is None, "two are too few"


def test_auto_uses_it_where_it_is_found(cameras, points, seen_at):
    request = parse_effects("auto,-exposure,-pixel_integration,-defocus,-motion_blur")
    for px, used in ((4.0, True), (0.0, False)):
        (row,) = look_at_photos(request, seen_at(moving(cameras, points, px))).rows
        assert (row["name"], row["used"], row["chosen_by"]) == ("rolling_shutter", used, "auto")
