"""Backgrounds that are the same image, and that image without what stands before it."""

import cv2
import numpy as np
import pytest

from insideout.core.capture.backdrop import object_mask
from insideout.core.effects.look.still import (
    alike,
    groups,
    in_one_light,
    is_background,
    is_covered,
    most_common,
    tolerance_of,
    torn,
)
from insideout.core.phantoms.photos import exposed
from insideout.core.phantoms.room import room

SIZE, COUNT = 48, 12


def still(seed=0, count=COUNT, noise=0.0):
    """Bytes of photos of one room, before which a square goes from left to right."""
    rng = np.random.default_rng(seed)
    behind = room(SIZE, SIZE, 0.1, rng)
    photos = np.tile(behind, (count, 1, 1, 1)) + noise * rng.standard_normal((count, SIZE, SIZE, 3))
    for index, photo in enumerate(photos):
        left = 6 + round(24 * index / (count - 1))
        photo[16:32, left : left + 12] = rng.random(3)
    return np.round(255 * photos.clip(0, 1)).astype(np.uint8), behind


def as_floats(levels):
    return [image / 255 for image in levels]


def test_patterns_at_the_same_pixels_are_alike_and_others_are_not():
    same, textures, patches = alike(as_floats(still(noise=0.01)[0]))
    other, _, _ = alike([room(SIZE, SIZE, 0.1, np.random.default_rng(seed)) for seed in range(COUNT)])
    apart = ~np.eye(COUNT, dtype=bool)
    assert same[apart].min() > 0.8
    assert np.abs(other[apart]).max() < 0.4
    assert np.isnan(np.diag(same)).all()
    assert (textures > 0.02).all()
    assert (patches > 100).all()


def barred(images, kind):
    """Photos with black bars above and below, or black or white corners."""
    height, width = images[0].shape[:2]
    y, x = np.mgrid[:height, :width]
    if kind == "bars":
        empty = np.abs(y - height / 2) > 0.44 * height
    else:
        empty = np.hypot(2 * x / width - 1, 2 * y / height - 1) > 1.2
    return [np.where(empty[..., None], float(kind == "white corners"), image) for image in images]


@pytest.mark.parametrize("kind", ["bars", "corners", "white corners"])
def test_what_photos_do_not_fill_makes_them_no_more_alike(kind):
    rooms = [room(96, 72, 0.1, np.random.default_rng(seed)) for seed in range(COUNT)]
    apart = ~np.eye(COUNT, dtype=bool)
    found, textures, _ = alike(barred(rooms, kind))
    assert np.abs(np.median(found[apart])) < 0.1
    assert found[apart].max() < 0.5
    assert (textures < 0.09).all()
    same, _, _ = alike(barred(as_floats(still(noise=0.01)[0]), kind))
    assert same[apart].min() > 0.8


def test_photos_of_which_nothing_is_shown_are_not_compared():
    found, textures, _ = alike([np.zeros((SIZE, SIZE, 3))] * 3)
    assert np.isnan(found).all()
    assert (textures == 0).all()


def test_noise_is_told_beside_bars():
    levels = still(noise=0.02)[0]
    levels[:, :9] = levels[:, -9:] = 0
    assert tolerance_of(levels) == pytest.approx(0.08, rel=0.15)


def test_photos_of_several_sizes_are_not_compared():
    images = [*as_floats(still()[0]), *[np.zeros((SIZE, 2 * SIZE, 3))] * 2]
    correlations, _, _ = alike(images)
    assert np.isnan(correlations[:COUNT, COUNT:]).all()
    assert np.isfinite(correlations[0, 1])


def test_a_camera_that_stood_at_two_heights_has_two_backgrounds():
    images = [image for seed in (0, 1) for image in as_floats(still(seed)[0])]
    images.append(room(SIZE, SIZE, 0.1, np.random.default_rng(7)))
    found = groups(alike(images)[0], 0.5)
    assert [members.tolist() for members in found] == [list(range(COUNT)), list(range(COUNT, 2 * COUNT))]
    assert groups(np.full((1, 1), np.nan), 0.5) == []


def test_few_photos_that_are_alike_by_chance_are_no_group():
    correlations = np.full((30, 30), 0.1)
    correlations[:4, :4] = 0.9
    np.fill_diagonal(correlations, np.nan)
    assert groups(correlations, 0.5) == []


def test_the_background_is_what_most_photos_show():
    levels, behind = still()
    plate, share = most_common(levels, 0.03)
    assert np.abs(plate - behind).max() < 0.01
    assert share.min() > 0.3
    assert is_background(levels, plate, share, 0.03).mean() > 0.98
    assert 0.1 < is_covered(share) < 0.6


def test_it_is_found_where_hardly_a_third_of_the_photos_show_it():
    levels, behind = still()
    rng = np.random.default_rng(3)
    for image in levels[4:]:
        image[20:28, 20:28] = np.round(255 * rng.random(3))
    plate, _ = most_common(levels, 0.03)
    assert np.abs(plate - behind)[20:28, 20:28].max() < 0.01


def known_of(levels):
    tolerance = tolerance_of(levels)
    plate, share = most_common(levels, tolerance)
    return is_background(levels, plate, share, tolerance)


