"""A room that stands still while the object turns is told from one that turns with it, and taken out."""

import tracemalloc
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from insideout.core.capture.backdrop import in_light
from insideout.core.capture.model import Photo, Photos
from insideout.core.capture.photos import read_bare
from insideout.core.effects import moving_background
from insideout.core.effects.choose import look_at_background
from insideout.core.effects.moving_background import BareEvidence
from insideout.core.effects.request import parse_effects
from insideout.core.evaluate.photos import photo_background
from insideout.core.gaussians import GaussianSet
from insideout.core.phantoms.room import room
from insideout.core.phantoms.shots import camera_ring
from insideout.core.render import splat
from insideout.core.spherical_harmonics import rgb_to_sh

SIZE, COUNT = 64, 20
CAMERAS = camera_ring(COUNT, 60.0, SIZE, SIZE, np.random.default_rng(0))


def object_set(seed=0):
    """Splats of all colours in a lying ellipsoid."""
    rng = np.random.default_rng(seed)
    means = rng.standard_normal((400, 3))
    means *= np.array([28.0, 14.0, 20.0]) / np.linalg.norm(means, axis=1, keepdims=True)
    sh = rgb_to_sh(rng.random((400, 3))).astype(np.float32)[:, None]
    return GaussianSet.create(means, 2.5, opacities=0.98, sh=sh).to_torch()


OBJECT = object_set()


def taken(behind, noise=0.0, seed=0):
    """Photos (H, W, 3) of the object before images (H, W, 3) or colours, one a camera."""
    rng, images = np.random.default_rng(seed), []
    for camera, back in zip(CAMERAS, behind, strict=True):
        with torch.no_grad():
            seen = splat(OBJECT, camera, torch.zeros(3))
        image = seen.color.numpy() + (1 - seen.alpha.numpy())[..., None] * back
        images.append(np.clip(image + noise * rng.standard_normal(image.shape), 0, 1))
    return images


def still(seed=0, contrast=0.1):
    return [room(SIZE, SIZE, contrast, np.random.default_rng([seed, 5]))] * COUNT


def around(seed=0):
    """A room far away all around, which an object shows that stands still in it: what each camera sees of it."""
    high, wide = 512, 1024
    sphere, views = room(wide, high, 0.1, np.random.default_rng([seed, 6])), []
    for camera in CAMERAS:
        x, y = (np.arange(SIZE) + 0.5 - SIZE / 2) / camera.fx, (np.arange(SIZE) + 0.5 - SIZE / 2) / camera.fy
        way = np.stack(np.broadcast_arrays(x[None], y[:, None], 1.0), axis=-1)
        way = way @ np.asarray(camera.world_to_camera)[:3, :3]
        way /= np.linalg.norm(way, axis=-1, keepdims=True)
        turn = (np.arctan2(way[..., 1], way[..., 0]) / (2 * np.pi) % 1 * wide).astype(int) % wide
        up = np.clip((0.5 - np.arcsin(way[..., 2]) / np.pi) * high, 0, high - 1).astype(int)
        views.append(sphere[up, turn])
    return views


def plain(color=(0.74, 0.79, 0.84)):
    return [np.array(color)] * COUNT


def gradient():
    return [np.linspace(0.3, 0.8, SIZE)[:, None, None] * np.ones((1, SIZE, 3))] * COUNT


@pytest.fixture
def evidence(photographs, tmp_path):
    def gather(images, posed=True):
        photos = photographs.saved(tmp_path / "photos", CAMERAS[: len(images)], images)
        return BareEvidence(Photos(photos if posed else [replace(photo, camera=None) for photo in photos]))

    return gather


@pytest.mark.parametrize("posed", [True, False])
@pytest.mark.parametrize(
    ("behind", "found"), [(still(), True), (around(), False), (plain(), False), (gradient(), None)]
)
def test_it_is_found_where_the_room_stands_still(behind, found, posed, evidence):
    finding = moving_background.detect(evidence(taken(behind, 0.01), posed))
    assert finding.found is found
    if found:
        assert finding.strength > 80
        assert finding.reason.endswith("and they become clouds around it.")
    elif finding.strength is not None:
        assert finding.strength < 30


