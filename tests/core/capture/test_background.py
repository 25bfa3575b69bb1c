"""Telling a plain background and the object in front of it."""

from __future__ import annotations

import numpy as np
import pytest

from insideout.core.capture.background import foreground_mask, foreground_masks, plain_background
from insideout.core.srgb import linear_to_srgb, srgb_to_linear

GREY = np.array([0.73, 0.74, 0.76])


def _photo(seed=0, noise=0.01, hole=False):
    """A disc of many colours in front of grey."""
    random = np.random.default_rng(seed)
    rows, columns = np.mgrid[:80, :100]
    disc = np.hypot(rows - 40, columns - 50) < 25
    if hole:
        disc &= np.hypot(rows - 40, columns - 50) > 8
    image = np.where(disc[..., None], random.uniform(0, 0.6, (80, 100, 3)), GREY)
    return np.clip(image + random.normal(0, noise, image.shape), 0, 1), disc


def test_the_colour_that_all_borders_share_is_found():
    color = plain_background([_photo(seed)[0] for seed in range(4)])
    assert color == pytest.approx(GREY, abs=0.005)


def test_busy_or_differing_borders_are_not_plain():
    random = np.random.default_rng(0)
    assert plain_background([random.random((40, 50, 3)) for _ in range(3)]) is None
    assert plain_background([np.full((40, 50, 3), value) for value in (0.1, 0.5, 0.9)]) is None
    assert plain_background([]) is None


@pytest.mark.parametrize("stops", [0.3, 0.6])
def test_one_that_photos_show_in_lights_of_their_own_is_plain_too(stops):
    """Exposures 0.3 stops apart left a terracotta figure's photos without a background, and its model in a fog: 15 dB
    in place of 36. The colour is that of the mean exposure."""
    gains = 2 ** (stops * np.array([-1.2, 0.4, 1.1, -0.3, 0.9, -0.9]))
    photos = [linear_to_srgb(np.clip(gain * srgb_to_linear(_photo(seed)[0]), 0, 1)) for seed, gain in enumerate(gains)]
    assert plain_background(photos) == pytest.approx(GREY, abs=0.01)
    masks = foreground_masks(photos, plain_background(photos))
    for seed, mask in enumerate(masks):
        disc = _photo(seed)[1]
        assert (mask & disc).sum() / (mask | disc).sum() > 0.95


def test_one_photo_with_something_dark_at_its_border_darkens_no_background():
    gains = 2 ** (0.4 * np.array([-1.2, 0.4, 1.1, -0.3, 0.9, -0.9, 0.2, -0.6, 0.4]))
    lights = [np.clip(gain * srgb_to_linear(_photo(seed)[0]), 0, 1) for seed, gain in enumerate(gains)]
    near = np.where(_photo(9)[1][..., None], 0.4, 0.0008) * np.ones(3)
    found = plain_background([linear_to_srgb(light) for light in [*lights, near]])
    assert found == pytest.approx(GREY, abs=0.02)


def test_a_wall_that_fills_photos_in_several_exposures_is_no_background():
    rng = np.random.default_rng(0)
    walls = [linear_to_srgb(gain * 0.3) + rng.normal(0, 0.005, (80, 100, 3)) for gain in (0.6, 1.0, 1.8)]
    assert plain_background(walls) is None


def test_backgrounds_of_several_colours_are_none():
    grey, blue = _photo(0)[0], np.where(_photo(1)[1][..., None], 0.2, [0.2, 0.3, 0.7])
    assert plain_background([grey, blue, grey, blue]) is None


def test_an_object_may_touch_the_border_here_and_there():
    photos = [_photo(seed)[0] for seed in range(6)]
    photos[0] = photos[0].copy()
    photos[0][:, -30:] = 0.1
    assert plain_background(photos) == pytest.approx(GREY, abs=0.01)


def test_the_mask_is_the_object():
    image, disc = _photo()
    mask = foreground_mask(image, GREY)
    assert (mask & disc).sum() / (mask | disc).sum() > 0.98


@pytest.mark.parametrize("stops", [-1.0, 0.5])
def test_the_mask_of_a_photo_that_is_exposed_otherwise_is_the_object(stops):
    """Though its background is not the colour that most photos share."""
    image, disc = _photo()
    mask = foreground_mask(np.clip(image * 2 ** (stops / 2.2), 0, 1), GREY)
    assert (mask & disc).sum() / (mask | disc).sum() > 0.98


@pytest.mark.parametrize("detail", [0, 12, 16])
@pytest.mark.parametrize("color", [(0.85, 0.6, 0.5), (0.05, 0.05, 0.05), (0.5, 0.5, 0.5)])
def test_an_object_of_one_colour_that_fills_the_photo_is_no_background(color, detail):
    """Nor is what little else it has, 4 or 7 % of the photo, all of the object: in others it is a quarter, and a part
    of it has the colour."""
    near = np.full((60, 60, 3), color)
    near[24 : 24 + detail, 24 : 24 + detail] = 0.9, 0.2, 0.1
    others = [_photo(seed)[0] for seed in range(3)]
    for other in others:
        other[40:55, 35:65] = color
    assert foreground_masks([near, *others], GREY)[0].all()


@pytest.mark.parametrize("light", [0.85, 1.0, 1.15])
@pytest.mark.parametrize("color", [(0.3, 0.2, 0.2), (0.68, 0.68, 0.68), (0.92, 0.92, 0.92)])
def test_a_plate_seen_edge_on_keeps_its_outline_where_it_is_exposed_otherwise(color, light):
    """A tenth of what it is in most photos; and though it has the colour that the wall has in that light."""
    random = np.random.default_rng(0)
    photos = [np.full((80, 100, 3), 0.8) for _ in range(16)]
    for photo in photos[2:]:
        photo[16:64, 10:90] = color
    for photo in photos[:2]:
        photo[16:64, 46:54] = color
        photo *= light
    photos = [np.clip(photo + random.normal(0, 0.005, photo.shape), 0, 1) for photo in photos]
    for mask in foreground_masks(photos, np.full(3, 0.8))[:2]:
        assert mask[16:64, 46:54].all()
        assert mask.sum() == 48 * 8


def test_a_small_object_keeps_its_outline_where_it_is_exposed_otherwise():
    """Seen from afar in all photos, 3 % of each."""
    photos = [np.tile(GREY, (80, 100, 1)) for _ in range(4)]
    for photo in photos:
        photo[32:48, 42:57] = 0.2, 0.1, 0.1
    photos[2] = photos[2] * 0.75
    for mask in foreground_masks(photos, GREY):
        assert mask[32:48, 42:57].all()
        assert mask.sum() == 16 * 15


def test_a_real_hole_stays_open_and_a_speck_of_background_colour_is_filled():
    image, _ = _photo(hole=True)
    image[40, 65:67] = GREY
    mask = foreground_mask(image, GREY)
    assert not mask[40, 50]
    assert mask[40, 66]


def test_an_empty_photo_has_no_foreground():
    assert not foreground_mask(np.full((60, 60, 3), 0.5), np.full(3, 0.5)).any()