def test_what_looks_the_same_from_all_sides_is_the_objects_unless_it_reaches_the_border():
    rng = np.random.default_rng(0)
    levels = np.tile(np.round(255 * room(40, 40, 0.1, rng)).astype(np.uint8), (COUNT, 1, 1, 1))
    levels[::2, 8:32, 8:32] = rng.integers(0, 255, (COUNT // 2, 1, 1, 3))
    levels[:, 14:26, 14:26] = 90
    known = known_of(levels)
    assert not known[14:26, 14:26].any()
    assert known[:6].all()
    assert known[8:12, 8:12].all()
    levels[:, 8:32, 8:32] = rng.integers(0, 255, (COUNT, 1, 1, 3))
    assert not known_of(levels)[10:12, 10:12].any(), "seen by one"


def turning(shade, noise, count=24, side=96, seed=2):
    """Bytes of photos of a body in one colour, now wide and now narrow, whose sides are lit and rough by `shade`; where
    it is in each, (count, side, side)."""
    rng = np.random.default_rng(seed)
    behind, y = room(side, side, 0.1, rng), np.mgrid[:side, :side][0]
    photos, masks = [], []
    for index in range(count):
        wide = 26 + 6 * np.sin(2 * np.pi * index / count)
        mask = (np.abs(np.arange(side) - side / 2)[None] < wide) & (np.abs(y - side / 2) < 38)
        lit = 1 + 10 * shade * (room(side, side, 0.1, rng).mean(axis=-1, keepdims=True) - 0.49)
        photo = np.where(mask[..., None], np.array([0.62, 0.42, 0.32]) * lit, behind)
        photos.append(photo + noise * rng.standard_normal(photo.shape))
        masks.append(mask)
    return np.round(255 * np.stack(photos).clip(0, 1)).astype(np.uint8), np.stack(masks)


@pytest.mark.parametrize("shade", [0.05, 0.1])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_an_object_of_one_colour_that_always_covers_the_middle_stays_whole(shade, noise):
    levels, masks = turning(shade, noise)
    tolerance = tolerance_of(levels)
    plate, share = most_common(levels, tolerance)
    known = is_background(levels, plate, share, tolerance)
    seen = [object_mask(image / np.float32(255), plate, known, tolerance) for image in levels]
    lost = [(~one)[mask].mean() for one, mask in zip(seen, masks, strict=True)]
    kept = [one[~mask].mean() for one, mask in zip(seen, masks, strict=True)]
    assert np.mean(lost) < 0.02
    assert np.max(lost) < 0.04
    assert np.mean(kept) < 0.06
    assert np.mean([torn(one) for one in seen]) < 0.03


def test_a_room_that_is_noisier_in_some_places_is_known_there_too():
    rng = np.random.default_rng(4)
    levels, _ = still(noise=0.0)
    noise = np.where(np.arange(SIZE) < SIZE // 3, 2.5, 1.5)[None, None, :, None]
    noisy = np.clip(levels + noise * rng.standard_normal(levels.shape), 0, 255)
    assert known_of(np.round(noisy).astype(np.uint8)).mean() > 0.95


def test_of_jpegs_the_room_is_known_too_and_the_object_stays_whole():
    levels, masks = turning(0.1, 0.01, side=192)
    packed = [cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 85])[1] for image in levels]
    levels = np.stack([cv2.imdecode(one, cv2.IMREAD_COLOR) for one in packed])
    known = known_of(levels)
    assert known[~masks.any(axis=0)].mean() > 0.95
    assert known[masks.all(axis=0)].mean() < 0.02


def test_an_object_cut_into_stripes_is_torn_and_a_whole_one_with_a_handle_is_not():
    y, x = np.mgrid[:200, :300]
    whole = np.abs(y - 100) < 60
    whole &= np.abs(x - 150) < 50
    handle = np.abs(np.hypot(y - 100, x - 200) - 22) < 4
    assert torn(whole) == 0
    assert torn(whole | handle) < 0.12
    assert torn(whole & (x % 20 < 12)) > 0.3
    assert torn(np.zeros_like(whole)) == 0


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.02])
def test_the_tolerance_is_above_noise(noise):
    tolerance = tolerance_of(still(noise=noise)[0])
    assert tolerance == pytest.approx(max(0.03, 4 * noise), rel=0.15)


def test_exposures_are_evened_out_before_photos_are_compared():
    levels, behind = still()
    assert in_one_light(levels) is levels
    gains = np.exp2(np.linspace(-0.5, 0.5, COUNT))
    differing = np.stack([exposed(image, (gain,) * 3) for image, gain in zip(levels, gains, strict=True)])
    assert np.abs(in_one_light(differing)[:, 0].astype(int) - np.round(255 * behind[0])).max() <= 4
    plate, share = most_common(in_one_light(differing), 0.03)
    assert np.abs(plate - behind).max() < 0.02
    assert share[0].min() == 1


def test_looking_can_be_stopped():
    class StoppedError(Exception):
        pass

    def tick():
        raise StoppedError

    with pytest.raises(StoppedError):
        most_common(still()[0], 0.03, tick)
