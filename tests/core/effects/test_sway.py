"""Which photos are found to be blurred by motion: of a slanted wall of patches, seen from all around."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from insideout.core.capture.model import Photos
from insideout.core.effects import motion_blur
from insideout.core.effects.choose import look_at_photos
from insideout.core.effects.photos import PhotoEvidence
from insideout.core.effects.request import parse_effects
from insideout.core.views import Camera

SIZE, DISTANCE, HALF, PATCH = 120, 200.0, 45.0, 15.0
PHOTOS, RAYS, BEHIND = 10, 16, 0.78


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


def seen(camera, colors, rng, motion=(0.0, 0.0), radius=0.0, turning=0.0):
    """(SIZE, SIZE) light, of a camera that turns so that the image moves by `motion` px, through a lens of `radius` mm
    that is sharp in front of the wall, of a wall that turns by ± `turning` rad about its middle."""
    pose, focus = np.asarray(camera.world_to_camera), 0.9 * DISTANCE
    rows, columns = np.mgrid[:SIZE, :SIZE]
    total = np.zeros((SIZE, SIZE))
    for _ in range(RAYS):
        time = rng.uniform(-0.5, 0.5, (SIZE, SIZE))
        x, y = columns + rng.random((SIZE, SIZE)) + motion[0] * time, rows + rng.random((SIZE, SIZE)) + motion[1] * time
        way = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=2)
        away, around = radius * np.sqrt(rng.random((SIZE, SIZE))), 2 * np.pi * rng.random((SIZE, SIZE))
        start = np.stack([away * np.cos(around), away * np.sin(around), np.zeros_like(x)], axis=2)
        way, start = (focus * way - start) @ pose[:3, :3], start @ pose[:3, :3] + camera.center
        hit = start[:, :, :2] - (start[:, :, 2] / way[:, :, 2])[:, :, None] * way[:, :, :2]
        cos, sin = np.cos(2 * turning * time), np.sin(2 * turning * time)
        hit = np.stack([cos * hit[:, :, 0] - sin * hit[:, :, 1], sin * hit[:, :, 0] + cos * hit[:, :, 1]])
        patch = np.clip(((hit + HALF) / (2 * HALF) * len(colors)).astype(int), 0, len(colors) - 1)
        total += np.where(np.abs(hit).max(axis=0) < HALF, colors[patch[0], patch[1]], BEHIND)
    return total / RAYS


def any_way(px, rng):
    """(PHOTOS, 2) motions of `px` in directions of their own."""
    angles = rng.uniform(0, 2 * np.pi, PHOTOS)
    return px * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def taken(seed, motions=None, soften=None, **how):
    """Photos (SIZE, SIZE, 3) with a little noise."""
    rng = np.random.default_rng(seed)
    count = int(2 * HALF / PATCH)
    colors = rng.choice([0.08, 0.3, 0.55, 0.95], (count, count))
    photos = []
    for place, camera in enumerate(CAMERAS):
        light = seen(camera, colors, rng, (0.0, 0.0) if motions is None else motions[place], **how)
        image = light if soften is None else soften(light, rng)
        photos.append(np.repeat((image + 0.005 * rng.standard_normal(image.shape))[:, :, None], 3, axis=2))
    return photos


def moved(seed, px):
    return taken(seed, any_way(px, np.random.default_rng(100 + seed)))


@pytest.fixture
def evidence(photographs, tmp_path):
    def gather(images, points=None, cameras=CAMERAS, long_side=SIZE):
        if points is None:
            places = np.random.default_rng(9).uniform(-HALF, HALF, (1500, 2))
            points = np.concatenate([places, np.zeros((1500, 1))], axis=1)
        return PhotoEvidence(Photos(photographs.saved(tmp_path, cameras, images)), points, long_side)

    return gather


STRENGTHS = ((0.0, False), (1.0, False), (4.0, True), (6.0, True))


@pytest.mark.parametrize(("px", "found"), STRENGTHS)
def test_found_from_two_and_a_half_pixels(px, found, evidence):
    finding = motion_blur.detect(evidence(moved(0, px)))
    assert finding.found is found
    # Patches that are seen at a slant look a little wider one way.
    assert finding.strength == pytest.approx(px, rel=0.15) if found else finding.strength < 2.0
    assert finding.unit == "px"


@pytest.mark.slow
@pytest.mark.parametrize(("px", "found"), STRENGTHS)
def test_right_on_nearly_all_seeds(px, found, evidence):
    right = [motion_blur.detect(evidence(moved(seed, px))).found is found for seed in range(20)]
    assert np.mean(right) >= 0.95


SILENT = {
    "out of focus": {"radius": 12.0},
    "soft": {"soften": lambda light, rng: gaussian_filter(light, 1.5 * rng.uniform(0.3, 1))},
}


@pytest.mark.parametrize("how", SILENT)
def test_photos_that_are_wide_in_all_directions_are_not_moved(how, evidence):
    assert motion_blur.detect(evidence(taken(0, **SILENT[how]))).found is not True


@pytest.mark.slow
@pytest.mark.parametrize("how", SILENT)
def test_silent_on_nearly_all_seeds_of_those(how, evidence):
    silent = [motion_blur.detect(evidence(taken(seed, **SILENT[how]))).found is not True for seed in range(20)]
    assert np.mean(silent) >= 0.95


def test_the_same_motion_in_all_photos_is_found(evidence):
    finding = motion_blur.detect(evidence(taken(0, [(4.0, 0.0)] * PHOTOS)))
    assert finding.found is True
    assert finding.strength == pytest.approx(4.0, rel=0.2)


def test_an_object_that_turns_is_not_called_still(evidence):
    """What is near moves to one side and what is far to the other; edges between that stand still make it less sure."""
    assert motion_blur.detect(evidence(taken(0, turning=0.08))).found is not False


def test_a_few_blurred_photos_among_sharp_ones_count(evidence):
    motions = np.zeros((PHOTOS, 2))
    motions[:3] = any_way(6.0, np.random.default_rng(0))[:3]
    finding = motion_blur.detect(evidence(taken(0, motions)))
    assert finding.found is True
    # Edges of the same place in the sharp ones are among what it is told by.
    assert finding.strength == pytest.approx(6.0 * 0.3**0.25, rel=0.3)


def test_a_size_of_training_has_its_own_pixels(evidence):
    images = moved(0, 4.0)
    whole, half = (motion_blur.detect(evidence(images, long_side=side)) for side in (SIZE, SIZE // 2))
    assert half.strength == pytest.approx(whole.strength / 2)
    assert half.found is False


def test_photos_that_are_looked_at_smaller_than_they_are_trained_have_a_higher_threshold(evidence, monkeypatch):
    given = evidence(moved(0, 4.0))
    monkeypatch.setattr(PhotoEvidence, "pixels_of_training", 3.0)
    finding = motion_blur.detect(given)
    assert finding.threshold == pytest.approx(7.5)
    assert finding.found is True
    assert "from 7.5 px" in finding.reason


def test_cannot_tell_without_points_or_edges(evidence):
    given = evidence([np.full((SIZE, SIZE, 3), 0.5)] * PHOTOS)
    assert "Too few photos show 100 edges" in motion_blur.detect(given).reason
    assert motion_blur.detect(given).found is None
    assert motion_blur.detect(replace(given, points=np.zeros((0, 3)))).found is None


def test_held_out_photos_have_no_say(evidence):
    given = evidence(moved(0, 4.0))
    photos = [replace(photo, held_out=place >= 2) for place, photo in enumerate(given.photos.photos)]
    assert motion_blur.detect(replace(given, photos=Photos(photos))).found is None, "two are too few"


@pytest.mark.parametrize(("px", "used"), [(0.0, []), (4.0, ["motion_blur"])])
def test_auto_uses_it_where_it_is_found(px, used, evidence):
    request = parse_effects("auto,-exposure,-pixel_integration")
    rows = look_at_photos(request, evidence(moved(0, px))).rows
    assert [row["name"] for row in rows] == ["rolling_shutter", "defocus", "motion_blur"]
    assert [row["name"] for row in rows if row["used"]] == used


@pytest.mark.parametrize(
    ("asked", "used", "left"),
    [("auto,defocus", "defocus", "motion_blur"), ("motion_blur,auto", "motion_blur", "defocus"),
     ("auto", "motion_blur", "defocus")],
)  # fmt: skip
def test_a_lens_and_a_motion_are_not_learnt_at_once(asked, used, left, evidence, monkeypatch):
    from insideout.core.effects import defocus
    from insideout.core.effects.finding import EffectFinding
    from insideout.core.told import Told

    monkeypatch.setattr(defocus, "detect", lambda _: EffectFinding("defocus", True, 2.0, "px", 1.0, Told("So it is.")))
    request = parse_effects(f"{asked},-exposure,-pixel_integration,-rolling_shutter")
    rows = {row["name"]: row for row in look_at_photos(request, evidence(moved(0, 6.0))).rows}
    assert (rows[used]["used"], rows[left]["used"]) == (True, False)
    assert rows[left]["found"] is True
    assert rows[left]["reason"].endswith(f"It is not used: {used} is, and not both can be.")


def test_what_gives_way_itself_drives_nothing_out(evidence, monkeypatch):
    from insideout.core.effects import defocus, rolling_shutter
    from insideout.core.effects.finding import EffectFinding
    from insideout.core.told import Told

    for module, name in ((defocus, "defocus"), (rolling_shutter, "rolling_shutter")):
        sure = EffectFinding(name, True, 2.0, "px", 1.0, Told("So it is."))
        monkeypatch.setattr(module, "detect", lambda _, sure=sure: sure)
    request = parse_effects("auto,rolling_shutter,-exposure,-pixel_integration")
    rows = look_at_photos(request, evidence(moved(0, 6.0))).rows
    assert [row["name"] for row in rows if row["used"]] == ["rolling_shutter", "defocus"]
    assert "rolling_shutter is" in rows[-1]["reason"]