def test_a_plain_background_of_several_exposures_is_plain(evidence):
    gains = np.exp2(np.linspace(-0.5, 0.5, COUNT))
    images = [
        in_light(image, np.full(3, gain)) for image, gain in zip(taken(plain((0.6, 0.6, 0.5))), gains, strict=True)
    ]
    finding = moving_background.detect(evidence(images))
    assert (finding.found, finding.strength) == (False, None)


def tables(seed=0, height=72, width=96):
    """Blurred rooms, each another, above a table whose edge is in the photos where it was in the others."""
    rng, images = np.random.default_rng(seed), []
    for _ in range(COUNT):
        edge = 0.55 * height + 0.015 * height * rng.standard_normal()
        table = np.clip(np.arange(height) - edge, 0, 1)[:, None, None]
        images.append(room(width, height, 0.03, rng) * (1 - table) + (0.4 + room(width, height, 0.02, rng)) * table)
    return [image.clip(0, 1) for image in images]


def unfilled(kind, seed=0, height=72, width=96):
    """Rooms that have nothing to do with each other, between black bars or in a round image."""
    rng, (y, x) = np.random.default_rng(seed), np.mgrid[:height, :width]
    empty = np.hypot(2 * x / width - 1, 2 * y / height - 1) > 1.15 if kind == "corners" else (y < 3) | (y >= height - 3)
    images = [room(width, height, 0.1, rng) for _ in range(COUNT)]
    return [np.where(empty[..., None], 0.0, image) for image in images]


@pytest.mark.parametrize(
    ("images", "most"),
    [(unfilled("bars"), 30), (unfilled("corners"), 30), (tables(), 65)],
    ids=["bars", "corners", "table"],
)
def test_photos_taken_around_are_no_turntable_whatever_they_share(images, most, evidence):
    finding = moving_background.detect(evidence(images, posed=False))
    assert finding.found is False
    assert finding.strength < most
    assert finding.error > 1


def test_a_turntable_is_found_in_photos_with_bars(evidence, tmp_path):
    images = taken(still(), 0.01)
    for image in images:
        image[:5] = image[-5:] = 0
    given = evidence(images, posed=False)
    finding = moving_background.detect(given)
    assert finding.found is True
    assert finding.strength > 90
    assert len(moving_background.taken_out(given, tmp_path).photos) == COUNT


@pytest.mark.slow
@pytest.mark.parametrize(("behind", "found"), [(still, True), (around, False), (lambda seed: plain(), False)])
def test_right_on_nearly_all_seeds(behind, found, evidence):
    seen = [evidence(taken(behind(seed), 0.02, seed), seed % 2 == 0) for seed in range(20)]
    assert np.mean([moving_background.detect(one).found is found for one in seen]) >= 0.95


def test_photos_of_an_object_and_a_camera_that_both_stand_still_are_not_taken_for_it(evidence):
    image = taken(still())[0]
    finding = moving_background.detect(evidence([image] * COUNT, posed=False))
    assert finding.found is None
    assert "nothing is seen to turn" in finding.reason


def test_cameras_that_stand_together_say_nothing(evidence):
    given = evidence(taken(still()))
    photos = [replace(photo, camera=CAMERAS[0]) for photo in given.photos.photos]
    finding = moving_background.detect(BareEvidence(Photos(photos)))
    assert finding.found is None
    assert "too few sides" in finding.reason


def test_held_out_photos_have_no_say(evidence):
    given = evidence(taken(still()))
    photos = [replace(photo, held_out=place >= 4) for place, photo in enumerate(given.photos.photos)]
    assert "4 photos, too few" in moving_background.detect(BareEvidence(Photos(photos))).reason


