"""Which photos are found to have a shallow depth of field: of a slanted wall of patches, seen from all around."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from insideout.core.capture.model import Photos
from insideout.core.effects import defocus
from insideout.core.effects.choose import look_at_photos
from insideout.core.effects.look.sharpness import edges, front
from insideout.core.effects.photos import PhotoEvidence
from insideout.core.effects.request import parse_effects
from insideout.core.views import Camera

SIZE, DISTANCE, HALF, PATCH = 120, 200.0, 45.0, 15.0
PHOTOS, RAYS = 10, 16
BEHIND = 0.78


def camera_at(turn, tilt=0.9):
    """From the side, so that the wall is a fourth farther away behind than in front."""
    position = DISTANCE * np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
    forward = -position / DISTANCE
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[2, 3] = DISTANCE
    focal = SIZE * DISTANCE / 92
    return Camera(SIZE, SIZE, focal, focal, SIZE / 2, SIZE / 2, pose)


CAMERAS = [camera_at(2 * np.pi * index / PHOTOS) for index in range(PHOTOS)]


def seen(camera, colors, rng, radius=0.0, focus=DISTANCE, turning=0.0):
    """(SIZE, SIZE) light through a lens, of a wall that turns by ± `turning` rad about its middle."""
    pose = np.asarray(camera.world_to_camera)
    rows, columns = np.mgrid[:SIZE, :SIZE]
    total = np.zeros((SIZE, SIZE))
    for _ in range(RAYS):
        x, y = columns + rng.random((SIZE, SIZE)), rows + rng.random((SIZE, SIZE))
        way = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=2)
        away, around = radius * np.sqrt(rng.random((SIZE, SIZE))), 2 * np.pi * rng.random((SIZE, SIZE))
        start = np.stack([away * np.cos(around), away * np.sin(around), np.zeros_like(x)], axis=2)
        way = (focus * way - start) @ pose[:3, :3]
        start = start @ pose[:3, :3] + camera.center
        hit = start[:, :, :2] - (start[:, :, 2] / way[:, :, 2])[:, :, None] * way[:, :, :2]
        turn = turning * rng.uniform(-1, 1, (SIZE, SIZE))
        hit = np.stack(
            [
                np.cos(turn) * hit[:, :, 0] - np.sin(turn) * hit[:, :, 1],
                np.sin(turn) * hit[:, :, 0] + np.cos(turn) * hit[:, :, 1],
            ]
        )
        inside = np.abs(hit).max(axis=0) < HALF
        patch = np.clip(((hit + HALF) / PATCH).astype(int), 0, len(colors) - 1)
        total += np.where(inside, colors[patch[0], patch[1]], BEHIND)
    return total / RAYS


def taken(seed, radius=0.0, focuses=None, turning=0.0, soft=0.0):
    """Photos (SIZE, SIZE, 3) with a little noise."""
    rng = np.random.default_rng(seed)
    count = int(2 * HALF / PATCH)
    colors = rng.choice([0.08, 0.3, 0.55, 0.95], (count, count))
    focuses = DISTANCE + rng.uniform(-25, 25, PHOTOS) if focuses is None else np.full(PHOTOS, focuses)
    photos = []
    for camera, focus in zip(CAMERAS, focuses, strict=True):
        light = seen(camera, colors, rng, radius, focus, turning)
        image = gaussian_filter(light, soft * rng.uniform(0.3, 1)) if soft else light
        photos.append(np.repeat((image + 0.005 * rng.standard_normal(image.shape))[:, :, None], 3, axis=2))
    return photos


@pytest.fixture
def evidence(photographs, tmp_path):
    def gather(images, points=None, cameras=CAMERAS, long_side=SIZE):
        if points is None:
            places = np.random.default_rng(9).uniform(-HALF, HALF, (1500, 2))
            points = np.concatenate([places, np.zeros((1500, 1))], axis=1)
        return PhotoEvidence(Photos(photographs.saved(tmp_path, cameras, images)), points, long_side)

    return gather


# Circles of 0, 0.4, 2 and 3 px as a rule, by lenses of so many mm.
STRENGTHS = ((0.0, False), (2.0, False), (12.0, True), (18.0, True))


@pytest.mark.parametrize(("radius", "found"), STRENGTHS)
def test_found_from_one_pixel(radius, found, evidence):
    finding = defocus.detect(evidence(taken(0, radius)))
    assert finding.found is found
    # Circles that are wider than half a patch are seen smaller than they are.
    exact = CAMERAS[0].fx * radius * np.sqrt(np.mean([apart(camera, radius) for camera in CAMERAS]))
    assert finding.strength == pytest.approx(exact, rel=0.35, abs=3 * finding.error)
    assert finding.unit == "px"


def apart(camera, radius):
    """Mean square of the differences of inverse depths on the wall from that of the focus, which is 25 mm off."""
    places = np.mgrid[-HALF:HALF:20j, -HALF:HALF:20j].reshape(2, -1)
    matrix = np.asarray(camera.world_to_camera)
    inverse = 1 / (matrix[2, :2] @ places + matrix[2, 3])
    return np.mean((inverse - inverse.mean()) ** 2) + (25 / np.sqrt(3) / DISTANCE**2) ** 2


@pytest.mark.slow
def test_right_on_nearly_all_seeds(evidence):
    for radius, found in STRENGTHS[:3]:
        right = [defocus.detect(evidence(taken(seed, radius))).found is found for seed in range(20)]
        assert np.mean(right) >= 0.95, radius


@pytest.mark.slow
def test_circles_nearly_as_wide_as_what_lies_between_edges_are_found_or_cannot_be_told(evidence):
    """Patches are 20 px wide here, the largest circles 12 px: few edges stand alone, and errors grow."""
    answers = [defocus.detect(evidence(taken(seed, STRENGTHS[3][0]))).found for seed in range(20)]
    assert False not in answers
    assert np.mean([answer is True for answer in answers]) > 0.5


def test_photos_that_are_all_sharp_in_the_same_depth_are_found(evidence):
    assert defocus.detect(evidence(taken(0, 12.0, focuses=DISTANCE))).found is True


def test_photos_that_are_soft_all_over_have_no_focus(evidence):
    assert defocus.detect(evidence(taken(0, soft=1.5))).found is False


@pytest.mark.parametrize("turning", [0.05, 0.1])
def test_an_object_that_turns_is_not_out_of_focus(turning, evidence):
    """What is near and far moves, what is between does not."""
    assert defocus.detect(evidence(taken(0, turning=turning))).found is not True


def test_a_size_of_training_has_its_own_pixels(evidence):
    images = taken(0, 12.0)
    whole, half = (defocus.detect(evidence(images, long_side=side)) for side in (SIZE, SIZE // 2))
    assert half.strength == pytest.approx(whole.strength / 2)
    assert half.found is not True


def test_cannot_tell_what_is_all_as_far_away(evidence):
    cameras = [camera_at(2 * np.pi * index / PHOTOS, tilt=0.01) for index in range(PHOTOS)]
    colors = np.random.default_rng(0).choice([0.1, 0.5, 0.9], (6, 6))
    images = [np.repeat(seen(camera, colors, np.random.default_rng(0))[:, :, None], 3, axis=2) for camera in cameras]
    finding = defocus.detect(evidence(images, cameras=cameras))
    assert finding.found is None
    assert "as far away" in finding.reason


def test_cannot_tell_without_points_or_edges(evidence):
    given = evidence([np.full((SIZE, SIZE, 3), 0.5)] * PHOTOS)
    assert "Too few photos show 100 edges" in defocus.detect(given).reason
    assert defocus.detect(given).found is None
    assert defocus.detect(replace(given, points=np.zeros((0, 3)))).found is None


def test_held_out_photos_have_no_say(evidence):
    given = evidence(taken(0, 12.0))
    photos = [replace(photo, held_out=place >= 2) for place, photo in enumerate(given.photos.photos)]
    assert defocus.detect(replace(given, photos=Photos(photos))).found is None, "two are too few"


@pytest.mark.parametrize(("radius", "used"), [(0.0, False), (12.0, True)])
def test_auto_uses_it_where_it_is_found(radius, used, evidence):
    request = parse_effects("auto,-exposure,-pixel_integration,-rolling_shutter,-motion_blur")
    (row,) = look_at_photos(request, evidence(taken(0, radius))).rows
    assert (row["name"], row["used"], row["chosen_by"]) == ("defocus", used, "auto")


class TestEdges:
    @pytest.mark.parametrize("width", [0.5, 1.0, 1.5, 2.5])
    @pytest.mark.parametrize("turn", [0.0, 0.4, np.pi / 4])
    def test_a_blurred_step_is_as_wide_as_it_was_blurred(self, width, turn):
        rng = np.random.default_rng(0)
        rows, columns = np.mgrid[:400, :400] / 4 - 50
        fine = (np.cos(turn) * columns + np.sin(turn) * rows > 0.2).astype(float)
        image = gaussian_filter(fine, 4 * width).reshape(100, 4, 100, 4).mean(axis=(1, 3))
        found = edges(np.repeat((image + 0.02 * rng.standard_normal(image.shape))[:, :, None], 3, axis=2))
        # A pixel is 1 / 12 px² wide itself.
        assert np.sqrt(np.median(found.width2)) == pytest.approx(np.sqrt(width**2 + 1 / 12), abs=0.13)
        assert np.median(found.direction) == pytest.approx(turn, abs=0.05)

    def test_the_sides_of_a_line_are_left_out(self):
        image = np.zeros((60, 60, 3))
        image[:, 30:] = 0.5
        image[:, 10:13] = 1.0
        assert set(edges(image).place[:, 0]) <= {29, 30}

    def test_a_point_behind_others_is_not_in_front(self):
        camera = camera_at(0.0, tilt=0.0001)
        wall = np.stack([*np.mgrid[-20:20:30j, -20:20:30j].reshape(2, -1), np.zeros(900)], axis=1)
        points = np.concatenate([wall, [[0.0, 0.0, -30.0], [0.0, 0.0, 5.0]]])
        shown, depth = front(points, camera, 4.0, 8.0)
        assert 900 not in shown
        assert {450, 901} <= set(shown.tolist())
        assert depth[shown == 901] == pytest.approx(DISTANCE - 5, abs=0.1)