def test_photos_of_which_some_are_a_row_smaller_are_one_room(tmp_path):
    """As thumbnails of 400 pixels they have one size, as smaller ones they do not."""
    behind = cv2.resize(still()[0], (407, 320), interpolation=cv2.INTER_LINEAR)
    rng, (y, x), photos = np.random.default_rng(3), np.mgrid[:320, :407], []
    for index in range(12):
        image = behind.copy()
        image[np.hypot(y - 150, x - 170 - 5 * index) < 60] = rng.random(3)
        rows = 320 - index % 2
        path = tmp_path / f"{index:03d}.png"
        Image.fromarray(np.round(255 * image[:rows]).astype(np.uint8)).save(path)
        photos.append(Photo(path, None))
    evidence = BareEvidence(Photos(photos))
    assert len({image.shape for image in evidence.views}) == 1
    assert len({read_bare(photo, 160).shape for photo in photos}) == 2
    assert moving_background.detect(evidence).found is True
    assert len(moving_background.taken_out(evidence, tmp_path).photos) == 12


def test_a_room_is_made_of_bytes(monkeypatch, evidence, tmp_path):
    """Floats of all photos at once would take four times as much, and their stack as much again."""
    images, places = taken(still()), iter(range(COUNT))
    given = evidence(images)
    large = [cv2.resize(image, (320, 320)).astype(np.float32) for image in images]
    monkeypatch.setattr(moving_background, "read_bare", lambda *_: large[next(places)].copy())
    tracemalloc.start()
    levels = moving_background._read(given, given.photos.photos, 800)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert (levels.dtype, len(levels)) == (np.uint8, COUNT)
    assert peak < 3 * levels.nbytes


class TestTakenOut:
    def test_photos_are_those_before_a_plain_background(self, evidence, tmp_path):
        given = evidence(taken(still(), 0.005))
        found = moving_background.taken_out(given, tmp_path)
        assert len(found.photos) == COUNT
        backdrop = found.photos[0].backdrop
        assert all(photo.backdrop == backdrop for photo in found.photos)
        np.testing.assert_allclose(photo_background(found), backdrop.color, atol=0.01)
        wanted = taken(plain(backdrop.color))
        off = [np.abs(read_bare(photo, SIZE) - image) for photo, image in zip(found.photos, wanted, strict=True)]
        before = [np.abs(image - want) for image, want in zip(taken(still()), wanted, strict=True)]
        # Beside outlines as soft as these a little of the room stays.
        assert np.mean(off) < 0.06 * np.mean(before)

    def test_of_several_exposures_too(self, evidence, tmp_path):
        gains = np.exp2(np.linspace(-0.4, 0.4, COUNT))
        images = [in_light(image, np.full(3, gain)) for image, gain in zip(taken(still()), gains, strict=True)]
        given = evidence(images)
        assert moving_background.detect(given).found is True
        found = moving_background.taken_out(given, tmp_path)
        assert len(found.photos) == COUNT
        np.testing.assert_allclose(photo_background(found), found.photos[0].backdrop.color, atol=0.01)
        wanted = taken(plain(found.photos[0].backdrop.color))
        light = [
            read_bare(photo, SIZE).mean() / image.mean() for photo, image in zip(found.photos, wanted, strict=True)
        ]
        given_light = [image.mean() / even.mean() for image, even in zip(images, taken(still()), strict=True)]
        assert np.std(light) < 0.1 * np.std(given_light)

    def test_a_camera_at_two_heights_and_a_photo_from_elsewhere(self, evidence, tmp_path):
        behind = [*still(0)[:10], *still(1)[10:]]
        behind[4] = still(2)[0]
        choice, photos = look_at_background(parse_effects("auto"), evidence(taken(behind)), tmp_path)
        assert len({photo.backdrop.path for photo in photos.photos}) == 2
        assert [photo.path.name for photo in photos.photos if photo.path.name == "004.png"] == []
        (row,) = choice.rows
        assert row["used"]
        assert row["reason"].endswith("Left out, before another background: 1 of 20 photos.")

    def test_held_out_photos_are_taken_before_the_same(self, evidence, tmp_path):
        given = evidence(taken(still()))
        photos = [replace(photo, held_out=place % 8 == 0) for place, photo in enumerate(given.photos.photos)]
        found = moving_background.taken_out(BareEvidence(Photos(photos)), tmp_path)
        assert [photo.held_out for photo in found.photos] == [photo.held_out for photo in photos]
        assert found.photos[0].backdrop == found.photos[1].backdrop


def striped(seed=0):
    """A body of revolution in the room, every other band of which looks the same from all sides."""
    rng, (y, x) = np.random.default_rng(seed), np.mgrid[:SIZE, :SIZE]
    body = (np.abs(x - SIZE / 2) < 18) & (np.abs(y - SIZE / 2) < 26)
    painted = body & (y % 10 < 5)
    images = []
    for behind in still():
        image = np.where(body[..., None], np.array([0.8, 0.2, 0.1]), behind)
        image[painted] = rng.random((painted.sum(), 3))
        images.append(image)
    return images


class TestChoice:
    @pytest.mark.parametrize("effects", ["auto", "moving_background"])
    def test_an_object_that_would_be_torn_is_left_as_it_is(self, effects, evidence, tmp_path):
        given = evidence(striped())
        choice, photos = look_at_background(parse_effects(effects), given, tmp_path)
        (row,) = choice.rows
        assert photos is given.photos
        assert (row["found"], row["used"]) == (None, False)
        assert "The object has too much of one color to be told from the room" in row["reason"]
        assert "because you asked" not in row["reason"]
        assert not list(tmp_path.glob("backdrop-*"))

    def test_of_photos_that_share_too_little_it_says_so(self, evidence, tmp_path):
        given = evidence(taken(around()))
        choice, photos = look_at_background(parse_effects("moving_background"), given, tmp_path)
        (row,) = choice.rows
        assert photos is given.photos
        assert (row["found"], row["used"]) == (False, False)
        assert row["reason"].endswith(". Too few photos share a background; it is left as it is.")

    def test_what_is_asked_for_is_left_where_there_is_nothing_to_take_out(self, evidence, tmp_path):
        given = evidence(taken(plain()))
        choice, photos = look_at_background(parse_effects("moving_background"), given, tmp_path)
        (row,) = choice.rows
        assert photos is given.photos
        assert (row["found"], row["used"], row["half"]) == (False, False, "photos")
        assert row["reason"] == "The background is plain; nothing of it can disagree. There is nothing to take out."
        assert not list(tmp_path.glob("backdrop-*"))

    def test_what_is_asked_for_and_cannot_be_told_is_not_said_to_be_nothing(self, evidence, tmp_path):
        given = evidence(taken(still())[:3])
        choice, photos = look_at_background(parse_effects("moving_background"), given, tmp_path)
        assert photos is given.photos
        (row,) = choice.rows
        assert (row["found"], row["used"]) == (None, False)
        assert row["reason"].endswith(
            "too few to tell what stands still in them. It is not used: it could not be measured."
        )

    def test_what_auto_finds_is_used_and_timed(self, evidence, tmp_path):
        choice, photos = look_at_background(parse_effects("auto"), evidence(taken(still())), tmp_path)
        (row,) = choice.rows
        assert row["used"]
        assert row["chosen_by"] == "auto"
        assert row["seconds"] > 0
        assert all(photo.backdrop is not None for photo in photos.photos)

    def test_looking_can_be_stopped(self, evidence, tmp_path):
        class StoppedError(Exception):
            pass

        given, ticks = evidence(taken(still())), iter(range(1000))

        def tick():
            if next(ticks) == 40:
                raise StoppedError

        with pytest.raises(StoppedError):
            look_at_background(parse_effects("auto"), replace(given, tick=tick), tmp_path)
